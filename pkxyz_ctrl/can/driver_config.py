"""What the amplifier driver has to know about the node and the bus."""

from typing import Annotated, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, model_validator

from pkxyz_ctrl.can import cob_id

ANY = "any"

Unsigned32 = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
Identity = Annotated[
    Unsigned32 | None,
    BeforeValidator(lambda value: None if value == ANY else value),
    PlainSerializer(lambda value: ANY if value is None else value),
]
"""A number that is compared, or "any" (None), which is not."""
Pdo = Annotated[int, Field(ge=1, le=4)]
Channels = tuple[
    Annotated[int, Field(ge=1, le=254)], Annotated[int, Field(ge=1, le=254)], Annotated[int, Field(ge=1, le=254)]
]
HeartbeatMs = Annotated[int, Field(ge=1, le=0xFFFF)]  # 0x1016 and 0x1017 are UNSIGNED16 in milliseconds
OUR_TIMEOUT_MAX_MS = 1000
"""Longest that combs may keep their voltage after the controller fell silent; the gate lets no longer one pass."""


class ProvenModule(BaseModel):
    """A report of ``pkxyz check-amplifier`` on one very module, as far as the start-up counts on it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    vendor_id: Unsigned32
    product_code: Unsigned32
    revision: Unsigned32
    serial: Unsigned32
    lines: tuple[str, ...]
    """Names of the lines that passed."""
    digest: Annotated[str, Field(pattern="^sha256:[0-9a-f]{64}$")]
    """Of the report."""

    @property
    def identity(self) -> tuple[int, int, int, int]:
        """As 0x1018 has it, sub-indices 1 to 4."""
        return self.vendor_id, self.product_code, self.revision, self.serial


class DriverConfig(BaseModel):
    """Settings of ``AmplifierDriver``. Frozen; an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    node_id: int = Field(default=10, ge=1, le=127, description="CANopen node id of the amplifier")
    controller_node_id: int = Field(default=127, ge=1, le=127, description="node id of our own heartbeat")
    fd: bool = Field(default=True, description="send FD frames with bit-rate switch; both formats are received")
    protection: bool = Field(default=True, description="process PDOs carry an alive counter and a CRC-8")

    device_type: Identity = Field(default=0x000C0191, description='0x1000; "any" takes any')
    vendor_id: Identity = Field(default=0x7078797A, description='0x1018:1; "any" takes any')
    product_code: Identity = Field(default=0x00000003, description='0x1018:2; "any" takes any')
    proven: ProvenModule | None = Field(default=None, description="what a report on this very module has shown")

    drive_pdo: Pdo = Field(default=2, description="number of the RPDO that carries the drive counts")
    sense_pdo: Pdo = Field(default=2, description="number of the TPDO that carries the sense counts")
    drive_channels: Channels = Field(default=(1, 2, 3), description="sub-indices of 0x6411, comb by comb")
    sense_channels: Channels = Field(default=(1, 2, 3), description="sub-indices of 0x6401, comb by comb")
    digital_outputs: bool = Field(default=False, description="triggers go to 0x6200:1 in RPDO 1, if the node has it")
    signature_syncs: int = Field(
        default=0, ge=0, le=240, description="between signatures in TPDO 3; 0: none is asked for"
    )

    # One lost heartbeat is survived; the second time-out, 50 ms, bounds how long the combs keep their voltage after
    # the controller fell silent.
    controller_heartbeat_period_ms: HeartbeatMs = 20
    controller_heartbeat_timeout_ms: int = Field(default=50, ge=1, le=OUR_TIMEOUT_MAX_MS)
    node_heartbeat_period_ms: HeartbeatMs = 20
    node_heartbeat_timeout_ms: HeartbeatMs = 50
    drive_timeout_syncs: int = Field(default=5, ge=2, le=255, description="0x2010, written if protected")
    drive_timeout_ms: int = Field(default=20, ge=1, le=OUR_TIMEOUT_MAX_MS, description="0x2012, written if protected")

    boot_timeout_us: int = Field(default=1_000_000, gt=0, description="from NMT reset to the boot-up message")
    start_timeout_us: int = Field(default=200_000, gt=0, description="from NMT start to a heartbeat that says so")
    sdo_timeout_us: int = Field(default=50_000, gt=0, description="from an SDO request to its answer")
    retries: int = Field(default=2, ge=0, le=10, description="repetitions of a reset, a start, an SDO request")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.node_id == self.controller_node_id:
            raise ValueError(f"node_id and controller_node_id are both {self.node_id}; give them different ids")
        for name in ("drive_channels", "sense_channels"):
            channels = getattr(self, name)
            if len(set(channels)) != len(channels):
                raise ValueError(f"{name} = {list(channels)}: three different channels, one for each comb")
        for who in ("controller", "node"):
            period_ms = getattr(self, f"{who}_heartbeat_period_ms")
            timeout_ms = getattr(self, f"{who}_heartbeat_timeout_ms")
            if timeout_ms <= period_ms:
                raise ValueError(
                    f"{who}_heartbeat_timeout_ms = {timeout_ms} must be longer than "
                    f"{who}_heartbeat_period_ms = {period_ms}"
                )
        return self

    @property
    def output_id(self) -> int:
        """Identifier of RPDO 1 with the digital outputs; -1: there is none, or it carries the drive counts."""
        return cob_id.OUTPUT_BASE + self.node_id if self.digital_outputs and self.drive_pdo != 1 else -1

    @property
    def signature_id(self) -> int:
        """Identifier of TPDO 3 with the signature of the safety objects of a protected node; -1: none is asked for."""
        is_free = self.protection and self.sense_pdo != cob_id.SIGNATURE_PDO
        return cob_id.sense(self.node_id, cob_id.SIGNATURE_PDO) if self.signature_syncs and is_free else -1

    @property
    def heartbeat_wait_us(self) -> int:
        """How long ours may be put off behind triggers: so long that one lost heartbeat is survived all the same."""
        spare_ms = self.controller_heartbeat_timeout_ms - 2 * self.controller_heartbeat_period_ms
        return 500 * max(0, spare_ms)

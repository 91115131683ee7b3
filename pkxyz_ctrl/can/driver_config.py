"""What the amplifier driver has to know about the node and the bus."""

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Unsigned32 = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
HeartbeatMs = Annotated[int, Field(ge=1, le=0xFFFF)]  # 0x1016 and 0x1017 are UNSIGNED16 in milliseconds
OUR_TIMEOUT_MAX_MS = 1000
"""Longest that combs may keep their voltage after the controller fell silent; the gate lets no longer one pass."""


class DriverConfig(BaseModel):
    """Settings of ``AmplifierDriver``. Frozen; an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    node_id: int = Field(default=10, ge=1, le=127, description="CANopen node id of the amplifier")
    controller_node_id: int = Field(default=127, ge=1, le=127, description="node id of our own heartbeat")
    fd: bool = Field(default=True, description="send FD frames with bit-rate switch; both formats are received")
    protection: bool = Field(default=True, description="process PDOs carry an alive counter and a CRC-8")

    device_type: Unsigned32 | None = Field(default=0x000C0191, description="0x1000; None accepts any")
    vendor_id: Unsigned32 | None = Field(default=0x7078797A, description="0x1018:1; None accepts any")
    product_code: Unsigned32 | None = Field(default=0x00000003, description="0x1018:2; None accepts any")

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
        for who in ("controller", "node"):
            period_ms = getattr(self, f"{who}_heartbeat_period_ms")
            timeout_ms = getattr(self, f"{who}_heartbeat_timeout_ms")
            if timeout_ms <= period_ms:
                raise ValueError(
                    f"{who}_heartbeat_timeout_ms = {timeout_ms} must be longer than "
                    f"{who}_heartbeat_period_ms = {period_ms}"
                )
        return self

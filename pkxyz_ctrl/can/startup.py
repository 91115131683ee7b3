"""What is asked of and written to the amplifier before it may be started: plain lists of SDO transfers."""

from . import cob_id
from .driver_config import DriverConfig
from .sdo import SdoStep

_SAME_DEVICE = "check that this is the amplifier of this configuration, or correct the identity in the bus config"
_NO_PROTECTION = "does the amplifier have protected PDOs? If not, set protection = false in the bus config"
_NO_401 = "the amplifier must offer analogue outputs and inputs as CiA 401 says (0x6411, 0x6401, PDO 2)"
_NO_SAFE_STATE = "an amplifier that cannot be told to go to 0 V by itself must not be used"
_NO_STEP_LIMIT = "an amplifier that does not limit its own steps makes two in one where a frame is lost"
_NO_HEARTBEAT = "the amplifier must produce and consume heartbeats"
_READ_BACK = "the amplifier did not keep what was written; power it off and on, then compare it with its EDS"


def identity_steps(config: DriverConfig) -> tuple[SdoStep, ...]:
    """Device type, vendor and product, compared with the configuration (0x1000, 0x1018)."""

    def read(index: int, subindex: int, value: int | None, what: str) -> SdoStep:
        return SdoStep(index, subindex, 4, value, False, what, _SAME_DEVICE)

    return (
        read(0x1000, 0, config.device_type, "device type"),
        read(0x1018, 1, config.vendor_id, "vendor"),
        read(0x1018, 2, config.product_code, "product code"),
    )


def configuration_steps(config: DriverConfig, count_step_max: int = 32767) -> tuple[SdoStep, ...]:
    """All writes, then a read-back of the last value of everything that was written.

    ``count_step_max``: most that a drive count may change at a SYNC, which the node holds itself to.
    """
    writes = _writes(config, count_step_max)
    last_value = {(step.index, step.subindex): step for step in writes}
    read_back = (
        SdoStep(step.index, step.subindex, step.size, step.value, False, f"read-back of {step.what}", _READ_BACK)
        for step in last_value.values()
    )
    return (*writes, *read_back)


def mapping(value_index: int, protection_index: int, protection: bool) -> tuple[int, ...]:
    """Mapping entries of a process PDO (index, sub-index, bits): three 16-bit values, alive counter, CRC."""
    values = tuple(value_index << 16 | channel << 8 | 16 for channel in (1, 2, 3))
    guard = tuple(protection_index << 16 | part << 8 | 8 for part in (1, 2))
    return values + guard if protection else values


def _writes(config: DriverConfig, count_step_max: int) -> tuple[SdoStep, ...]:
    node = config.node_id
    drive_cob_id = cob_id.DRIVE_BASE + node
    sense_cob_id = cob_id.COB_ID_NO_RTR | (cob_id.SENSE_BASE + node)
    drive_mapping = mapping(0x6411, 0x2000, config.protection)
    sense_mapping = mapping(0x6401, 0x2001, config.protection)
    steps = [
        _write(0x1005, 0, 4, cob_id.SYNC, "COB-ID of SYNC", _NO_401),
        *_pdo_off(0x1401, 0x1601, drive_cob_id, drive_mapping, "drive PDO"),
        *_pdo_off(0x1801, 0x1A01, sense_cob_id, sense_mapping, "sense PDO"),
    ]
    for comb in (1, 2, 3):
        steps.append(_write(0x6443, comb, 1, 1, f"error mode of comb {comb}: use the error value", _NO_SAFE_STATE))
        steps.append(_write(0x6444, comb, 4, 0, f"error value of comb {comb}: 0 V", _NO_SAFE_STATE))
    steps.append(_write(0x1029, 1, 1, 0, "after a communication error: pre-operational", _NO_SAFE_STATE))
    if config.protection:
        steps += [
            _write(0x2010, 0, 1, config.drive_timeout_syncs, "SYNCs without a drive PDO", _NO_SAFE_STATE),
            _write(0x2011, 0, 2, count_step_max, "largest step of a drive count", _NO_STEP_LIMIT),
            _write(0x2012, 0, 2, config.drive_timeout_ms, "time without an applied drive PDO", _NO_SAFE_STATE),
        ]
    consumer = config.controller_node_id << 16 | config.controller_heartbeat_timeout_ms
    steps += [
        _write(0x1016, 1, 4, consumer, "consumer of our heartbeat", _NO_HEARTBEAT),
        _write(0x1017, 0, 2, config.node_heartbeat_period_ms, "heartbeat period", _NO_HEARTBEAT),
        _write(0x1019, 0, 1, cob_id.SYNC_COUNTER_OVERFLOW, "SYNC counter overflow", "the SYNC carries a counter"),
        _write(0x1401, 1, 4, drive_cob_id, "COB-ID of the drive PDO, on", _NO_401),
        _write(0x1801, 1, 4, sense_cob_id, "COB-ID of the sense PDO, on", _NO_401),
    ]
    return tuple(steps)


def _pdo_off(
    communication: int, mapping_index: int, pdo_cob_id: int, entries: tuple[int, ...], what: str
) -> list[SdoStep]:
    # CiA 301, 7.5.2.36: PDO off, mapping empty, entries, number of entries; it is switched on at the very end.
    return [
        _write(communication, 1, 4, cob_id.COB_ID_INVALID | pdo_cob_id, f"COB-ID of the {what}, off", _NO_401),
        _write(communication, 2, 1, cob_id.SYNCHRONOUS_EVERY_SYNC, f"{what} on every SYNC", _NO_401),
        _write(mapping_index, 0, 1, 0, f"mapping of the {what}, cleared", _NO_401),
        *(
            _write(mapping_index, place, 4, entry, f"mapping of the {what}", _NO_401 if place <= 3 else _NO_PROTECTION)
            for place, entry in enumerate(entries, 1)
        ),
        _write(mapping_index, 0, 1, len(entries), f"mapping of the {what}, complete", _NO_PROTECTION),
    ]


def _write(index: int, subindex: int, size: int, value: int, what: str, remedy: str) -> SdoStep:
    return SdoStep(index, subindex, size, value, True, what, remedy)

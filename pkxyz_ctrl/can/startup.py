"""What the amplifier has to hold before it may be started, and what follows from what it holds already.

Plain data and pure functions: ``survey`` asks, ``plan`` compares the answers with what is wanted.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from . import cob_id
from .driver_config import DriverConfig
from .sdo import SdoStep

Key = tuple[int, int]
Found = Mapping[Key, int | None]
"""What the survey read, by index and sub-index. None: the node has no such object. Not there: it could not be read."""

_SAME_DEVICE = "check that this is the amplifier of this configuration, or correct the identity in the bus config"
_NO_PROTECTION = "does the amplifier have protected PDOs? If not, set protection = false in the bus config"
_NO_401 = (
    "the amplifier must offer analogue outputs and inputs as CiA 401 says (0x6411, 0x6401), in the PDOs and channels "
    "of the bus config: `pkxyz new bus --eds` takes them from its EDS"
)
_NO_SAFE_STATE = "an amplifier that cannot be told to go to 0 V by itself must not be used"
_NO_STEP_LIMIT = "an amplifier that does not limit its own steps makes two in one where a frame is lost"
_NO_HEARTBEAT = "the amplifier must produce and consume heartbeats"
_READ_BACK = "the amplifier did not keep what was written; power it off and on, then compare it with its EDS"
_REPORT = "try it by `pkxyz check-amplifier --allow-voltage --out DIR`, and give its report to `pkxyz run --report`"

_STOPPED = 2  # 0x1029: also a state in which the outputs take their error value

HEARTBEAT_LOST, LEAVING, DRIVE_TIMEOUT = "heartbeat lost", "leaving operational", "drive time-out"
"""Lines of a report that stand in for an object which a node has not."""


@dataclass(frozen=True, slots=True)
class Setting:
    """What one object has to hold. ``size`` in bytes; ``alike``: bits in which it may differ; ``may_differ``: where it
    can't be written, what is there is taken.
    """

    index: int
    subindex: int
    size: int
    value: int
    what: str
    remedy: str
    alike: int = 0
    may_differ: bool = False

    @property
    def key(self) -> Key:
        return self.index, self.subindex

    def stands(self, found: Found) -> bool:
        """Whether the node holds it already."""
        value = found.get(self.key)
        return value is not None and (value ^ self.value) & ~self.alike == 0

    def write(self, value: int | None = None, note: str = "") -> SdoStep:
        """Write it, or something else on the way to it."""
        wanted = self.value if value is None else value
        return SdoStep(
            self.index, self.subindex, self.size, wanted, True, self.what + note, self.remedy, optional=self.may_differ
        )

    def read_back(self) -> SdoStep:
        what = f"read-back of {self.what}"
        return SdoStep(self.index, self.subindex, self.size, self.value, False, what, _READ_BACK, alike=self.alike)

    def ask(self) -> SdoStep:
        """Read it, whatever it is, and whether it is there at all."""
        return SdoStep(self.index, self.subindex, self.size, None, False, self.what, self.remedy, optional=True)


@dataclass(frozen=True, slots=True)
class Plan:
    """``steps``: writes, then the read-back of everything that has to hold. ``lost``: protections that this node does
    not give, and what stands in for each. ``refusal``: why it must not be started; empty if it may. ``is_proven``: a
    report on this very module shows that its combs go to 0 V without us.
    """

    steps: tuple[SdoStep, ...]
    lost: tuple[str, ...]
    refusal: str
    is_proven: bool = False


@dataclass(frozen=True, slots=True)
class _Pdo:
    """Parameters of one process PDO."""

    what: str
    cob_id: Setting
    kind: Setting
    count: Setting
    entries: tuple[Setting, ...]

    @property
    def settings(self) -> tuple[Setting, ...]:
        return self.cob_id, self.kind, *self.entries, self.count

    def writes(self, found: Found) -> tuple[tuple[SdoStep, ...], tuple[SdoStep, ...]]:
        """What is written before anything else, and what once all else is. CiA 301, 7.5.2.36: PDO off, mapping empty,
        entries, number of entries, on. A PDO whose mapping stands is left alone.
        """
        is_mapped = all(setting.stands(found) for setting in (*self.entries, self.count))
        kind = () if self.kind.stands(found) else (self.kind.write(),)
        if is_mapped and self.cob_id.stands(found):
            return kind, ()
        off = self.cob_id.write(cob_id.COB_ID_INVALID | self.cob_id.value, ", off")
        mapped = (
            ()
            if is_mapped
            else (
                self.count.write(0, ", cleared"),
                *(entry.write() for entry in self.entries),
                self.count.write(note=", complete"),
            )
        )
        return (off, *kind, *mapped), (self.cob_id.write(note=", on"),)


def identity_steps(config: DriverConfig) -> tuple[SdoStep, ...]:
    """Device type, vendor and product, compared with the configuration (0x1000, 0x1018)."""

    def read(index: int, subindex: int, value: int | None, what: str) -> SdoStep:
        return SdoStep(index, subindex, 4, value, False, what, _SAME_DEVICE)

    return (
        read(0x1000, 0, config.device_type, "device type"),
        read(0x1018, 1, config.vendor_id, "vendor"),
        read(0x1018, 2, config.product_code, "product code"),
    )


def survey(config: DriverConfig) -> tuple[SdoStep, ...]:
    """Reads of revision and serial number, which may be missing, and of everything that has to hold."""
    single = tuple(
        SdoStep(0x1018, part, 4, None, False, what, _SAME_DEVICE, optional=True)
        for part, what in ((3, "revision"), (4, "serial number"))
    )
    return (*single, *(setting.ask() for setting in settings(config)))


def configuration_steps(config: DriverConfig, count_step_max: int = 32767) -> tuple[SdoStep, ...]:
    """All writes, and the read-back of each: what a node gets of which nothing is known."""
    return plan(config, count_step_max, {}).steps


def settings(config: DriverConfig, count_step_max: int = 32767) -> tuple[Setting, ...]:
    """Everything that has to hold. ``count_step_max``: most that a drive count may change at a SYNC, which a protected
    node holds itself to.
    """
    drive, sense = _pdos(config)
    return (*drive.settings, *sense.settings, *_others(config, count_step_max))


def plan(config: DriverConfig, count_step_max: int, found: Found) -> Plan:
    """What is to be written to a node that holds ``found``, and what it can't give."""
    identity = tuple(found.get((0x1018, part)) for part in (1, 2, 3, 4))
    proven = config.proven
    lines = proven.lines if proven is not None and proven.identity == identity else ()
    wanted = settings(config, count_step_max)
    absent = {setting.index: setting for setting in reversed(wanted) if found.get(setting.key, 0) is None}
    lost = _left_out(config)
    if proven is not None and not lines:
        lost.append("the report in the bus config: it is of another module, and does not count")
    for index, setting in sorted(absent.items()):
        told, refusal = _without(index, setting, config, lines)
        if refusal:
            return Plan((), tuple(lost), refusal)
        lost += told
    writes = _writes(config, count_step_max, found, absent)
    # Also of what stood already: one answer that was damaged must not pass for a value that is there.
    back = tuple(
        setting.ask() if setting.may_differ else setting.read_back()
        for setting in wanted
        if setting.index not in absent
    )
    return Plan((*writes, *back), tuple(lost), "", bool({HEARTBEAT_LOST, DRIVE_TIMEOUT} & set(lines)))


def _writes(
    config: DriverConfig, count_step_max: int, found: Found, absent: Mapping[int, Setting]
) -> tuple[SdoStep, ...]:
    first: list[SdoStep] = []
    last: list[SdoStep] = []
    for pdo in _pdos(config):
        before, after = pdo.writes(found)
        first += before
        last += after
    others = (
        setting.write()
        for setting in _others(config, count_step_max)
        if not setting.stands(found) and setting.index not in absent
    )
    return (*first, *others, *last)


def _left_out(config: DriverConfig) -> list[str]:
    """Protections that the configuration itself does without."""
    lost = []
    if None in (config.device_type, config.vendor_id, config.product_code):
        lost.append(
            'identity "any": a module of another kind at this node id is not noticed; that it goes to a safe state '
            "without us is tried at every start"
        )
    if not config.protection:
        lost.append(
            "protection = false: no alive counter, no CRC, no limit of the node's own on steps and on time without "
            "drive frames; CAN's CRC, the gate's limits and the heartbeats remain"
        )
    return lost


def _without(index: int, setting: Setting, config: DriverConfig, lines: tuple[str, ...]) -> tuple[tuple[str, ...], str]:
    """What is lost without an object and what replaces it; or, in second place, why nothing does."""
    name = f"no 0x{index:04X} ({setting.what})"
    if index == 0x1005:
        return (), ""  # then SYNC is 0x080, as CiA 301 has it
    if index == 0x1019:
        remains = "its limits on steps and time remain" if config.protection else "a missing sense PDO still tells"
        return (f"{name}: the node can't notice a SYNC that it missed; {remains}",), ""
    if index == 0x1029:
        return (f"{name}: CiA 301's default is relied on, pre-operational; the live trial shows it",), ""
    if index in (0x6443, 0x6444):
        if {HEARTBEAT_LOST, LEAVING} <= set(lines):
            return (f"{name}: that its outputs go to 0 V stands in the report on this module",), ""
        return (), f"{name}, and no report shows that its outputs go to 0 V by themselves: {_REPORT}"
    if index == 0x1016:
        if config.protection and DRIVE_TIMEOUT in lines:
            return (f"{name}: its drive time-out (0x2012) takes over, as the report on this module shows",), ""
        return (
            (),
            f"{name}, and nothing else takes the combs to 0 V when this controller falls silent: {_NO_SAFE_STATE}",
        )
    return (), f"{name}: {setting.remedy}"


def mapping(
    value_index: int, protection_index: int, protection: bool, channels: tuple[int, int, int] = (1, 2, 3)
) -> tuple[int, ...]:
    """Mapping entries of a process PDO (index, sub-index, bits): three 16-bit values, alive counter, CRC."""
    values = tuple(value_index << 16 | channel << 8 | 16 for channel in channels)
    guard = tuple(protection_index << 16 | part << 8 | 8 for part in (1, 2))
    return values + guard if protection else values


def _pdos(config: DriverConfig) -> tuple[_Pdo, _Pdo]:
    node, guarded = config.node_id, config.protection
    drive_entries = mapping(0x6411, 0x2000, guarded, config.drive_channels)
    sense_entries = mapping(0x6401, 0x2001, guarded, config.sense_channels)
    drive = _pdo(0x1400 + config.drive_pdo - 1, cob_id.drive(node, config.drive_pdo), drive_entries, "drive PDO")
    sense_id = cob_id.COB_ID_NO_RTR | cob_id.sense(node, config.sense_pdo)
    return drive, _pdo(0x1800 + config.sense_pdo - 1, sense_id, sense_entries, "sense PDO")


def _pdo(communication: int, pdo_cob_id: int, entries: tuple[int, ...], what: str) -> _Pdo:
    mapped = communication + 0x200
    return _Pdo(
        what,
        Setting(communication, 1, 4, pdo_cob_id, f"COB-ID of the {what}", _NO_401, alike=cob_id.COB_ID_NO_RTR),
        Setting(communication, 2, 1, cob_id.SYNCHRONOUS_EVERY_SYNC, f"{what} on every SYNC", _NO_401),
        Setting(mapped, 0, 1, len(entries), f"mapping of the {what}", _NO_PROTECTION if len(entries) > 3 else _NO_401),
        tuple(
            Setting(mapped, place, 4, entry, f"mapping of the {what}", _NO_401 if place <= 3 else _NO_PROTECTION)
            for place, entry in enumerate(entries, 1)
        ),
    )


def _others(config: DriverConfig, count_step_max: int) -> tuple[Setting, ...]:
    errors = tuple(
        setting
        for comb, channel in enumerate(config.drive_channels, 1)
        for setting in (
            Setting(0x6443, channel, 1, 1, f"error mode of comb {comb}: use the error value", _NO_SAFE_STATE),
            Setting(0x6444, channel, 4, 0, f"error value of comb {comb}: 0 V", _NO_SAFE_STATE),
        )
    )
    limits = (
        Setting(0x2010, 0, 1, config.drive_timeout_syncs, "SYNCs without a drive PDO", _NO_SAFE_STATE),
        Setting(0x2011, 0, 2, count_step_max, "largest step of a drive count", _NO_STEP_LIMIT),
        Setting(0x2012, 0, 2, config.drive_timeout_ms, "time without an applied drive PDO", _NO_SAFE_STATE),
    )
    consumer = config.controller_node_id << 16 | config.controller_heartbeat_timeout_ms
    overflow = cob_id.SYNC_COUNTER_OVERFLOW
    return (
        Setting(0x1005, 0, 4, cob_id.SYNC, "COB-ID of SYNC", _NO_401, alike=cob_id.COB_ID_INVALID),
        *errors,
        Setting(0x1029, 1, 1, 0, "after a communication error: pre-operational", _NO_SAFE_STATE, alike=_STOPPED),
        *(limits if config.protection else ()),
        Setting(0x1016, 1, 4, consumer, "consumer of our heartbeat", _NO_HEARTBEAT),
        Setting(0x1017, 0, 2, config.node_heartbeat_period_ms, "heartbeat period", _NO_HEARTBEAT),
        Setting(0x1019, 0, 1, overflow, "SYNC counter overflow", "the SYNC carries a counter", may_differ=True),
    )

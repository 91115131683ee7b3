"""What the amplifier has to hold before it may be started, and the words for what follows from what it holds already.

What is asked and written is compiled, in ``start_plan`` and ``start_sequence``; here its table is made.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import cob_id, start_plan
from .cob_id import state_name
from .driver_config import DriverConfig
from .sdo import SdoStep, abort_text
from .start_plan import ABSENT, ASK, COB_ID, COUNT, ENTRY, IDENTIFY, IDENTITY, KIND, OTHER, READ_BACK, TOLD, VALUE
from .start_sequence import Cause

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

_OUTPUT_ENTRY = 0x6200_0108
_SIGNATURE, _SIGNATURE_ENTRY = (0x2020, 1), 0x2020_0110
_HAS_OUTPUTS = 1 << 17  # of the device type (CiA 401): whether it also has digital outputs is seen by itself
_STOPPED = 2  # 0x1029: also a state in which the outputs take their error value

HEARTBEAT_LOST, LEAVING, DRIVE_TIMEOUT = "heartbeat lost", "leaving operational", "drive time-out"
"""Lines of a report that stand in for an object which a node has not."""


_SHOWN = {
    HEARTBEAT_LOST: start_plan.SHOWN_HEARTBEAT_LOST,
    LEAVING: start_plan.SHOWN_LEAVING,
    DRIVE_TIMEOUT: start_plan.SHOWN_DRIVE_TIMEOUT,
}
_NOTES = {
    start_plan.COMPLETE: ", complete",
    start_plan.ON: ", on",
    start_plan.OFF: ", off",
    start_plan.CLEAR: ", cleared",
}


@dataclass(frozen=True, slots=True)
class Setting:
    """What one object has to hold, or has to say; None: anything. ``size`` in bytes; ``part``: of ``start_plan``, what
    it is about; ``alike``: bits in which it may differ; ``may_differ``: where it can't be written, what is there is
    taken; ``group``: OUTPUTS or READ_BACK_AT_WORK where it is for something that a node may lack.
    """

    index: int
    subindex: int
    size: int
    value: int | None
    what: str
    remedy: str
    part: int = OTHER
    alike: int = 0
    may_differ: bool = False
    group: int = 0

    @property
    def key(self) -> Key:
        return self.index, self.subindex

    @property
    def row(self) -> tuple[int, int, int, int, int, int, int]:
        """As ``start_plan.ROW`` has it."""
        flags = start_plan.ANY * (self.value is None) | start_plan.MAY_DIFFER * self.may_differ
        flags |= self.group | (start_plan.AT_LAST if self.key == _SIGNATURE else 0)
        return self.value or 0, self.alike, self.index, self.subindex, self.size, self.part, flags

    def step(self, act: int) -> SdoStep:
        """The transfer that an act of ``start_plan`` makes of it."""
        if act in (IDENTIFY, READ_BACK):
            what = f"read-back of {self.what}" if act == READ_BACK else self.what
            remedy = _READ_BACK if act == READ_BACK else self.remedy
            return SdoStep(self.index, self.subindex, self.size, self.value, False, what, remedy, alike=self.alike)
        if act == ASK:
            return SdoStep(self.index, self.subindex, self.size, None, False, self.what, self.remedy, optional=True)
        value = start_plan.value_of(_records((self,))[0], act)
        what = self.what + _NOTES.get(act, "")
        return SdoStep(self.index, self.subindex, self.size, value, True, what, self.remedy, optional=self.may_differ)


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


def identity_steps(config: DriverConfig) -> tuple[SdoStep, ...]:
    """Device type, vendor and product, compared with the configuration (0x1000, 0x1018)."""
    return tuple(setting.step(IDENTIFY) for setting in _identity(config) if setting.part == IDENTITY)


def survey(config: DriverConfig) -> tuple[SdoStep, ...]:
    """Reads of revision and serial number, which may be missing, and of everything that has to hold."""
    return tuple(setting.step(ASK) for setting in table(config) if setting.part != IDENTITY)


def configuration_steps(config: DriverConfig, count_step_max: int = 32767) -> tuple[SdoStep, ...]:
    """All writes, and the read-back of each: what a node gets of which nothing is known."""
    return plan(config, count_step_max, {}).steps


def table(config: DriverConfig, count_step_max: int = 32767) -> tuple[Setting, ...]:
    """What the start-up goes by: identity, then ``settings``."""
    return (*_identity(config), *settings(config, count_step_max))


def settings(config: DriverConfig, count_step_max: int = 32767) -> tuple[Setting, ...]:
    """Everything that has to hold. ``count_step_max``: most that a drive count may change at a SYNC, which a protected
    node holds itself to.
    """
    return (*_pdos(config), *_others(config, count_step_max))


def start_record(config: DriverConfig, rows: tuple[Setting, ...]) -> NDArray[np.void]:
    """(1,) of ``start_plan.START``, as the compiled start-up reads it."""
    record, proven = np.zeros(1, start_plan.START), config.proven
    to = record[0]
    to["rows"][: len(rows)], to["count"] = _records(rows), len(rows)
    signed = sorted((s.key, place) for place, s in enumerate(rows) if s.part >= COB_ID and not s.group)
    to["order"][: len(signed)], to["signed"] = [place for _, place in signed], len(signed)
    to["signature_row"] = next((place for place, s in enumerate(rows) if s.key == _SIGNATURE), -1)
    to["protection"], to["retries"] = config.protection, config.retries
    if proven is not None:
        to["proven"] = proven.identity
        to["shown"] = sum(bit for line, bit in _SHOWN.items() if line in proven.lines)
    for name in ("boot_timeout_us", "start_timeout_us", "sdo_timeout_us"):
        to[name] = getattr(config, name)
    to["trial_us"] = 1000 * trial_ms(config)
    return record


def trial_ms(config: DriverConfig) -> int:
    """The node's consumer, and then two heartbeats of its own."""
    return config.controller_heartbeat_timeout_ms + config.node_heartbeat_period_ms + config.node_heartbeat_timeout_ms


def _records(rows: tuple[Setting, ...]) -> NDArray[np.void]:
    return np.array([setting.row for setting in rows], start_plan.ROW)


def plan(config: DriverConfig, count_step_max: int, found: Found) -> Plan:
    """What is to be written to a node that holds ``found``, and what it can't give."""
    rows = table(config, count_step_max)
    record, memory = start_record(config, rows)[0], np.zeros(1, start_plan.START_MEMORY)[0]
    for place, setting in enumerate(rows):
        if setting.key in found:
            value = found[setting.key]
            memory["found"][place], memory["known"][place] = value or 0, ABSENT if value is None else VALUE
    refused = start_plan.plan(record, memory)
    steps = tuple(rows[memory["row"][n]].step(memory["act"][n]) for n in range(memory["steps"]))
    is_proven = bool(start_plan.is_proven(record, memory))
    return Plan(steps, lost(config, rows, record, memory), refusal(rows, refused), is_proven)


def lost(config: DriverConfig, rows: tuple[Setting, ...], record: np.void, memory: np.void) -> tuple[str, ...]:
    """Protections that the node which was found does not give, and what stands in for each."""
    told, proven = list(_left_out(config)), config.proven
    if proven is not None and not (proven.lines and start_plan.has_identity(memory, record["proven"])):
        told.append("the report in the bus config: it is of another module, and does not count")
    refused = start_plan.lacks(record, memory)
    known = zip(rows, memory["known"], strict=False)
    lacking = {s.index: s for s, known in reversed(list(known)) if known == ABSENT and not s.group}
    spared = [s for index, s in sorted(lacking.items()) if refused < 0 or index < rows[refused].index]
    told += _groups_lost(config, record, memory) if memory["is_planned"] else []
    return (*told, *(text for setting in spared if (text := _without(setting, config))))


def _groups_lost(config: DriverConfig, record: np.void, memory: np.void) -> list[str]:
    """What a node can't do that nothing depends on."""
    told = []
    if config.digital_outputs and not start_plan.has_group(record, memory, start_plan.OUTPUTS):
        told.append("no digital outputs (0x6200:1) in RPDO 1: triggers and in-position are recorded, and not put out")
    if config.signature_syncs and not start_plan.is_signed(record, memory):
        told.append(
            "no signature of its safety objects (0x2020) in TPDO 3: a change of them at work is not seen; frames in "
            "our name are"
        )
    return told


def refusal(rows: tuple[Setting, ...], place: int) -> str:
    """Why a node without the object of this row must not be started; empty if there is none, -1."""
    if place < 0:
        return ""
    setting = rows[place]
    name = f"no 0x{setting.index:04X} ({setting.what})"
    if setting.index in (0x6443, 0x6444):
        return f"{name}, and no report shows that its outputs go to 0 V by themselves: {_REPORT}"
    if setting.index == 0x1016:
        return f"{name}, and nothing else takes the combs to 0 V when this controller falls silent: {_NO_SAFE_STATE}"
    return f"{name}: {setting.remedy}"


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


def _without(setting: Setting, config: DriverConfig) -> str:
    """What is lost without an object that can be done without, and what replaces it."""
    index, name = setting.index, f"no 0x{setting.index:04X} ({setting.what})"
    if index == 0x1019:
        remains = "its limits on steps and time remain" if config.protection else "a missing sense PDO still tells"
        return f"{name}: the node can't notice a SYNC that it missed; {remains}"
    if index == 0x1029:
        return f"{name}: CiA 301's default is relied on, pre-operational; the live trial shows it"
    if index in (0x6443, 0x6444):
        return f"{name}: that its outputs go to 0 V stands in the report on this module"
    if index == 0x1016:
        return f"{name}: its drive time-out (0x2012) takes over, as the report on this module shows"
    return ""  # without 0x1005, SYNC is 0x080, as CiA 301 has it; the others nobody can do without


def _identity(config: DriverConfig) -> tuple[Setting, ...]:
    return (
        Setting(0x1000, 0, 4, config.device_type, "device type", _SAME_DEVICE, IDENTITY, alike=_HAS_OUTPUTS),
        Setting(0x1018, 1, 4, config.vendor_id, "vendor", _SAME_DEVICE, IDENTITY),
        Setting(0x1018, 2, 4, config.product_code, "product code", _SAME_DEVICE, IDENTITY),
        Setting(0x1018, 3, 4, None, "revision", _SAME_DEVICE, TOLD),
        Setting(0x1018, 4, 4, None, "serial number", _SAME_DEVICE, TOLD),
    )


def failure_words(
    config: DriverConfig, rows: tuple[Setting, ...], memory: np.void, node_state: int, foreign: str
) -> str:
    """Why the start-up failed, from ``memory``, of ``start_plan.START_MEMORY``: what was expected, what came and what
    to do. ``node_state``: what the node's last heartbeat said, -1 if none came.
    """
    name, times = f"amplifier (node {config.node_id})", config.retries + 1
    heard = f"its heartbeat says {state_name(node_state)}" if node_state >= 0 else "no heartbeat came"
    match Cause(int(memory["cause"])):
        case Cause.DISTURBED:
            return foreign
        case Cause.NEVER_BOOTED:
            return f"{never_booted(config)}; check node id, power, wiring and bit rates"
        case Cause.BOOTS_AGAIN:
            return f"{name} restarts again and again while it is configured; check its power supply"
        case Cause.LACKS:
            return f"{name}: {refusal(rows, int(memory['cause_row']))}"
        case Cause.SYNC_COUNTER:
            return f"{name} counts SYNCs to {memory['reply']} (0x1019), CiA 301 permits 2 to 240; see its manual"
        case Cause.NOT_STARTED:
            return (
                f"{name} did not become operational within {config.start_timeout_us / 1000:g} ms of NMT start, "
                f"{times} times: {heard}; look at its emergencies"
            )
        case Cause.NOT_NOTICED:
            return (
                f"{name} did not notice that our heartbeat ended: {trial_ms(config)} ms later {heard}. It may store "
                "0x1016 and 0x1029 and do nothing with them: it would hold its combs at a voltage for ever"
            )
    return f"{name}: {_step_words(config, rows, memory)}"


def never_booted(config: DriverConfig) -> str:
    """What was missed where a node is asked all the same."""
    return (
        f"amplifier (node {config.node_id}) sent no boot-up message 0x{cob_id.HEARTBEAT_BASE + config.node_id:03X} "
        f"within {config.boot_timeout_us / 1000:g} ms of NMT reset, {config.retries + 1} times"
    )


def _step_words(config: DriverConfig, rows: tuple[Setting, ...], memory: np.void) -> str:
    """Why the open step could not be done."""
    step = rows[int(memory["cause_row"])].step(int(memory["act"][memory["position"]]))
    reply, digits = int(memory["reply"]), 2 * step.size
    match Cause(int(memory["cause"])):
        case Cause.NO_ANSWER:
            return (
                f"no answer to {step.name} within {config.sdo_timeout_us / 1000:g} ms, asked {memory['tries']} times; "
                "check node id, bit rates, wiring and termination"
            )
        case Cause.REFUSED:
            verb = "writing" if step.write else "reading"
            return f"{verb} {step.name} was refused: {abort_text(reply)}; {step.remedy}"
        case Cause.NO_NUMBER:
            return f"{step.name} is longer than four bytes or not a number; {step.remedy}"
        case Cause.SIZE:
            return f"{step.name} has {memory['reply_size']} bytes instead of {step.size}; {step.remedy}"
    return f"{step.name} is 0x{reply:0{digits}X}, expected 0x{step.value or 0:0{digits}X}; {step.remedy}"


def mapping(
    value_index: int, protection_index: int, protection: bool, channels: tuple[int, int, int] = (1, 2, 3)
) -> tuple[int, ...]:
    """Mapping entries of a process PDO (index, sub-index, bits): three 16-bit values, alive counter, CRC."""
    values = tuple(value_index << 16 | channel << 8 | 16 for channel in channels)
    guard = tuple(protection_index << 16 | part << 8 | 8 for part in (1, 2))
    return values + guard if protection else values


def _pdos(config: DriverConfig) -> tuple[Setting, ...]:
    node, guarded = config.node_id, config.protection
    drive_entries = mapping(0x6411, 0x2000, guarded, config.drive_channels)
    sense_entries = mapping(0x6401, 0x2001, guarded, config.sense_channels)
    drive = _pdo(0x1400 + config.drive_pdo - 1, cob_id.drive(node, config.drive_pdo), drive_entries, "drive PDO")
    sense_id = cob_id.COB_ID_NO_RTR | cob_id.sense(node, config.sense_pdo)
    sense = _pdo(0x1800 + config.sense_pdo - 1, sense_id, sense_entries, "sense PDO")
    outputs = _outputs(config) if config.output_id >= 0 else ()
    return (*drive, *sense, *outputs, *(_signature(config) if config.signature_id >= 0 else ()))


def _outputs(config: DriverConfig) -> tuple[Setting, ...]:
    """Digital outputs and their PDO: what a node has not of it, it goes without."""
    pdo = _pdo(0x1400, config.output_id, (_OUTPUT_ENTRY,), "PDO of the digital outputs")
    outputs = Setting(0x6200, 1, 1, None, "digital outputs 1 to 8", "", TOLD, group=start_plan.OUTPUTS)
    return (outputs, *(replace(setting, may_differ=True, group=start_plan.OUTPUTS) for setting in pdo))


def _signature(config: DriverConfig) -> tuple[Setting, ...]:
    """The node's signature of its safety objects, and its PDO, every so many SYNCs."""
    pdo_cob_id = cob_id.COB_ID_NO_RTR | config.signature_id
    communication = 0x1800 + cob_id.SIGNATURE_PDO - 1
    pdo = _pdo(communication, pdo_cob_id, (_SIGNATURE_ENTRY,), "PDO of the signature", config.signature_syncs)
    own = Setting(0x2020, 1, 2, None, "signature of the safety objects", "", TOLD, group=start_plan.READ_BACK_AT_WORK)
    return (own, *(replace(setting, may_differ=True, group=start_plan.READ_BACK_AT_WORK) for setting in pdo))


def _pdo(
    communication: int, pdo_cob_id: int, entries: tuple[int, ...], what: str, every: int = cob_id.SYNCHRONOUS_EVERY_SYNC
) -> tuple[Setting, ...]:
    """Parameters of one process PDO, in the order of ``start_plan``'s parts."""
    mapped = communication + 0x200
    mapping_of = f"mapping of the {what}"
    return (
        Setting(communication, 1, 4, pdo_cob_id, f"COB-ID of the {what}", _NO_401, COB_ID, cob_id.COB_ID_NO_RTR),
        Setting(communication, 2, 1, every, f"{what} on every SYNC" if every == 1 else f"{what}, type", _NO_401, KIND),
        *(
            Setting(mapped, place, 4, entry, mapping_of, _NO_401 if place <= 3 else _NO_PROTECTION, ENTRY)
            for place, entry in enumerate(entries, 1)
        ),
        Setting(mapped, 0, 1, len(entries), mapping_of, _NO_PROTECTION if len(entries) > 3 else _NO_401, COUNT),
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

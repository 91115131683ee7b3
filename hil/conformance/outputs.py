"""What the outputs do when something is wrong: the part of the contract that keeps a device whole."""

from collections.abc import Callable

from hil.conformance.deviation import DeviationError, NotTestedError, UndecidedError, deviate_if, first_few
from hil.conformance.process import TEST_COUNTS
from hil.conformance.talker import SETTLE_US, ZERO, Talker
from hil.conformance.verdict import OUR_CONTRACT, SAFETY, Check
from pkxyz_ctrl.can.cob_id import NmtCommand
from pkxyz_ctrl.can.codec import Counts
from pkxyz_ctrl.can.driver_config import OUR_TIMEOUT_MAX_MS
from pkxyz_ctrl.can.sdo import NO_SUCH_OBJECT
from pkxyz_ctrl.can.startup import DRIVE_TIMEOUT, HEARTBEAT_LOST, LEAVING

_HEARTBEAT_TOLERANCE_MS = 5
_SCALE_VOLTS = (0.0, 1.0, 5.0)
_OTHER: Counts = (TEST_COUNTS[1], TEST_COUNTS[2], TEST_COUNTS[0])
_STEP_MAX = TEST_COUNTS[0]
_RISE: tuple[Counts, ...] = ((164, 164, 164), (164, 328, 328))  # to the test counts, by no larger steps
_TIMEOUT_MS = 200  # long enough for the reads before it


def _energised(talker: Talker, configure: Callable[[], object] = lambda: None, rise: tuple[Counts, ...] = ()) -> None:
    """Operational with the test counts at the outputs; only with permission. ``configure`` is called before that: a
    node may hold what is safe fixed while operational. ``rise``: by way of these counts.
    """
    if not talker.allow_voltage:
        raise NotTestedError("takes counts other than 0: only with --allow-voltage")
    talker.operational()
    talker.nmt(NmtCommand.PRE_OPERATIONAL)
    configure()
    talker.nmt(NmtCommand.START)
    for counts in rise:
        talker.cycles(1, counts)
    talker.cycles(10, TEST_COUNTS)
    talker.cycle()
    if (outputs := talker.outputs()) != TEST_COUNTS:
        raise NotTestedError(f"0x6411 reads {outputs} after {TEST_COUNTS} was sent")


def _measure_if(found: list[str]) -> None:
    """0x6411 may hold what was written last and not what is at the terminals (CiA
    401 leaves it open): it decides nothing.
    """
    if found:
        raise UndecidedError(f"{first_few(found)}: hold a voltmeter to the terminals; 0 V there is needed where 0 is")


def _after_reset(talker: Talker) -> str:
    if talker.allow_voltage:
        talker.operational()
        talker.cycles(10, TEST_COUNTS)
    deviations = []
    for command in (NmtCommand.RESET_COMMUNICATION, NmtCommand.RESET_NODE):
        talker.reset(command)
        if (outputs := talker.outputs()) != ZERO:
            deviations.append(f"after {command.name.lower().replace('_', ' ')} 0x6411 reads {outputs}")
    _measure_if(deviations)
    return "0x6411 reads 0, 0, 0"


def _error_objects(talker: Talker) -> str:
    talker.reset()
    deviations = []
    for comb in (1, 2, 3):
        for mode in (0, 1):
            written, kept = talker.write(0x6443, comb, mode, 1), talker.read(0x6443, comb)
            if not written.ok or kept.unsigned != mode:
                deviations.append(f"0x6443:{comb:02X} = {mode}: {written.text}, then {kept.text}")
        written, kept = talker.write(0x6444, comb, 0, 4), talker.read(0x6444, comb)
        if not written.ok or kept.unsigned != 0:
            deviations.append(f"0x6444:{comb:02X} = 0: {written.text}, then {kept.text}")
    deviate_if(deviations)
    return "modes 0 and 1 and value 0 are kept"


def _has_only_its_drive_timeout(talker: Talker) -> bool:
    """No 0x1016, but a protected node: 0x2012 may stand in for it."""
    return talker.driver.protection and talker.read(0x1016, 1).abort in NO_SUCH_OBJECT


def _heartbeat_lost(talker: Talker) -> str:
    """EMCY 0x8130 in time, and out of operational, as 0x1029:01 = 0 says."""
    talker.operational()
    if _has_only_its_drive_timeout(talker):
        raise DeviationError(f"no 0x1016: it does not notice; the line {DRIVE_TIMEOUT!r} has to stand in for it")
    limit_ms = talker.driver.controller_heartbeat_timeout_ms
    talker.run(2000 * limit_ms)
    mark = talker.mark()
    last_us = talker.last_beat_us
    talker.beating = False
    talker.run(2000 * limit_ms + SETTLE_US)
    frames = talker.since(mark, talker.emergency_id)
    times_us = [t_us for t_us, data in frames if data[:2] == b"\x30\x81"]
    state = [data for _, data in talker.since(mark, talker.heartbeat_id)][-1:]
    if not times_us:
        told = f"no EMCY 0x8130 within {2 * limit_ms} ms"
        raise DeviationError(told, is_unsafe=state != [b"\x7f"])
    after_ms = (times_us[0] - last_us) / 1000
    told = (
        f"EMCY 0x8130 {after_ms:.2f} ms after our last heartbeat, then state {state[0].hex() if state else 'unknown'}"
    )
    stays = bool(state) and state[0] != b"\x7f"
    if not limit_ms - 1 <= after_ms <= limit_ms + _HEARTBEAT_TOLERANCE_MS or stays:
        raise DeviationError(told, is_unsafe=stays)
    return told


def _heartbeat_outputs(talker: Talker) -> str:
    _energised(talker)
    if _has_only_its_drive_timeout(talker):
        raise NotTestedError("no 0x1016")
    talker.beating = False
    talker.run(1000 * (talker.driver.controller_heartbeat_timeout_ms + _HEARTBEAT_TOLERANCE_MS))
    if (outputs := talker.outputs()) != ZERO:
        _measure_if([f"after our heartbeat ended 0x6411 reads {outputs}"])
    return "0x6411 reads 0, 0, 0"


def _leaving(talker: Talker) -> str:
    deviations = []
    for command in (NmtCommand.PRE_OPERATIONAL, NmtCommand.STOP):
        _energised(talker)
        talker.nmt(command)
        talker.nmt(NmtCommand.PRE_OPERATIONAL)  # where SDO is answered
        if (outputs := talker.outputs()) != ZERO:
            deviations.append(f"after {command.name.lower().replace('_', '-')} 0x6411 reads {outputs}")
    _measure_if(deviations)
    return "0x6411 reads 0, 0, 0"


def _error_value(talker: Talker) -> str:
    def configure() -> None:
        talker.write(0x6444, 1, _OTHER[0], 4)
        talker.write(0x6443, 2, 0, 1)

    _energised(talker, configure)
    talker.nmt(NmtCommand.PRE_OPERATIONAL)
    outputs, expected = talker.outputs(), (_OTHER[0], TEST_COUNTS[1], 0)
    talker.reset()
    if outputs != expected:
        _measure_if([f"0x6411 reads {outputs}, error modes and values say {expected}"])
    return f"0x6411 {outputs}"


def _drive_missing(talker: Talker) -> str:
    if not talker.driver.protection:
        raise NotTestedError("the bus configuration asks for no time-out of the drive PDO")
    _energised(talker)
    limit = talker.driver.drive_timeout_syncs
    talker.cycles(2, TEST_COUNTS)
    mark = talker.mark()
    for _ in range(limit):  # the first of them applies the drive PDO before
        talker.cycle()
    before = talker.outputs()
    talker.cycle()
    talker.run(SETTLE_US)
    after, codes = talker.outputs(), talker.emergencies(mark)
    told = f"0x6411 {before} before SYNC {limit} without drive PDO, {after} after it, EMCY " + (
        ", ".join(f"0x{code:04X}" for code in codes) or "none"
    )
    if before != TEST_COUNTS or 0x8250 not in codes:
        raise DeviationError(told)
    if after != ZERO:
        _measure_if([told])
    return told


def _step_limit(talker: Talker) -> str:
    """One step as large as 0x2011 says, and one that is a count larger."""
    if not talker.driver.protection:
        raise NotTestedError("the bus configuration asks for no limit of the node's own")
    _energised(talker, lambda: talker.write(0x2011, 0, _STEP_MAX, 2), _RISE)
    beyond = (TEST_COUNTS[0] + _STEP_MAX + 1, *TEST_COUNTS[1:])
    mark = talker.mark()
    talker.send(talker.drive_id, talker.next_drive(beyond))
    talker.run(1000)
    talker.cycle()
    talker.run(SETTLE_US)
    outputs, codes = talker.outputs(), talker.emergencies(mark)
    told = f"comb 1 asked for {_STEP_MAX + 1} counts more, 0x2011 = {_STEP_MAX}: 0x6411 {outputs}, EMCY " + (
        ", ".join(f"0x{code:04X}" for code in codes) or "none"
    )
    if outputs == beyond or 0xFF14 not in codes:
        raise DeviationError(told, is_unsafe=outputs == beyond)
    if outputs != ZERO:
        _measure_if([told])
    return told


def _drive_timeout(talker: Talker) -> str:
    """Nothing of ours comes any more, no SYNC either, and our heartbeat may be away for longer than that."""
    if not talker.driver.protection:
        raise NotTestedError("the bus configuration asks for no time-out of the drive PDO")

    def configure() -> None:
        talker.write(0x2012, 0, _TIMEOUT_MS, 2)
        talker.write(0x1016, 1, talker.driver.controller_node_id << 16 | OUR_TIMEOUT_MAX_MS, 4)

    _energised(talker, configure)
    talker.cycles(2, TEST_COUNTS)
    mark = talker.mark()
    applied_us = talker.sync()
    talker.beating = False
    talker.run(1000 * _TIMEOUT_MS + SETTLE_US)
    told_us = [t_us for t_us, data in talker.since(mark, talker.emergency_id) if data[:2] == b"\x50\x82"]
    outputs = talker.outputs()
    if not told_us:
        raise DeviationError(f"no EMCY 0x8250 within {_TIMEOUT_MS} ms, 0x6411 reads {outputs}")
    after_ms = (told_us[0] - applied_us) / 1000
    told = f"0x2012 = {_TIMEOUT_MS} ms: EMCY 0x8250 {after_ms:.2f} ms after the last SYNC, 0x6411 reads {outputs}"
    if not _TIMEOUT_MS - 1 <= after_ms <= _TIMEOUT_MS + _HEARTBEAT_TOLERANCE_MS:
        raise DeviationError(told)
    if outputs != ZERO:
        _measure_if([told])
    return told


def _at_sync(talker: Talker) -> str:
    _energised(talker)
    talker.send(talker.drive_id, talker.next_drive(_OTHER))
    talker.run(1000)
    before = talker.outputs()
    talker.cycle()
    after = talker.outputs()
    if before != TEST_COUNTS or after != _OTHER:
        raise DeviationError(f"0x6411 {before} before the SYNC, {after} after it; sent {_OTHER}")
    return "applied at the SYNC, not before"


def _by_sdo(talker: Talker) -> str:
    if not talker.driver.protection:
        raise NotTestedError("without protection, CiA 401 allows it")
    _energised(talker)
    deviations = []
    for comb in (1, 2, 3):
        result = talker.write(0x6411, comb, _OTHER[comb - 1], 2)
        if not result.abort:
            deviations.append(f"0x6411:{comb:02X}: {result.text}")
    if (outputs := talker.outputs()) != TEST_COUNTS:
        deviations.append(f"0x6411 {outputs}")
    deviate_if(deviations)
    return "refused, outputs as before"


def _scaling(talker: Talker) -> str:
    _energised(talker)
    scale, told, deviations = talker.bus.analog.drive_volt_per_count, [], []
    for comb in range(3):
        for volts in _SCALE_VOLTS:
            count = round(volts / scale)
            a, b, c = (count if place == comb else 0 for place in range(3))
            talker.cycles(3, (a, b, c))
            talker.cycle()
            outputs = talker.outputs()
            told.append(f"comb {comb + 1} {count} counts = {count * scale:.3f} V")
            if outputs != (a, b, c):
                deviations.append(f"{told[-1]}: 0x6411 {outputs}")
    deviate_if(deviations)
    return "; ".join(told)


def _zeroed_first(perform: Callable[[Talker], str]) -> Callable[[Talker], str]:
    """However such a check ends, the next one finds the combs discharged."""

    def safely(talker: Talker) -> str:
        try:
            return perform(talker)
        finally:
            if talker.allow_voltage:
                talker.reset()

    return safely


_A, _B = "outputs", "outputs, with voltage"
_MODES, _PDO = "CiA 401, objects 6443h and 6444h", "CiA 301, 7.2.2 (PDO)"
CHECKS = (
    Check(_A, "after reset", "0x6411 reads 0 after either reset", SAFETY, _zeroed_first(_after_reset)),
    Check(_A, "error mode and value", "0x6443 and 0x6444 keep what is written", _MODES, _error_objects),
    Check(
        _A, "heartbeat consumer", "when ours stops: EMCY 0x8130 in time, pre-operational", OUR_CONTRACT, _heartbeat_lost
    ),
    Check(_B, HEARTBEAT_LOST, "outputs at their error value, 0", SAFETY, _zeroed_first(_heartbeat_outputs)),
    Check(_B, LEAVING, "outputs at their error value, 0", SAFETY, _zeroed_first(_leaving)),
    Check(_B, "error value", "mode 1 takes 0x6444, mode 0 keeps what is there", _MODES, _zeroed_first(_error_value)),
    Check(
        _B,
        "drive PDO missing",
        "after 0x2010 SYNCs without: outputs 0, EMCY 0x8250",
        OUR_CONTRACT,
        _zeroed_first(_drive_missing),
    ),
    Check(
        _B,
        DRIVE_TIMEOUT,
        "0x2012 ms without any frame of ours: outputs 0, EMCY 0x8250",
        OUR_CONTRACT,
        _zeroed_first(_drive_timeout),
    ),
    Check(
        _B, "own step limit", "a step beyond 0x2011: outputs 0, EMCY 0xFF14", OUR_CONTRACT, _zeroed_first(_step_limit)
    ),
    Check(_B, "applied at SYNC", "a drive PDO takes effect at the next SYNC", _PDO, _zeroed_first(_at_sync)),
    Check(_B, "drive by SDO", "with protection, counts other than 0 are refused", OUR_CONTRACT, _zeroed_first(_by_sdo)),
    Check(_B, "scaling", "0x6411 reads what was sent, comb by comb", OUR_CONTRACT, _zeroed_first(_scaling)),
)

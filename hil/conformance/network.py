"""NMT, boot-up, heartbeat, frame formats: checks of how the node behaves on the network."""

from collections.abc import Sequence
from itertools import pairwise

from hil.conformance.deviation import DeviationError, NotTestedError, deviate_if
from hil.conformance.talker import SETTLE_US, ZERO, Talker
from hil.conformance.verdict import OUR_CONTRACT, Check
from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.can.cob_id import NmtCommand, NmtState

_PERIOD_MS = 20
_BEATS = 20
_PERIOD_MEAN_SHARE = 0.1
_SYNCS = 5
_NAMES = {state.value: state.name.lower().replace("_", "-") for state in NmtState}


def _boot_up(talker: Talker) -> str:
    return _one_boot_up(talker, NmtCommand.RESET_NODE)


def _one_boot_up(talker: Talker, command: NmtCommand) -> str:
    talker.reset()
    begin_us, mark = talker.now_us, talker.mark()
    boot = talker.reset(command)
    if boot is None:
        raise DeviationError(f"nothing within {talker.driver.boot_timeout_us / 1000:g} ms")
    frames = [data for _, data in talker.since(mark, talker.heartbeat_id)]
    if frames[:1] != [b"\0"] or frames.count(b"\0") != 1:  # heartbeats may follow, where 0x1017 is set as it leaves
        raise DeviationError("; ".join(data.hex(" ") or "no bytes" for data in frames))
    return f"00 after {(boot[0] - begin_us) / 1000:.3g} ms"


def _communication_reset(talker: Talker) -> str:
    """CiA 301, 7.3.2.1.1.4: objects 0x1000 to 0x1FFF take their defaults, those of the application stay."""
    talker.reset()
    written = talker.write(0x6443, channel := talker.driver.drive_channels[0], 0, 1)
    talker.write(0x1017, 0, 100, 2)
    talker.reset(NmtCommand.RESET_COMMUNICATION)
    heartbeat, mode = talker.read(0x1017, 0), talker.read(0x6443, channel)
    default = next((v.default for v in talker.variables if (v.index, v.subindex) == (0x1017, 0)), None)
    deviations = []
    if default is not None and heartbeat.data != default:
        deviations.append(f"0x1017:00 {heartbeat.text}, default {default.hex(' ')}")
    if written.ok and mode.data != b"\0":
        deviations.append(f"0x6443:{channel:02X} {mode.text}, but 00 had been written")
    deviate_if(deviations)
    return "0x1017 at its default" + (f", 0x6443:{channel:02X} as written" if written.ok else "")


def _state(talker: Talker) -> int | None:
    """The state of the last heartbeat within a few periods; None if there is none."""
    mark = talker.mark()
    talker.run(5000 * _PERIOD_MS)
    beats = talker.since(mark, talker.heartbeat_id)
    return beats[-1][1][0] & 0x7F if beats and beats[-1][1] else None


def _beating_node(talker: Talker) -> None:
    talker.reset()
    talker.nmt(NmtCommand.PRE_OPERATIONAL)  # where a node that starts by itself is not
    talker.write(0x1017, 0, _PERIOD_MS, 2)
    if _state(talker) is None:
        raise NotTestedError("no heartbeats, so no state is seen")


def _states(talker: Talker) -> str:
    _beating_node(talker)
    talker.reset()
    talker.write(0x1017, 0, _PERIOD_MS, 2)
    booted = _state(talker)
    if booted not in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL):
        raise DeviationError(f"after boot-up: {_NAMES.get(booted, booted) if booted is not None else 'silent'}")
    path = (
        (NmtCommand.PRE_OPERATIONAL, NmtState.PRE_OPERATIONAL),
        (NmtCommand.START, NmtState.OPERATIONAL),
        (NmtCommand.STOP, NmtState.STOPPED),
        (NmtCommand.PRE_OPERATIONAL, NmtState.PRE_OPERATIONAL),
        (NmtCommand.STOP, NmtState.STOPPED),
        (NmtCommand.START, NmtState.OPERATIONAL),
        (NmtCommand.PRE_OPERATIONAL, NmtState.PRE_OPERATIONAL),
    )
    deviations = []
    for command, expected in path:
        talker.nmt(command)
        state = _state(talker)
        if state != expected:
            after = command.name.lower().replace("_", "-")
            deviations.append(f"after {after}: {_NAMES.get(state, state) if state is not None else 'silent'}")
    deviate_if(deviations)
    by_itself = " by itself (CiA 302-2, object 1F80h)" if booted == NmtState.OPERATIONAL else ""
    return f"boot-up, {_NAMES[booted]}{by_itself}, " + ", ".join(_NAMES[state] for _, state in path)


def _addressing(talker: Talker) -> str:
    _beating_node(talker)
    other = talker.node_id % 127 + 1
    deviations: list[str] = []
    for node_id, expected in ((other, NmtState.PRE_OPERATIONAL), (0, NmtState.OPERATIONAL)):
        talker.nmt(NmtCommand.START, node_id)
        if (state := _state(talker)) != expected:
            deviations.append(f"start of node {node_id}: {_NAMES.get(state, state) if state is not None else 'silent'}")
    deviate_if(deviations)
    return f"node {other}'s start is ignored, everyone's is obeyed"


def _sdo_by_state(talker: Talker) -> str:
    talker.reset()
    deviations = []
    for command, allowed in (
        (NmtCommand.PRE_OPERATIONAL, True),
        (NmtCommand.START, True),
        (NmtCommand.STOP, False),
        (NmtCommand.PRE_OPERATIONAL, True),
    ):
        talker.nmt(command)
        if talker.read(0x1000, 0).ok != allowed:
            deviations.append(f"after {command.name.lower()}: {'no answer' if allowed else 'answered'}")
    deviate_if(deviations)
    return "answered in pre-operational and operational, not in stopped"


def _pdo_by_state(talker: Talker) -> str:
    talker.operational()
    deviations = []
    for command, allowed in (
        (NmtCommand.START, True),
        (NmtCommand.PRE_OPERATIONAL, False),
        (NmtCommand.STOP, False),
        (NmtCommand.START, True),
    ):
        talker.nmt(command)
        mark = talker.mark()
        for _ in range(_SYNCS):
            talker.cycle()
        talker.run(SETTLE_US)
        if bool(talker.since(mark, talker.sense_id)) != allowed:
            deviations.append(f"after {command.name.lower()}: {'none' if allowed else 'sent'}")
    deviate_if(deviations)
    return "sense PDOs in operational only"


def _heartbeat_period(talker: Talker) -> str:
    talker.reset()
    talker.write(0x1017, 0, _PERIOD_MS, 2)
    mark = talker.mark()
    talker.run(1000 * _PERIOD_MS * _BEATS)
    times = [t_us for t_us, _ in talker.since(mark, talker.heartbeat_id)]
    if len(times) < 2:
        raise DeviationError(f"{len(times)} heartbeats in {_PERIOD_MS * _BEATS} ms")
    return period_told(times)


def period_told(times_us: Sequence[int]) -> str:
    """What is said of heartbeats. Their mean is judged, and that none is missing: single ones come early and late by
    the resolution of a system's timers and by how busy its host is, and CiA 301 has no word on that.
    """
    gaps_ms = [(b - a) / 1000 for a, b in pairwise(times_us)]
    mean_ms = sum(gaps_ms) / len(gaps_ms)
    told = f"{len(times_us)} heartbeats, {mean_ms:.2f} ms apart, {min(gaps_ms):.2f} to {max(gaps_ms):.2f}"
    if abs(mean_ms - _PERIOD_MS) > _PERIOD_MEAN_SHARE * _PERIOD_MS or max(gaps_ms) >= 2 * _PERIOD_MS:
        raise DeviationError(told)
    return told


def _heartbeat_in_the_loop(talker: Talker) -> str:
    talker.operational()
    mark = talker.mark()
    period_us = talker.bus.period_us
    talker.cycles(10_000 * talker.driver.node_heartbeat_period_ms // period_us)
    times = [t_us for t_us, _ in talker.since(mark, talker.heartbeat_id)]
    gaps_ms = [(b - a) / 1000 for a, b in pairwise(times)]
    limit_ms = talker.driver.node_heartbeat_timeout_ms
    if not gaps_ms or max(gaps_ms) >= limit_ms:
        raise DeviationError(
            f"{len(times)} heartbeats, up to {max(gaps_ms, default=0):.2f} ms apart, limit {limit_ms} ms"
        )
    return f"{len(times)} heartbeats, at most {max(gaps_ms):.2f} ms apart, limit {limit_ms} ms"


def _heartbeat_off(talker: Talker) -> str:
    _beating_node(talker)
    talker.write(0x1017, 0, 0, 2)
    talker.run(1000)
    if (state := _state(talker)) is not None:
        raise DeviationError(f"still beating, state {state}")
    return f"silent for {5 * _PERIOD_MS} ms"


def _formats(talker: Talker) -> str:
    if not talker.driver.fd:
        raise NotTestedError("classic bus")
    talker.reset()
    deviations = []
    for fd in (True, False):
        mark = talker.mark()
        talker.send(cob_id.SDO_REQUEST_BASE + talker.node_id, bytes.fromhex("40 00 10 00 00 00 00 00"), fd=fd)
        talker.first(cob_id.SDO_RESPONSE_BASE + talker.node_id, talker.driver.sdo_timeout_us)
        answers = cob_id.SDO_RESPONSE_BASE + talker.node_id  # some adapters return our own frames, too
        frames = [frame for _, frame in talker.heard[mark:] if frame.can_id == answers]
        asked = "FD" if fd else "classic"
        if not frames:
            deviations.append(f"{asked} request: no answer")
        deviations += [f"{asked} request: a classic answer" for frame in frames if not frame.is_fd]
    deviate_if(deviations)
    return "both formats are heard, answers are FD"


def _extended(talker: Talker) -> str:
    """An identifier of 29 bits with the same number is another identifier."""
    talker.operational()
    mark = talker.mark()
    talker.send(cob_id.NMT, bytes((NmtCommand.STOP, talker.node_id)), extended=True)
    talker.send(cob_id.SDO_REQUEST_BASE + talker.node_id, bytes.fromhex("40 00 10 00 00 00 00 00"), extended=True)
    talker.run(2000)
    for _ in range(_SYNCS):
        talker.cycle(talker.next_drive(ZERO))
    talker.run(SETTLE_US)
    deviations = []
    if talker.since(mark, cob_id.SDO_RESPONSE_BASE + talker.node_id):
        deviations.append("an SDO request with 29 bits was answered")
    if not talker.since(mark, talker.sense_id):
        deviations.append("an NMT stop with 29 bits was obeyed")
    deviate_if(deviations)
    return "ignored"


_A, _B, _C = "boot-up and NMT", "heartbeat", "frames"
_NMT, _STATES, _ERRORS = "CiA 301, 7.2.8 (NMT)", "CiA 301, 7.3.2 (NMT states)", "CiA 301, 7.2.8 (heartbeat)"
CHECKS = (
    Check(_A, "boot-up", "one frame, 00, within the boot time-out after NMT reset node", _NMT, _boot_up),
    Check(
        _A, "communication reset", "communication objects at defaults, application objects kept", _STATES,
        _communication_reset, False,
    ),
    Check(_A, "states", "pre-operational or by itself operational after boot-up, then as commanded", _STATES, _states),
    Check(_A, "addressing", "commands to other nodes are ignored, those to node 0 obeyed", _NMT, _addressing),
    Check(_A, "SDO by state", "answered in pre-operational and operational, not in stopped", _STATES, _sdo_by_state),
    Check(_A, "PDO by state", "sense PDOs in operational only", _STATES, _pdo_by_state),
    Check(
        _B, "heartbeat period",
        f"0x1017 = {_PERIOD_MS} ms: so far apart on average, within {_PERIOD_MEAN_SHARE:.0%}, and none is missing",
        _ERRORS, _heartbeat_period,
    ),
    Check(
        _B, "heartbeat in the loop", "with SYNC at rate, never later than the driver's time-out", OUR_CONTRACT,
        _heartbeat_in_the_loop,
    ),
    Check(_B, "heartbeat off", "0x1017 = 0: none", _ERRORS, _heartbeat_off),
    Check(
        _C, "formats", "on an FD bus, FD and classic requests are heard and answers are FD", OUR_CONTRACT, _formats
    ),
    Check(_C, "29-bit identifiers", "not taken for those with 11 bits", "CiA 301, 7.3.3 (identifiers)", _extended),
)  # fmt: skip

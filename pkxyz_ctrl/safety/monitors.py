"""The monitors: once a tick, everything that was observed against everything that is plausible.

One pure kernel, :func:`check`. It remembers only how long something has been wrong, and reports what has been wrong for
too long as bits of :class:`Trip`; latching the first report and acting on it is its caller's.

Two ways to count. A *state* (stale, at a rail, frozen, saturated) counts consecutive ticks, since one good tick proves
that it is over. An *event* (a bad CRC, a lost frame, a missed tick) fills a leaky bucket, since a good tick between two
of them proves nothing: each event adds one, each good tick takes away 1/leak_ticks. So a burst of N trips at the
N-th, and so does, later, any rate that stays above one in leak_ticks + 1.

One judgement is needed before the tick goes on: a stroke that is too far from where the filter expected it is not to be
believed (:func:`implausible_combs`). What is not believed corrupts no estimate, and so no voltage, until it has been
counted often enough.
"""

from enum import IntFlag
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.safety.modes import LOOP_CLOSED, NODE_EXPECTED, Mode
from pkxyz_ctrl.safety.trips import Trip


class SenseStatus(IntFlag):
    """What was wrong with this tick's sense frame; 0 is a good frame."""

    MISSING = 1
    COUNTER = 2
    CRC = 4
    LENGTH = 8
    DUPLICATE = 16
    IMPLAUSIBLE = 32  # a good frame with a stroke that is not believed; the cycle sets it


class NodeEvent(IntFlag):
    """What the supervision of the node saw since the last tick."""

    HEARTBEAT_LOST = 1
    NOT_OPERATIONAL = 2
    REBOOTED = 4
    EMERGENCY = 8
    FOREIGN_FRAME = 16
    SAFETY_OBJECTS = 32


# A count of 0 trips at once (a limit that was never filled in is a fault), a negative one switches that monitor off.
LIMITS: Final = np.dtype(
    [
        ("stroke_min_m", "f8"),
        ("stroke_max_m", "f8"),
        ("innovation_max_m", "f8", (3,)),
        ("residual_max_m", "f8"),
        ("innovation_share_m_per_n", "f8"),  # so much more of both while the commanded forces change ...
        ("force_forget_share", "f8"),  # ... of which a tick forgets this much
        ("unexplained_force_max_n", "f8"),
        ("force_change_max_n", "f8"),  # of the unexplained force about its trend ...
        ("force_change_share", "f8"),  # ... and this much of the change of the commanded force
        ("force_trend_share", "f8"),  # of its way that a trend goes in a tick
        ("saturation_slack_n", "f8"),  # least force withheld that counts
        ("voltage_step_max_v", "f8"),
        ("sense_count_min", "i4"),  # at or below is at the rail
        ("sense_count_max", "i4"),  # at or above is at the rail
        ("stale_count", "i4"),
        ("sequence_count", "i4"),
        ("crc_count", "i4"),
        ("length_count", "i4"),
        ("range_count", "i4"),
        ("frozen_count", "i4"),
        ("innovation_count", "i4"),
        ("residual_count", "i4"),
        ("unexplained_force_count", "i4"),
        ("saturation_count", "i4"),
        ("slew_count", "i4"),
        ("overrun_count", "i4"),
        ("solver_count", "i4"),
        ("frame_leak_ticks", "i4"),
        ("overrun_leak_ticks", "i4"),
        ("safe_cycles", "i4"),  # of modes.enable_event and clear_event
    ],
    align=True,
)
"""A law's own, from the [monitors] of its controller file; what the forces may be is explained in ``thresholds``.

The innovation is a few nm when all is well, up to 540 nm for a tick or two where a fast circle begins on the harsh
plant, and the shock of a snap is micrometres, hence 500 nm for an axis in five ticks. Identical counts for 50 ticks do
not happen while noise spans several counts (0.2^50). 250 ticks at a bound are 50 ms, longer than any move across the
workspace takes. A frame that is lost or late counts as it fails to come and as the next one's counter has jumped, one
that is repeated or out of order twice: four of them in short order are a fault, since the bus does neither.
"""

# Counts of ticks, except the *_level: events times the bucket's leak_ticks. All zero is a healthy beginning.
MONITOR_MEMORY: Final = np.dtype(
    [
        ("sequence_level", "i8"),
        ("crc_level", "i8"),
        ("length_level", "i8"),
        ("overrun_level", "i8"),
        ("residual_level", "i8", (3,)),
        ("unexplained_trend_n", "f8", (3,)),
        ("commanded_trend_n", "f8", (3,)),
        ("commanded_n", "f8", (3,)),  # forces of the last tick
        ("moved_n", "f8"),  # by how much, all in all, they have changed of late
        ("stale", "i4"),
        ("range", "i4", (3,)),
        ("frozen", "i4", (3,)),
        ("frozen_sense_count", "i4", (3,)),
        ("innovation", "i4", (3,)),
        ("unexplained_force", "i4", (3,)),
        ("saturation", "i4"),
        ("slew", "i4"),
        ("solver", "i4"),
    ],
    align=True,
)

OBSERVATION: Final = np.dtype(
    [
        ("stroke_m", "f8", (3,)),  # measured strokes relative to rest
        ("innovation_m", "f8", (3,)),  # measured minus predicted position, x y z
        ("unexplained_force_n", "f8", (3,)),  # at combs 1 2 3, what their forces lack or have too much
        ("commanded_force_n", "f8", (3,)),  # of combs 1 2 3, by the voltages that act
        ("voltage_step_v", "f8", (3,)),  # commanded now minus commanded one tick ago, combs 1 2 3
        ("implausible_combs", "i4"),  # of :func:`implausible_combs`, bit 0 for comb 1
        ("mode", "i4"),  # Mode in which this tick was computed
        ("sense_status", "i4"),  # SenseStatus
        ("node_events", "i4"),  # NodeEvent
        ("sense_count", "i4", (3,)),  # raw counts of this tick's frame
        ("saturated", "i4"),  # 1: the allocation ended at a bound
        ("overrun", "i4"),  # ticks missed since the last one
        ("solver_ok", "i4"),  # 0: the law's solver gave up and its fall-back was used
        ("finite", "i4"),  # 0: some output of this tick is NaN or infinite
    ],
    align=True,
)


UNUSABLE = SenseStatus.MISSING | SenseStatus.CRC | SenseStatus.LENGTH | SenseStatus.DUPLICATE
"""No sample of this tick came, or none that may be believed."""
_UNUSABLE = int(UNUSABLE)
_MISSING = int(SenseStatus.MISSING)
_IMPOSSIBLE = int(SenseStatus.COUNTER | SenseStatus.DUPLICATE)
_CRC = int(SenseStatus.CRC)
_LENGTH = int(SenseStatus.LENGTH)

_SENSE_STALE = int(Trip.SENSE_STALE)
_SENSE_SEQUENCE = int(Trip.SENSE_SEQUENCE)
_SENSE_CRC = int(Trip.SENSE_CRC)
_SENSE_LENGTH = int(Trip.SENSE_LENGTH)
_SENSE_RANGE_1 = int(Trip.SENSE_RANGE_1)
_SENSE_FROZEN_1 = int(Trip.SENSE_FROZEN_1)
_INNOVATION_X = int(Trip.INNOVATION_X)
_COMB_MISFIT_1 = int(Trip.COMB_MISFIT_1)
_COMB_FORCE_1 = int(Trip.COMB_FORCE_1)
_SATURATION = int(Trip.SATURATION)
_SLEW = int(Trip.SLEW)
_OVERRUN = int(Trip.OVERRUN)
_SOLVER = int(Trip.SOLVER)
_NOT_FINITE = int(Trip.NOT_FINITE)
_FOREIGN_FRAME = int(Trip.FOREIGN_FRAME)
_FOREIGN_EVENT = int(NodeEvent.FOREIGN_FRAME)
_SAFETY_OBJECTS, _SAFETY_EVENT = int(Trip.SAFETY_OBJECTS), int(NodeEvent.SAFETY_OBJECTS)
# NodeEvent's first four bits are Trip's four bits from HEARTBEAT_LOST on, in the same order.
_NODE_EVENTS = int(NodeEvent.HEARTBEAT_LOST | NodeEvent.NOT_OPERATIONAL | NodeEvent.REBOOTED | NodeEvent.EMERGENCY)
_NODE_SHIFT = int(Trip.HEARTBEAT_LOST).bit_length() - 1

_MODE_COUNT = len(Mode)
_ENOUGH = 1 << 30  # counting further would only overflow


@kernel
def _consecutive(ticks: int, bad: bool) -> int:
    if not bad:
        return 0
    return ticks + 1 if ticks < _ENOUGH else ticks


@kernel
def _bucket(level: int, events: int, leak_ticks: int) -> int:
    if events > 0:
        return level + int(events) * int(leak_ticks) if level < _ENOUGH else level
    return level - 1 if level > 0 else 0


@kernel
def _reached(ticks: int, limit: int, trip: int) -> int:
    return trip if limit >= 0 and ticks >= limit else 0


@kernel
def _filled(level: int, limit: int, leak_ticks: int, trip: int) -> int:
    return trip if limit >= 0 and level >= int(limit) * int(leak_ticks) else 0


@kernel
def clear_memory(memory: np.void) -> None:
    """Forget all; ``memory`` is a record of MONITOR_MEMORY."""
    memory["sequence_level"] = 0
    memory["crc_level"] = 0
    memory["length_level"] = 0
    memory["overrun_level"] = 0
    memory["stale"] = 0
    for i in range(3):
        memory["range"][i] = 0
        memory["frozen"][i] = 0
    _clear_loop(memory)


@kernel
def _clear_loop(memory: np.void) -> None:
    memory["saturation"] = 0
    memory["slew"] = 0
    memory["solver"] = 0
    for i in range(3):
        memory["innovation"][i] = 0
        memory["residual_level"][i] = 0
        memory["unexplained_force"][i] = 0
        memory["unexplained_trend_n"][i] = 0.0
        memory["commanded_trend_n"][i] = 0.0
        memory["commanded_n"][i] = 0.0
    memory["moved_n"] = 0.0


@kernel
def _note_motion(limits: np.void, memory: np.void, obs: np.void) -> None:
    """Add this tick's change of the commanded forces, which begin to act now, to what is remembered of them."""
    moved_n = memory["moved_n"] * (1.0 - limits["force_forget_share"])
    for i in range(3):
        moved_n += abs(obs["commanded_force_n"][i] - memory["commanded_n"][i])
        memory["commanded_n"][i] = obs["commanded_force_n"][i]
    memory["moved_n"] = moved_n if moved_n < np.inf else 0.0  # what is not finite leaves no trace


@kernel
def _of_motion_m(limits: np.void, memory: np.void) -> float:
    """What an imperfect device may be off by, beside noise, as its forces change."""
    return float(limits["innovation_share_m_per_n"] * memory["moved_n"])


@kernel
def implausible_combs(limits: np.void, memory: np.void, residual_m: NDArray[np.float64]) -> int:
    """Combs whose measured stroke is further from the expected one than plausible, bit 0 for comb 1.

    ``residual_m`` (3,): measured less expected strokes. While any bit is set the measurement is not to be used. Combs
    that are less than a third as far off as the worst one are only dragged along by it, and not named.
    """
    combs: int = 0
    allowed_m = limits["residual_max_m"] + _of_motion_m(limits, memory)
    widest = max(abs(residual_m[0]), abs(residual_m[1]), abs(residual_m[2]))
    for i in range(3):
        beyond = not abs(residual_m[i]) <= allowed_m  # NaN counts as beyond
        if beyond and not abs(residual_m[i]) < widest / 3.0:
            combs |= 1 << i
    return combs


@kernel
def _check_frames(limits: np.void, memory: np.void, obs: np.void) -> int:
    status = obs["sense_status"]
    leak = limits["frame_leak_ticks"]
    events = 1 if status & (_MISSING | _IMPOSSIBLE) else 0
    if status & _IMPOSSIBLE and (status & _MISSING or memory["stale"] == 0):
        events = 2  # not the echo of a loss: a frame that nobody can have sent now
    memory["stale"] = _consecutive(memory["stale"], (status & _UNUSABLE) != 0)
    memory["sequence_level"] = _bucket(memory["sequence_level"], events, leak)
    memory["crc_level"] = _bucket(memory["crc_level"], 1 if status & _CRC else 0, leak)
    memory["length_level"] = _bucket(memory["length_level"], 1 if status & _LENGTH else 0, leak)
    trips: int = _reached(memory["stale"], limits["stale_count"], _SENSE_STALE)
    trips |= _filled(memory["sequence_level"], limits["sequence_count"], leak, _SENSE_SEQUENCE)
    trips |= _filled(memory["crc_level"], limits["crc_count"], leak, _SENSE_CRC)
    trips |= _filled(memory["length_level"], limits["length_count"], leak, _SENSE_LENGTH)
    return trips


@kernel
def _check_channels(limits: np.void, memory: np.void, obs: np.void) -> int:
    """Range and frozen, per comb; only a usable frame is evidence, for or against."""
    trips: int = 0
    for i in range(3):
        count = obs["sense_count"][i]
        stroke_m = obs["stroke_m"][i]
        in_range = limits["sense_count_min"] < count < limits["sense_count_max"]
        # NaN fails both comparisons, hence is out of range.
        in_range = in_range and stroke_m >= limits["stroke_min_m"] and stroke_m <= limits["stroke_max_m"]
        memory["range"][i] = _consecutive(memory["range"][i], not in_range)
        same = count == memory["frozen_sense_count"][i]
        memory["frozen"][i] = _consecutive(memory["frozen"][i], same) if same else 1  # how often in a row, this one too
        memory["frozen_sense_count"][i] = count
        trips |= _reached(memory["range"][i], limits["range_count"], _SENSE_RANGE_1 << i)
        trips |= _reached(memory["frozen"][i], limits["frozen_count"], _SENSE_FROZEN_1 << i)
    return trips


@kernel
def _check_residuals(limits: np.void, memory: np.void, obs: np.void) -> int:
    """Whose strokes have been implausible too often. One comb alone: something is wrong with that comb. Several: the
    stage has moved, along the axes that the innovation shows.
    """
    leak = limits["frame_leak_ticks"]
    involved = 0
    combs: int = 0
    for i in range(3):
        level = _bucket(memory["residual_level"][i], obs["implausible_combs"] >> i & 1, leak)
        memory["residual_level"][i] = level
        involved += 1 if level > int(leak) else 0  # more than a single outlier
        combs |= _filled(level, limits["residual_count"], leak, _COMB_MISFIT_1 << i)
    if combs == 0 or involved <= 1:
        return combs
    widest = 0.0
    for k in range(3):
        widest = max(widest, abs(obs["innovation_m"][k]))
    axes: int = 0
    for k in range(3):
        # as far as the widest, or nearly: NaN included, so that some axis is always named
        axes |= 0 if abs(obs["innovation_m"][k]) < 0.5 * widest else _INNOVATION_X << k
    return axes


@kernel
def _check_forces(limits: np.void, memory: np.void, obs: np.void) -> int:
    """Whose force is not that of its voltage: by too much altogether, or by too much of what has changed of late.

    An imperfect device is off in proportion, and so is its change; a comb that does not obey, or whose stroke is not
    seen, is off by all of the change.
    """
    trips: int = 0
    share = limits["force_trend_share"]
    for i in range(3):
        force_n, commanded_n = obs["unexplained_force_n"][i], obs["commanded_force_n"][i]
        if abs(force_n) + abs(commanded_n) < np.inf:  # what is not finite leaves no trace
            memory["unexplained_trend_n"][i] += share * (force_n - memory["unexplained_trend_n"][i])
            memory["commanded_trend_n"][i] += share * (commanded_n - memory["commanded_trend_n"][i])
        change_n = abs(force_n - memory["unexplained_trend_n"][i])
        asked_n = abs(commanded_n - memory["commanded_trend_n"][i])
        # Written as "not within", so that NaN counts as beyond.
        astray = not abs(force_n) <= limits["unexplained_force_max_n"]
        astray = astray or not change_n <= limits["force_change_max_n"] + limits["force_change_share"] * asked_n
        memory["unexplained_force"][i] = _consecutive(memory["unexplained_force"][i], astray)
        trips |= _reached(memory["unexplained_force"][i], limits["unexplained_force_count"], _COMB_FORCE_1 << i)
    return trips


@kernel
def _check_loop(limits: np.void, memory: np.void, obs: np.void) -> int:
    """What has a meaning only while the loop is closed."""
    trips: int = 0
    too_fast, of_motion_m = False, _of_motion_m(limits, memory)
    _note_motion(limits, memory, obs)
    for i in range(3):
        beyond = not abs(obs["innovation_m"][i]) <= limits["innovation_max_m"][i] + of_motion_m
        memory["innovation"][i] = _consecutive(memory["innovation"][i], beyond)
        trips |= _reached(memory["innovation"][i], limits["innovation_count"], _INNOVATION_X << i)
        too_fast = too_fast or not abs(obs["voltage_step_v"][i]) <= limits["voltage_step_max_v"]
    memory["saturation"] = _consecutive(memory["saturation"], obs["saturated"] != 0)
    memory["slew"] = _consecutive(memory["slew"], too_fast)
    memory["solver"] = _consecutive(memory["solver"], obs["solver_ok"] == 0)
    trips |= _reached(memory["saturation"], limits["saturation_count"], _SATURATION)
    trips |= _reached(memory["slew"], limits["slew_count"], _SLEW)
    trips |= _reached(memory["solver"], limits["solver_count"], _SOLVER)
    return trips | _check_forces(limits, memory, obs) | _check_residuals(limits, memory, obs)


@kernel
def check(limits: np.void, memory: np.void, obs: np.void) -> int:
    """Trip bits of this tick; 0 when all is well. Call once per tick, in every mode.

    ``limits``, ``memory``, ``obs`` are records of LIMITS, MONITOR_MEMORY and OBSERVATION; ``memory`` is updated. While
    no node is expected (BOOT, PRE_OPERATIONAL, FAULT) only a result that is not finite trips, and the memory is
    cleared, so that a cleared fault does not trip again from old counts.
    """
    trips: int = _NOT_FINITE if obs["finite"] == 0 else 0
    mode = obs["mode"]
    if mode < 0 or mode >= _MODE_COUNT or NODE_EXPECTED[mode] == 0:
        clear_memory(memory)
        return trips
    trips |= (int(obs["node_events"]) & _NODE_EVENTS) << _NODE_SHIFT
    if obs["node_events"] & _FOREIGN_EVENT != 0:
        trips |= _FOREIGN_FRAME
    if obs["node_events"] & _SAFETY_EVENT != 0:
        trips |= _SAFETY_OBJECTS
    leak = limits["overrun_leak_ticks"]
    memory["overrun_level"] = _bucket(memory["overrun_level"], obs["overrun"], leak)
    trips |= _filled(memory["overrun_level"], limits["overrun_count"], leak, _OVERRUN)
    trips |= _check_frames(limits, memory, obs)
    if obs["sense_status"] & _UNUSABLE == 0:
        trips |= _check_channels(limits, memory, obs)
    if LOOP_CLOSED[mode] != 0:
        trips |= _check_loop(limits, memory, obs)
    else:
        _clear_loop(memory)
    return trips

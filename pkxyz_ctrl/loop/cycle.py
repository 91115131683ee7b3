"""One period of the controller, compiled: events and modes, the tick, the monitors, the record.

This is where core and safety meet: neither knows the other. ``cycle`` is called once a period, by the
loop that waits for a clock and by the lane that does not; it reads ``memory["input"]`` and leaves
counts, mode and record in ``memory["row"]``.
"""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel, rare
from pkxyz_ctrl.core import demand, feed_hold, tick, youla
from pkxyz_ctrl.loop import landing, set_points
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import (
    LOOP_CLOSED,
    MAY_ENERGISE,
    NODE_EXPECTED,
    Event,
    Mode,
    clear_event,
    enable_event,
    next_homed,
    next_mode,
    next_safe_cycles,
)
from pkxyz_ctrl.safety.monitors import (
    LIMITS,
    MONITOR_MEMORY,
    OBSERVATION,
    UNUSABLE,
    SenseStatus,
    check,
    implausible_combs,
)
from pkxyz_ctrl.safety.trips import LANDS, Trip

Array = NDArray[np.float64]
Records = NDArray[np.void]

INPUT = np.dtype(
    [
        ("event", "i4"),  # what happened or was asked for since the last tick
        ("sense_status", "i4"),
        ("node_events", "i4"),
        ("overrun", "i4"),
        ("sense_count", "i4", (3,)),
        ("quiet", "i4"),  # 1: an operator asks for quiet holds, until it is 0 again
        ("trips", "i8"),  # Trip bits raised outside: a frame that the gate blocked, an operator's stop
        ("output_acting", "i4"),  # bits that the node's digital outputs were sent, as of this SYNC
    ],
    align=True,
)

LAW = np.dtype(
    [
        ("limits", LIMITS),
        ("period_us", "i8"),
        ("homing_ticks", "i4"),
        ("feed_hold_ticks", "i4"),  # even: how long the path takes to stop, and to be taken up again
        ("landing_ticks", "i4"),  # so long a stop leads down to rest ...
        ("braking_ticks", "i4"),  # ... of which so long it only takes the speed away
        ("autostart", "i4"),  # 1: home, enable and track by itself, as a scenario wants it
        ("quiet_holds", "i4"),  # 1: holds are quiet without being asked for
        ("tick", tick.LAW),  # last, as in it what only some laws have
    ],
    align=True,
)

MEMORY = np.dtype(
    [
        ("input", INPUT),
        ("monitors", MONITOR_MEMORY),
        ("observation", OBSERVATION),
        ("row", ROW),
        ("setpoint", "f8", (9,)),  # what is held while enabled and not tracking
        ("asked_m", "f8", (3,)),  # position that is asked for at this sample: "here" without a learnt shift
        ("here", "f8", (9,)),  # rows of the reference: at this sample ...
        ("now", "f8", (9,)),  # ... and where this tick's force begins and ends to act
        ("after", "f8", (9,)),
        ("later", "f8", (9,)),  # ... and a period after that
        ("rejected_innovation_m", "f8", (3,)),  # innovation of a measurement that was not believed
        ("phase", "f8"),  # where between reference_tick and the next row the path stands; 0 unless a hold was cut short
        ("feed_phase", "f8"),  # where the change of the path speed began, from reference tick 0
        ("tick_index", "i8"),
        ("reference_tick", "i8"),
        ("mode", "i4"),
        ("homed", "i4"),
        ("homing_count", "i4"),
        ("homing_sum", "i8", (3,)),
        ("safe_cycles", "i4"),
        ("suspects", "i4"),  # combs whose stroke was not believed in this tick, one bit each
        ("feed", "i4"),  # feed_hold.SLOWING, STEADY, STARTING
        ("feed_age", "i4"),
        ("landing_from", "f8", (9,)),  # row at which the way down began, where this tick's force begins to act
        ("landed_by", "i8"),  # Trip bits for which the stage is led down; 0: it was asked for
        ("landing_age", "i4"),  # ticks of the way down that have passed
        ("held", "i4"),  # 1: somebody asked to hold, and the automatic start leaves it at that
        ("tick", tick.MEMORY),  # last, as in it what only some laws have
    ],
    align=True,
)

_LINE_BYTES = 64  # of a cache: a vector that lies in two lines takes as long as two
_UNUSABLE = int(UNUSABLE)
_IMPLAUSIBLE = int(SenseStatus.IMPLAUSIBLE)
_NONE, _HOME, _HOMED, _ENABLE, _TRACK, _TRIP, _CLEAR = (
    int(e) for e in (Event.NONE, Event.HOME, Event.HOMED, Event.ENABLE, Event.TRACK, Event.TRIP, Event.CLEAR)
)
_LAND, _LANDED = int(Event.LAND), int(Event.LANDED)
_IDLE, _HOMING, _ENABLED, _TRACKING, _FAULT, _LANDING = (
    int(m) for m in (Mode.IDLE, Mode.HOMING, Mode.ENABLED, Mode.TRACKING, Mode.FAULT, Mode.LANDING)
)
_LANDS = int(LANDS)
_LANDS_ONCE = int(Trip.OVERRUN)  # a computer that is late on the way down, too, is not waited for


def new_memory(mode: Mode = Mode.BOOT) -> NDArray[np.void]:
    """Memory of a controller that has just been switched on, in a mode: nothing known, 0 V, no reference.

    The rows of what is learnt, through which every tick goes, begin with a line of the cache. zeros() would go through
    the fields of the record one by one.
    """
    room = bytearray(MEMORY.itemsize + _LINE_BYTES)
    begin = -np.frombuffer(room, MEMORY, 1)["tick"]["adaptation"].ctypes.data % _LINE_BYTES
    memory = np.frombuffer(room, MEMORY, 1, begin)
    memory["mode"] = mode
    return memory


@kernel
def cycle(law_array: Records, memory_array: Records, reference: Records) -> None:
    """One period. ``law_array`` (1,) of ``LAW``, ``memory_array`` (1,) of
    ``MEMORY``, ``reference`` (n,) of ``REFERENCE``.

    The row of ``reference_tick`` is the set-point at this sample; the law looks up to four rows further. Ticks before
    the first and past the last row are taken as these. What is added to the measurement while tracking passes round
    the loop: seen over added is the sensitivity.
    """
    observe(law_array, memory_array, reference)
    respond(law_array, memory_array)


@kernel
def observe(law_array: Records, memory_array: Records, reference: Records) -> None:
    """First part of the period: event and mode, measurement, estimate, the rows of the reference that count."""
    prepare(law_array, memory_array)  # unless it is done
    law, memory = law_array[0], memory_array[0]
    _handle(law, memory, _asked(law, memory))
    if memory["mode"] == _LANDING:
        _go_on_landing(law, memory)
    seen = memory["input"]
    usable = (seen["sense_status"] & _UNUSABLE) == 0
    set_points.reference_rows(law, memory, reference)  # long before they are read: see ``hil.lanes.fast.run_block``
    if NODE_EXPECTED[memory["mode"]] == 0:  # an estimate that ran away with what broke would outlive the clear
        tick.set_at_rest(law["tick"], memory["tick"])
    if usable:
        tick.measure(law["tick"], memory["tick"], seen["sense_count"])
        if memory["mode"] == _HOMING:
            _average(law, memory)
        if memory["mode"] == _TRACKING:
            set_points.excite(memory, reference)
    memory["suspects"] = _suspects(law, memory) if usable else 0
    believed = usable and memory["suspects"] == 0
    tick.estimate(law["tick"], memory["tick"], believed)
    if memory["suspects"] != 0:
        for i in range(3):
            memory["tick"]["estimate"]["innovation_m"][i] = memory["rejected_innovation_m"][i]
    quiet = law["quiet_holds"] != 0 or memory["input"]["quiet"] != 0
    youla.ask(memory["tick"]["youla"], quiet, memory["here"], memory["later"])


@kernel
def respond(law_array: Records, memory_array: Records) -> None:
    """Second part: law and voltages, monitors, record. A plan made between the two stands in ``memory["tick"]``."""
    law, memory = law_array[0], memory_array[0]
    state, seen, saturated = memory["tick"], memory["input"], 0
    if MAY_ENERGISE[memory["mode"]] != 0:
        now, after, later = memory["now"], memory["after"], memory["later"]
        saturated = 1 if tick.act(law["tick"], state, now, after, later) else 0
    else:
        tick.rest(law["tick"], state)
    trips = _monitor(law, memory, saturated)
    _write_row(law, memory, trips, saturated)
    usable = (seen["sense_status"] & _UNUSABLE) == 0
    memory["safe_cycles"] = next_safe_cycles(memory["safe_cycles"], memory["mode"], usable, tick.is_discharged(state))
    if memory["feed"] != feed_hold.STEADY:
        set_points.scale_time(law, memory)
    elif memory["mode"] == _TRACKING:
        memory["reference_tick"] += 1
    memory["tick_index"] += 1
    seen["event"] = _NONE
    seen["trips"] = 0
    state["plan_known"] = state["solver_iterations"] = 0


@kernel
def prepare(law_array: Records, memory_array: Records) -> None:
    """What the period has taught, and where the model of the set-points is led: whoever wants his voltages out first
    calls it behind them. Else it is the beginning of the next period, with the same result.
    """
    tick.prepare(law_array[0]["tick"], memory_array[0]["tick"])


@kernel
def _asked(law: np.void, memory: np.void) -> int:
    """The event of this tick: what came in, else the next step of the automatic start. Nobody enables before homing."""
    event = memory["input"]["event"]
    if event == _NONE and law["autostart"] != 0:
        mode = memory["mode"]
        if mode == _IDLE:
            event = _ENABLE if memory["homed"] != 0 else _HOME
        elif mode == _ENABLED and memory["held"] == 0:
            event = _TRACK
    settled = memory["safe_cycles"] >= law["limits"]["safe_cycles"]
    if event == _ENABLE:
        return enable_event(memory["homed"] != 0, settled)
    return clear_event(settled) if event == _CLEAR else event


@kernel
def _handle(law: np.void, memory: np.void, event: int) -> None:
    """Let an event act on the mode."""
    mode = memory["mode"]
    memory["row"]["event"] = event
    target = next_mode(mode, event)
    memory["homed"] = 1 if next_homed(memory["homed"] != 0, mode, event) else 0
    if target != mode:
        _enter(law, memory, mode, target)


@kernel
@rare
def _enter(law: np.void, memory: np.void, mode: int, target: int) -> None:
    """Leave a mode, and prepare what the one that is entered needs."""
    memory["mode"] = target
    if mode == _LANDING:
        set_points.end_landing(memory)
    if LOOP_CLOSED[target] == 0:
        memory["feed"] = feed_hold.STEADY
    if target == _LANDING:
        set_points.begin_landing(memory)
    elif target == _HOMING:
        memory["homing_count"] = 0
        memory["homing_sum"][:] = 0
        memory["tick"]["sense_zero_f"][:] = 0.0
        tick.set_at_rest(law["tick"], memory["tick"])
    elif target == _ENABLED and mode == _IDLE:
        memory["setpoint"][:] = 0.0
        memory["reference_tick"] = 0
        memory["phase"] = 0.0
        memory["feed"] = feed_hold.STEADY
        memory["held"] = 0
    elif target == _ENABLED and mode == _TRACKING:
        memory["held"] = 1
        set_points.turn_feed(law, memory, feed_hold.SLOWING)
    elif target == _TRACKING:
        if memory["held"] != 0:
            set_points.turn_feed(law, memory, feed_hold.STARTING)
        memory["held"] = 0


@kernel
def _go_on_landing(law: np.void, memory: np.void) -> None:
    """A tick of the way down; once the time is over the mode is left, wherever the stage is."""
    memory["landing_age"] += 1
    braking = law["braking_ticks"]
    down = (memory["landing_age"] - braking) / (law["landing_ticks"] - braking)
    memory["tick"]["landing_share"] = landing.share(down)
    if memory["landing_age"] >= law["landing_ticks"]:
        _handle(law, memory, _LANDED if memory["landed_by"] == 0 else _TRIP)


@kernel
def _suspects(law: np.void, memory: np.void) -> int:
    """Combs whose strokes are not to be believed, one bit each, and what the innovation would be; none in open loop."""
    if LOOP_CLOSED[memory["mode"]] == 0:
        return 0
    combs: int = implausible_combs(law["limits"], memory["monitors"], memory["tick"]["residual_m"])
    if combs != 0:
        origin, predicted = law["tick"]["estimator"]["operating_point_m"], memory["tick"]["estimate"]["predicted"]
        for i in range(3):
            memory["rejected_innovation_m"][i] = memory["tick"]["measurement_m"][i] - origin[i] - predicted[i]
    return combs


@kernel
def _average(law: np.void, memory: np.void) -> None:
    """Add this sample to the average at rest; once there are enough, that is where zero is."""
    for i in range(3):
        memory["homing_sum"][i] += memory["input"]["sense_count"][i]
    memory["homing_count"] += 1
    if memory["homing_count"] < law["homing_ticks"]:
        return
    sense = law["tick"]["sense"]
    for i in range(3):
        mean = memory["homing_sum"][i] / memory["homing_count"]
        memory["tick"]["sense_zero_f"][i] = sense["offset_f"] + sense["farad_per_count"] * mean - sense["rest_f"]
    tick.set_at_rest(law["tick"], memory["tick"])
    tick.measure(law["tick"], memory["tick"], memory["input"]["sense_count"])
    _handle(law, memory, _HOMED)


@kernel
def _monitor(law: np.void, memory: np.void, saturated: int) -> int:
    """Let the monitors look at this tick. A trip takes the voltages of this very tick to 0, or begins the way down."""
    seen, state, obs = memory["input"], memory["tick"], memory["observation"]
    obs["mode"], obs["sense_status"] = memory["mode"], seen["sense_status"]
    obs["node_events"], obs["overrun"] = seen["node_events"], seen["overrun"]
    slack_n = max(abs(state["slack_n"][0]), abs(state["slack_n"][1]), abs(state["slack_n"][2]))
    obs["saturated"] = 1 if saturated != 0 and not slack_n < law["limits"]["saturation_slack_n"] else 0
    obs["solver_ok"] = 0 if law["tick"]["kind"] == demand.PREDICTIVE and state["plan_known"] == 0 else 1
    obs["finite"] = 1 if tick.is_finite(state) else 0
    obs["implausible_combs"] = memory["suspects"]
    tick.unexplained_force(law["tick"], state, obs["unexplained_force_n"])
    tick.commanded_force(law["tick"], state, obs["commanded_force_n"])
    for i in range(3):
        obs["sense_count"][i] = seen["sense_count"][i]
        obs["stroke_m"][i] = state["stroke_m"][i]
        obs["innovation_m"][i] = state["estimate"]["innovation_m"][i]
        step = np.int32(state["count"][0, i] - state["count"][1, i])  # see ``voltage.force_limits``
        obs["voltage_step_v"][i] = law["tick"]["drive"]["volt_per_count"] * step
    trips = check(law["limits"], memory["monitors"], obs) | seen["trips"]
    if trips != 0 and memory["mode"] != _FAULT:
        is_landing = memory["mode"] == _LANDING
        if trips & ~(_LANDS & ~_LANDS_ONCE if is_landing else _LANDS) != 0:
            _handle(law, memory, _TRIP)
        else:
            memory["landed_by"] |= trips
            _handle(law, memory, _LAND)
        if memory["mode"] == _FAULT:
            tick.release(law["tick"], state)
    if memory["mode"] == _FAULT:  # where the reason is told
        trips |= memory["landed_by"]
        memory["landed_by"] = 0
    return trips


@kernel
def _write_row(law: np.void, memory: np.void, trips: int, saturated: int) -> None:
    row, seen, state = memory["row"], memory["input"], memory["tick"]
    estimate, drive, origin = state["estimate"], law["tick"]["drive"], law["tick"]["estimator"]["operating_point_m"]
    asked = memory["asked_m"]
    row["t_us"] = memory["tick_index"] * law["period_us"]
    row["tick"] = memory["tick_index"]
    row["reference_tick"] = memory["reference_tick"] if memory["mode"] == _TRACKING else -1
    row["mode"], row["trips"] = memory["mode"], trips
    row["sense_status"] = (seen["sense_status"] & ~_IMPLAUSIBLE) | (_IMPLAUSIBLE if memory["suspects"] != 0 else 0)
    row["request"], row["outside_trips"] = seen["event"], seen["trips"]
    row["node_events"], row["overrun"], row["saturated"] = seen["node_events"], seen["overrun"], saturated
    row["active_set_steps"] = state["active_set_steps"]
    row["solver_iterations"] = state["solver_iterations"]
    row["quiet"], row["output_acting"] = seen["quiet"], seen["output_acting"]
    adapts = law["tick"]["adaptation"]["on"] != 0
    row["warning"] = state["adaptation"]["cause"] if adapts else 0
    row["warning_share"] = state["adaptation"]["change"] if adapts else 0.0
    for i in range(3):
        row["sense_count"][i] = seen["sense_count"][i]
        row["drive_count"][i] = state["count"][0, i]
        row["reference_m"][i] = asked[i]
        row["measurement_m"][i] = state["measurement_m"][i]
        row["estimate_m"][i] = origin[i] + estimate["filtered"][i]
        row["estimate_m_per_s"][i] = estimate["filtered"][3 + i]
        row["disturbance_n"][i] = estimate["filtered"][6 + i]
        row["innovation_m"][i] = estimate["innovation_m"][i]
        row["learnt_n"][i] = state["adaptation"]["added_n"][i] if adapts else 0.0
        row["demand_n"][i] = state["demand_n"][i]
        row["slack_n"][i] = state["slack_n"][i]
        row["force_n"][i] = state["force_n"][i]
        row["voltage_v"][i] = drive["volt_per_count"] * state["count"][0, i]
        row["sense_f"][i] = state["sense_f"][i]

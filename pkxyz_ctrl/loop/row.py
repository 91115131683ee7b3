"""The record of one tick: what the controller saw, thought and did, with room for the truth beside it.

One row a tick, in blocks of a structured array. The names carry the units; ``columns`` spreads a field of three over x,
y, z or over combs 1, 2, 3: ``reference_m`` becomes ``reference_x_m`` ..., ``voltage_v`` becomes ``voltage_1_v`` ...
"""

import numpy as np

_VECTOR = ("f8", (3,))

CONTROLLER_FIELDS = [
    ("t_us", "i8"),  # start of the tick since tick 0, us
    ("tick", "i8"),  # number of the tick, 0 for the first
    ("reference_tick", "i8"),  # index into the trajectory, -1 before tracking
    ("mode", "i4"),  # safety.modes.Mode after this tick
    ("request", "i4"),  # safety.modes.Event that was asked for from outside
    ("event", "i4"),  # safety.modes.Event that this tick handled last: of the request, by itself, or a trip
    ("output", "i4"),  # bits of triggers for the node's digital outputs, meant for the next SYNC
    ("trips", "i8"),  # safety.trips.Trip bits raised in this tick
    ("outside_trips", "i8"),  # those of them that came from outside the cycle: the gate, an operator
    ("sense_status", "i4"),  # bits of the driver about the sense frame of this tick
    ("node_events", "i4"),  # bits of the driver: what the supervision of the node saw
    ("overrun", "i4"),  # ticks skipped before this one
    ("saturated", "i4"),  # 1 where a comb force met a bound
    ("active_set_steps", "i4"),  # active sets that the allocation tried; 1: no limit met, 0: no allocation
    ("solver_iterations", "i4"),  # of the predictive law's solver; 0 without one, negative if its answer was not used
    ("quiet", "i4"),  # 1: quiet holds are asked for
    ("warning", "i4"),  # 0, or what has changed since it was learnt: 1 to 3 a comb, 4 to 6 a chain's springs, 7 hinges
    ("output_acting", "i4"),  # bits of triggers that the node was sent, as of this SYNC
    ("output_late_ns", "i4"),  # how long before it acts the position of this tick's trigger is passed
    ("warning_share", "f8"),  # by how much what the warning names has changed, relative
    ("sense_count", "i4", (3,)),  # of the sense frame, as it was believed
    ("drive_count", "i4", (3,)),  # goes to the combs at the next SYNC
    ("reference_m", *_VECTOR),  # set-point at the sample of this tick
    ("measurement_m", *_VECTOR),  # position from this tick's sense frame alone, and the excitation, if there is one
    ("estimate_m", *_VECTOR),  # filtered position at the sample of this tick
    ("estimate_m_per_s", *_VECTOR),  # filtered velocity at the sample of this tick
    ("disturbance_n", *_VECTOR),  # estimated disturbance force at the platform
    ("innovation_m", *_VECTOR),  # measurement less its prediction
    ("learnt_n", *_VECTOR),  # what the feed-forward has more by what was learnt of the device
    ("demand_n", *_VECTOR),  # force at the platform that the law asks for
    ("slack_n", *_VECTOR),  # demand less what the combs will give
    ("force_n", *_VECTOR),  # comb forces commanded
    ("voltage_v", *_VECTOR),  # comb voltages commanded, as quantised
    ("sense_f", *_VECTOR),  # sense capacitance, offset removed
]

TRUTH_FIELDS = [
    ("position_m", *_VECTOR),  # true position at the sample of this tick
    ("stroke_m", *_VECTOR),  # true strokes at the sample of this tick
    ("comb_voltage_v", *_VECTOR),  # true voltage at the combs at the sample, before the new drive acts
    ("terminal_output", "f8"),  # bits at the node's digital outputs from the sample of this tick on
]

ROW = np.dtype(CONTROLLER_FIELDS + TRUTH_FIELDS, align=True)

COMB_FIELDS = frozenset({"sense_count", "drive_count", "force_n", "voltage_v", "sense_f", "stroke_m", "comb_voltage_v"})
"""Fields of three that belong to combs 1, 2, 3; the others belong to axes x, y, z."""

_UNIT_SUFFIXES = ("_m_per_s", "_count", "_m", "_n", "_v", "_f")


def columns(field: str) -> tuple[str, ...]:
    """Names of the scalar columns of one field of ``ROW``: the field itself, or
    three names with the axis before the unit.
    """
    if ROW[field].shape != (3,):
        return (field,)
    suffix = next(s for s in _UNIT_SUFFIXES if field.endswith(s))
    stem = field.removesuffix(suffix)
    return tuple(f"{stem}_{axis}{suffix}" for axis in ("123" if field in COMB_FIELDS else "xyz"))

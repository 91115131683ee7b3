"""The limits of the monitors as the shipped controller has them, and the reason of each."""

import numpy as np

from pkxyz_ctrl import Stage
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.law import design_law

REASONS = {
    "stroke": ("{stroke_min_m:um} to {stroke_max_m:um} um", "25 um are used"),
    "stale": ("{stale_count} ticks", "1 ms at 5 kHz, less than a period of the first mode"),
    "sequence": ("{sequence_count}, leak {frame_leak_ticks} ticks", "a lost or late frame counts twice"),
    "CRC, length": ("{crc_count}, {length_count}, leak {frame_leak_ticks} ticks",
                    "CAN repeats damaged frames itself, so one in 200 is a defect"),
    "range": ("{range_count} ticks", "one wild sample is an outlier, three are a sensor"),
    "frozen": ("{frozen_count} equal counts", "2 nm rms of noise never repeat 50 times"),
    "innovation": ("{innovation_max_m:nm} nm, {innovation_count} ticks",
                   "some nm when all is well, micrometres when something snaps"),
    "residual of a stroke": ("{residual_max_m:nm} nm, {residual_count} in all, leak {frame_leak_ticks}",
                             "up to 450 nm where a fast circle begins on the harsh plant"),
    "unexplained force at a comb": ("{unexplained_force_max_n:mN} mN, {unexplained_force_count} ticks",
                                    "an imperfect device lacks up to 0.64 mN, a dead comb 1.1 mN"),
    "its change, about a mean over 30 ms": (
        "{force_change_max_n:uN} uN + {force_change_share:%} of what was commanded, {unexplained_force_count} ticks",
        "an imperfect device is off by at most 38 %, a comb that does not obey by 100 %"),
    "saturation": ("{saturation_count} ticks", "longer than any move across the workspace"),
    "slew": ("{voltage_step_max_v:V} V a tick, at once", "the allocation keeps it; beyond it the program is wrong"),
    "overrun": ("{overrun_count} missed ticks, leak {overrun_leak_ticks}",
                "a burst of 2 ms, or one tick in 500 for long"),
    "solver": ("{solver_count} ticks", "the regulator that stands in for the plan is good for a few"),
}  # fmt: skip
"""By monitor: its limit, with the fields of ``monitors.LIMITS`` in units, and why it is what it is."""

_UNITS = {"um": 1e6, "nm": 1e9, "mN": 1e3, "uN": 1e6, "%": 100.0, "V": 1.0}


class _Quantity(float):
    """A number that is written in the unit that its format names."""

    def __format__(self, unit: str) -> str:
        written = f"{float(self) * _UNITS.get(unit, 1.0):.3g}"
        return f"{written} %" if unit == "%" else written


def limits() -> str:
    """A row for each monitor."""
    law = design_law(
        Stage.load("reconstructed"),
        load("controllers", "lqg", ControllerConfig),
        load("buses", "fd_5k", BusConfig),
        autostart=True,
    )
    held = law["limits"][0]
    values = {name: _Quantity(np.ravel(held[name])[0]) for name in held.dtype.names}
    rows = [f"| {name} | {limit.format(**values)} | {reason} |" for name, (limit, reason) in REASONS.items()]
    return "\n".join(["| limit | default | reason |", "| --- | --- | --- |", *rows])

"""Holds under what disturbs them, and the shortest step that anything could make: what limits are held against."""

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from hil.bench.rigs.motions import MIDDLE_M, error_m, rows_of_setup, setup_of
from pkxyz_ctrl.design.drive_limits import slew_counts
from pkxyz_ctrl.design.model.loop_plant import loop_plant
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory import Hold

STROKES_M = np.full(3, 12.5e-6)
HOLD_S = 1.0
_HOLDS = 40
"""Seeds: of one second the deviation is known to 3 %, of so many to 0.5 %."""


def held_nm(controller: str, *, quiet: bool = False, shaken_m_per_s2: float = 0.0, quality: float | None = None) -> Any:
    """(2, 3) in nm, of the true position in holds of 1 s at mid-workspace: rms about the set-point, and deviation."""
    setup, _ = setup_of([Hold(kind="hold", duration_s=HOLD_S)], controller, "nominal", MIDDLE_M)
    config, plant = setup.controller, setup.plant
    if quiet and config.youla is not None:
        config = config.model_copy(update={"youla": config.youla.model_copy(update={"quiet_holds": True})})
    base = {"on": shaken_m_per_s2 > 0.0, "density_m_per_s2_per_rt_hz": (shaken_m_per_s2,) * 3}
    changed: dict[str, Any] = {"base_noise": plant.base_noise.model_copy(update=base)}
    if quality is not None:
        changed["damping"] = plant.damping.model_copy(update={"on": True, "quality_factor": quality})
    run = dataclasses.replace(setup, controller=config, plant=plant.model_copy(update=changed))
    last, squares = round((HOLD_S - 0.05) / run.bus.period_s), np.zeros((2, 3))
    for seed in range(1, _HOLDS + 1):
        held = error_m(rows_of_setup(dataclasses.replace(run, seed=seed)))[-last:]
        squares += np.stack([np.mean(held**2, axis=0), held.var(axis=0)])
    return np.sqrt(squares / _HOLDS) * 1e9


@cache
def shortest_step_s(way_m: float, band_m: float) -> float:
    """The shortest time to a band about a point away, the longest of the axes: the fewest periods for which a linear
    programme finds comb forces that get there and stay, within voltage and slew, on the sampled stage with its delay.
    """
    setup, _ = setup_of([Hold(kind="hold", duration_s=HOLD_S)], "youla", "nominal", MIDDLE_M)
    stage, bus = Stage(setup.stage), setup.bus
    plant, position = loop_plant(stage, bus, STROKES_M), stage.forward_kinematics(STROKES_M)
    volts, gain = stage.holding_voltages(position), stage.force_gain_n_per_v2
    step_v = slew_counts(setup.controller, bus) * bus.analog.drive_volt_per_count
    slew_n, hold_n = 2.0 * gain * volts * step_v, gain * volts**2
    most_n = gain * setup.controller.limits.voltage_max_v**2 - hold_n
    pulls = stage.pulls(position).T
    longest = 0
    for axis in range(3):
        periods = next(
            n for n in range(1, 40) if _reaches(plant, pulls, axis, way_m, band_m, n, slew_n, -hold_n, most_n)
        )
        longest = max(longest, periods)
    return longest * bus.period_s


_STAYS = 25
"""Periods for which the stage has to stay in the band: half a swing of the slowest mode thrice."""


def _reaches(
    plant: Any, pulls: NDArray[np.float64], axis: int, way_m: float, band_m: float, periods: int,
    slew_n: NDArray[np.float64], least_n: NDArray[np.float64], most_n: NDArray[np.float64],
) -> bool:  # fmt: skip
    total = periods + _STAYS
    answers, power = [], plant.b @ pulls  # position (3,) for each comb's force, so many periods later
    for _ in range(total):
        answers.append(plant.c @ power)
        power = plant.a @ power
    rows, low, high = [], [], []
    for k in range(periods, total):
        rows.append(np.hstack([answers[k - j - 1] if j < k else np.zeros((3, 3)) for j in range(total)]))
        wanted = np.eye(3)[axis] * way_m
        low.append(wanted - band_m)
        high.append(wanted + band_m)
    reach, scale = np.vstack(rows), 1e-9
    slew = np.eye(3 * total) - np.eye(3 * total, k=-3)
    bound = np.tile(slew_n, total)
    result = scipy.optimize.linprog(
        np.zeros(3 * total),
        A_ub=np.vstack([reach, -reach, slew * 1e-6, -slew * 1e-6]) / np.r_[
            np.full((2 * len(reach), 1), scale), np.full((6 * total, 1), 1.0)
        ],
        b_ub=np.r_[np.concatenate(high) / scale, -np.concatenate(low) / scale, bound * 1e-6, bound * 1e-6],
        bounds=list(zip(np.tile(least_n, total), np.tile(most_n, total), strict=True)), method="highs",
    )  # fmt: skip
    return bool(result.status == 0)

"""How far the laws are from instability and how far they reject disturbances: computed, and one of them measured."""

import math

import numpy as np
from numpy.typing import NDArray

from hil.bench.rigs.figure import Figure
from hil.lanes.excitation import excitation, tones
from hil.lanes.lane import Lane
from hil.lanes.setup import bare_setup
from hil.studies.margins.excited import at_point
from hil.studies.margins.loop import Loop, agreement, over_changed_plants
from hil.studies.margins.measured import measure
from hil.studies.operating_point import operating_strokes
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.margins.margins import Margins
from pkxyz_ctrl.design.margins.rejection_limit import bode_limit_hz, delay_limit_hz
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.design.model.loop_plant import loop_plant
from pkxyz_ctrl.stage import Stage

LAW, SAMPLED = "youla", 500
PEAK_S, DISK, CHANGED = 1.9, 0.64, 2.5
SAMPLED_95, SAMPLED_MAX = 3.0, 4.0
"""Ms of sampled devices: 95 % of them, and the worst."""
FAST_PEAK_S = 2.0
REJECTED_HZ, RESONANCE_HZ = 200.0, 631.0
"""Up to where |S| has to stay below -3 dB: on fd_5k, and on local_20k, where that is the first resonance."""
BASELINES = ("pi_notch_robust", "irc_robust")
PERIODS = 6


def margins() -> list[Figure]:
    """The default law on ``fd_5k`` and ``robust_20k`` on ``local_20k``, at mid-workspace."""
    stage = Stage.load("reconstructed")
    middle = operating_strokes(stage, None)
    loop = _loop(stage, LAW, "fd_5k")
    found = loop.margins(middle)
    fast = _loop(stage, "robust_20k", "local_20k").margins(middle)
    reach = {name: _rejected_hz(_loop(stage, name, "fd_5k").margins(middle)) for name in BASELINES}
    tolerances = load("tolerances", "wide", Tolerances)
    changed = over_changed_plants(loop, tolerances.cases())
    sampled = np.array([loop.peak_sensitivity(tolerances.sample(seed)) for seed in range(1, SAMPLED + 1)])
    unstable = int(np.isinf(sampled).sum())
    case, worst = changed.worst
    words = ", ".join(f"{name} {hz:.0f} Hz" for name, hz in reach.items())
    each = "worst of x, y, z and MIMO, law youla, nominal plant"
    rejected, (bode, delay) = _rejected_hz(found), _limits_hz(stage, loop.bus, middle)
    return [
        Figure("margins.peak_s", _peak_s(found), "Ms", PEAK_S, "at most", detail=each),
        Figure("margins.disk", _disk(found), "disk margin", DISK, "at least", detail=each),
        Figure("margins.rejection", rejected, "Hz", REJECTED_HZ, "at least",
               detail=f"S below -3 dB up to; {each}; {rejected / delay:.2f} of the delay limit, {rejected / bode:.2f} "
               "of Bode's, which bear no changed plant"),
        Figure("margins.delay_limit", delay, "Hz", detail=f"no linear law with Ms {PEAK_S} has S below -3 dB further: "
               "Bode's integral, delay, sampling zero; an axis of the nominal plant, known exactly, without noise"),
        Figure("margins.bode_limit", bode, "Hz", detail="the same by Bode's integral alone"),
        Figure("margins.over_baselines", rejected / max(reach.values()), "times", 1.0, "at least",
               detail=f"as far as the commercial baseline and irc, each tuned to be as robust: {words}"),
        Figure("margins.changed_plants", worst if math.isfinite(worst) else 1e9, "Ms", CHANGED, "at most",
               detail=f"worst of {len(changed.cases)} changed plants at nine points: {case.name}"),
        Figure("margins.sampled_95", _finite(np.percentile(sampled, 95)), "Ms", SAMPLED_95, "at most",
               detail=f"95 % of {SAMPLED} sampled devices: everything at once, delay, poles and parasitic modes too"),
        Figure("margins.sampled_worst", _finite(sampled.max()), "Ms", SAMPLED_MAX, "at most",
               detail=f"the worst of them; {unstable} unstable"),
        Figure("margins.measured", _measured(loop, middle), "of bound", 1.0, "at most",
               detail="largest distance of S measured in the running loop from S computed, over what noise explains"),
        Figure("margins.local_20k_rejection", _rejected_hz(fast), "Hz", RESONANCE_HZ, "at least",
               detail="S below -3 dB up to; law robust_20k, worst of x, y, z and MIMO: to the first resonance"),
        Figure("margins.local_20k_peak_s", _peak_s(fast), "Ms", FAST_PEAK_S, "at most", detail="the same"),
    ]  # fmt: skip


def _loop(stage: Stage, controller: str, bus: str) -> Loop:
    config, on_bus = load("controllers", controller, ControllerConfig), load("buses", bus, BusConfig)
    return Loop(stage, on_bus, design_law(stage, config, on_bus, autostart=True))


def _limits_hz(stage: Stage, bus: BusConfig, strokes_m: NDArray[np.float64]) -> tuple[float, float]:
    """Bode's limit, and the least of the axes with the delay."""
    plant = loop_plant(stage, bus, strokes_m)
    return bode_limit_hz(bus.period_s, PEAK_S), min(delay_limit_hz(plant.axis(i), PEAK_S) for i in range(3))


def _finite(value: float) -> float:
    return float(value) if math.isfinite(value) else 1e9


def _peak_s(found: Margins) -> float:
    return max(each.peak_s for each in (*found.axes, found.mimo)) if found.stable else 1e9


def _disk(found: Margins) -> float:
    return min(each.disk_margin for each in (*found.axes, found.mimo)) if found.stable else 0.0


def _rejected_hz(found: Margins) -> float:
    return min(each.bandwidth_hz for each in (*found.axes, found.mimo)) if found.stable else 0.0


def _measured(loop: Loop, strokes_m: NDArray[np.float64]) -> float:
    period_ticks = round(1.0 / loop.bus.period_s)
    added = excitation(
        "multisine", tones(period_ticks, 120, 5), period_ticks=period_ticks, periods=PERIODS, amplitude_m=5e-9,
        first_tick=0, seed=1,
    )  # fmt: skip
    config = load("controllers", LAW, ControllerConfig)
    run = at_point(bare_setup("reconstructed", "nominal", config, loop.bus, 1), strokes_m, added)
    seen = measure(run, Lane.FAST)
    compared = agreement(seen, loop.response(strokes_m, seen.frequency_hz))
    return compared.largest / compared.bound

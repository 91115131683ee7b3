"""How well the default law follows beside the stage without any feedback: on the plant of the drawing, on a good and a
poor device, in a real room, and there after an identification."""

import dataclasses
from functools import cache

import numpy as np

from hil.bench.rigs.figure import Figure
from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup, bare_setup
from hil.runs.metrics import Metrics, RowFigures
from hil.runs.scenario import load_scenario
from hil.studies.identify.calibrated_stage import calibration_of
from hil.studies.identify.identification import Identification, identify
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load

OPEN_LOOP = "open_loop"
PLACES = {
    "nominal": ("reconstructed", "nominal"),
    "mild": ("reconstructed", "mild"),
    "harsh": ("reconstructed", "harsh"),
    "lab": ("lab", "lab"),
}
IDENTIFIED = "lab_identified"
ALLOWED_NM = {"nominal": 0.3}
"""By how much the law may be worse than nothing, where nothing is to be mended."""
STROKES_M = np.full(3, 12.5e-6)


def beside() -> list[Figure]:
    """About the set-point: raster and circle while scanning, and holds, in the axis in which the law errs most; the
    target is what the open loop has in that axis."""
    figures = []
    for place in (*PLACES, IDENTIFIED):
        for scenario in ("raster", "circle"):
            law, nothing = _run(scenario, place, None), _run(scenario, place, OPEN_LOOP)
            allowed = ALLOWED_NM.get(place, 0.0)
            what = [(scenario, "rms_error_nm", "while scanning")]
            if scenario == "raster":
                what.append(("hold", "hold_rms_nm", "in holds"))
            for name, key, words in what:
                ours, theirs = getattr(law, key), getattr(nothing, key)
                worst = max(ours, key=lambda axis: ours[axis])
                detail = f"rms about the set-point {words}, in {worst} ({_axes(ours)}); open loop {_axes(theirs)}"
                target = round(theirs[worst] + allowed, 2)
                figures.append(Figure(f"beside.{name}_{place}", ours[worst], "nm", target, "at most", None, detail))
    return figures


def _run(scenario: str, place: str, controller: str | None) -> RowFigures:
    """Figures of one run of the fast lane, with the scenario's own law or another.
    Raises ``RuntimeError`` on a fault."""
    setup = _setup(scenario, place, controller)
    metrics = Metrics(setup.trajectory, setup.bus.period_us)
    result = lanes.run(setup, Lane.FAST, on_block=metrics.update)
    if result.faults:
        raise RuntimeError(f"{scenario} on {place} with {setup.controller.name}: {result.faults[0]}")
    return metrics.figures()


def _setup(scenario: str, place: str, controller: str | None) -> Setup:
    stage, plant = PLACES["lab" if place == IDENTIFIED else place]
    setup = load_scenario(scenario, stage=stage, plant=plant, controller=controller).setup()
    if place != IDENTIFIED:
        return setup
    measured = calibration_of(_identified(), "bench")
    return dataclasses.replace(setup, stage=setup.stage.model_copy(update={"calibration": measured}))


@cache
def _identified() -> Identification:
    """What `pkxyz identify` finds on the plant lab, with the law that it takes."""
    law, bus = load("controllers", "lqg", ControllerConfig), load("buses", "fd_5k", BusConfig)
    return identify(bare_setup(*PLACES["lab"], law, bus, 1), STROKES_M, Lane.FAST)


def _axes(values: dict[str, float]) -> str:
    return " / ".join(f"{v:.2f}" for v in values.values())

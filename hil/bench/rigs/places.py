"""Where a law is tried: on the plant of the drawing, on a good and a poor device, in a real room, and there after an
identification."""

import dataclasses
from functools import cache

import numpy as np

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

PLACES = {
    "nominal": ("reconstructed", "nominal"),
    "mild": ("reconstructed", "mild"),
    "harsh": ("reconstructed", "harsh"),
    "lab": ("lab", "lab"),
}
"""Stage and plant of each."""
IDENTIFIED = "lab_identified"
STROKES_M = np.full(3, 12.5e-6)


def setup_at(scenario: str, place: str, controller: str | None) -> Setup:
    """A scenario at a place, with its own law or another."""
    stage, plant = PLACES["lab" if place == IDENTIFIED else place]
    setup = load_scenario(scenario, stage=stage, plant=plant, controller=controller).setup()
    if place != IDENTIFIED:
        return setup
    measured = calibration_of(_identified(), "bench")
    return dataclasses.replace(setup, stage=setup.stage.model_copy(update={"calibration": measured}))


@cache
def followed(scenario: str, place: str, controller: str | None) -> RowFigures:
    """Figures of one run of the fast lane there, whose bits are those of lockstep. Raises ``RuntimeError`` on a
    fault.
    """
    setup = setup_at(scenario, place, controller)
    metrics = Metrics(setup.trajectory, setup.bus.period_us)
    result = lanes.run(setup, Lane.FAST, on_block=metrics.update)
    if result.faults:
        raise RuntimeError(f"{scenario} on {place} with {setup.controller.name}: {result.faults[0]}")
    return metrics.figures()


@cache
def _identified() -> Identification:
    """What `pkxyz identify` finds on the plant lab, with the law that it takes."""
    law, bus = load("controllers", "lqg", ControllerConfig), load("buses", "fd_5k", BusConfig)
    return identify(bare_setup(*PLACES["lab"], law, bus, 1), STROKES_M, Lane.FAST)

"""The gate of the default law: better than no feedback wherever a device is not as drawn, hardly worse where it is."""

from functools import cache

import pytest

from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.runs.metrics import Metrics
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.files import names

MOTIONS = ("circle", "frames", "lissajous", "path", "raster", "spiral", "steps", "sweep")
"""Shipped scenarios that are no others on another plant."""
PLANTS = ("mild", "lab", "harsh")


@cache
def errors_nm(scenario, plant, law):
    """True rms error of each axis about the set-point, while scanning; the run ends without a fault."""
    run = load_scenario(scenario, plant=plant, controller=law).setup()
    metrics = Metrics(run.trajectory, run.bus.period_us)
    result = lanes.run(run, Lane.FAST, on_block=metrics.update)
    assert not result.faults
    return list(metrics.figures().rms_error_nm.values())


def test_the_gate_looks_at_every_shipped_motion():
    others = {n for n in names("scenarios") if n.rsplit("_", 1)[-1] in PLANTS}
    assert set(names("scenarios")) - others == {*MOTIONS, "faults"}


@pytest.mark.parametrize("scenario", MOTIONS)
def test_the_default_law_beats_the_open_loop_on_every_device_that_is_not_as_drawn(scenario):
    """On every axis: the error of the open loop on these is some hundred nm, at a jump too."""
    for plant in PLANTS:
        for ours, nothing in zip(
            errors_nm(scenario, plant, "youla"), errors_nm(scenario, plant, "open_loop"), strict=True
        ):
            assert 0.5 < ours < 0.75 * nothing


@pytest.mark.parametrize("scenario", MOTIONS)
def test_on_the_stage_as_drawn_it_loses_next_to_nothing(scenario):
    """There no feedback could be better than none, as all that it sees is noise: 0.3 nm at most, worst axis."""
    assert max(errors_nm(scenario, "nominal", "youla")) <= max(errors_nm(scenario, "nominal", "open_loop")) + 0.3

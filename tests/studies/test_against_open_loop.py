"""The gate of the default law: better than no feedback wherever a device is not as drawn, hardly worse where it is."""

import itertools
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
STAGES = {"lab": "lab"}
"""Of plants that are another stage than the one as drawn."""
ON_A_PLANT = tuple(n for n in names("scenarios") if n.rsplit("_", 1)[-1] in PLANTS)
"""Shipped scenarios that name such a plant themselves."""


@cache
def figures(scenario, plant, law):
    """Of the true position about the set-point; the run ends without a fault. Without a plant: on the scenario's."""
    run = load_scenario(scenario, plant=plant, stage=STAGES.get(plant), controller=law).setup()
    metrics = Metrics(run.trajectory, run.bus.period_us)
    result = lanes.run(run, Lane.FAST, on_block=metrics.update)
    assert not result.faults
    return metrics.figures()


def errors_nm(scenario, plant, law):
    """True rms error of each axis while scanning."""
    return list(figures(scenario, plant, law).rms_error_nm.values())


def holds_nm(scenario, plant, law):
    """... and in holds; none where the scenario has no hold."""
    return list((figures(scenario, plant, law).hold_rms_nm or {}).values())


def test_the_gate_looks_at_every_shipped_motion():
    assert set(names("scenarios")) - set(ON_A_PLANT) == {*MOTIONS, "faults"}
    assert {"raster_mild", "raster_lab", "circle_lab", "frames_lab", "raster_harsh", "frames_harsh"} <= set(ON_A_PLANT)


def test_the_plant_lab_has_the_taps_of_its_stage():
    """Which are not those of the stage as drawn: its sense chain lags."""
    delays_s = [load_scenario("circle", plant=p, stage=STAGES.get(p)).stage.sense.delay_s for p in PLANTS]
    assert delays_s == pytest.approx([0.0, 99.5e-6, 0.0], abs=1e-6)


@pytest.mark.parametrize(("scenario", "plant"), [*itertools.product(MOTIONS, PLANTS), *((n, None) for n in ON_A_PLANT)])
def test_the_default_law_beats_the_open_loop_on_every_device_that_is_not_as_drawn(scenario, plant):
    """On every axis, scanning and holding: the error of the open loop on these is some hundred nm, at a jump too."""
    for error in (errors_nm, holds_nm):
        for ours, nothing in zip(error(scenario, plant, "youla"), error(scenario, plant, "open_loop"), strict=True):
            assert 0.5 < ours < 0.75 * nothing


@pytest.mark.parametrize("scenario", MOTIONS)
def test_on_the_stage_as_drawn_it_loses_next_to_nothing(scenario):
    """There no feedback could be better than none, as all that it sees is noise: 0.3 nm at most, worst axis."""
    assert max(errors_nm(scenario, "nominal", "youla")) <= max(errors_nm(scenario, "nominal", "open_loop")) + 0.3


@pytest.mark.parametrize("scenario", [m for m in MOTIONS if m != "frames"])
def test_in_a_hold_on_the_stage_as_drawn_it_loses_what_rejection_costs(scenario):
    """Two-sided: 0.6 to 0.9 nm, and 1.05 in all, where 0.3 were asked for; docs/understand/margins.md has the trade."""
    ours, nothing = (max(holds_nm(scenario, "nominal", law)) for law in ("youla", "open_loop"))
    assert 0.5 < ours - nothing < 0.75
    assert ours < 1.05

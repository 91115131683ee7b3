"""What the default law has made of a stage that nobody has identified, after two seconds of its raster.

Noise differs from run to run, and with it the zero that a homing finds: so the figure is that of many seeds.
"""

import dataclasses

import numpy as np
import pytest

from hil.lanes import in_process
from hil.lanes.lane import Lane
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.trajectory import Raster, Trajectory
from sim.config.plant_file import SenseGain
from sim.config.structure import TableTilt

SEEDS = range(1, 21)
SCANS = 4  # the last one begins 2.2 s after the first line
ASKED_NM = 3.5


def last_raster(scenario, seed, **without):
    """RMS, mean and deviation (3, 3) of the error in the last of ``SCANS`` rasters, m; ``without`` of the plant."""
    loaded = load_scenario(scenario, seed=seed)
    segments = loaded.config.reference
    (at,) = (i for i, s in enumerate(segments) if isinstance(s, Raster))
    trajectory = Trajectory([*segments[:at], *[segments[at]] * SCANS, *segments[at + 1 :]])
    plant = loaded.plant.model_copy(update=without)
    duration_s = trajectory.duration_us * 1e-6 + 0.1  # of start-up
    setup = dataclasses.replace(loaded.setup(), trajectory=trajectory, plant=plant, duration_s=duration_s)
    blocks = []
    in_process.run(setup, Lane.FAST, on_block=lambda rows: blocks.append(rows.copy()))
    rows = np.concatenate(blocks)
    t_us = rows["reference_tick"] * setup.bus.period_us
    begin_us, end_us = [s.scan_us for s in trajectory.segments if s.scan_us][-1]
    assert begin_us > 2.0e6
    rows = rows[(t_us >= begin_us) & (t_us < end_us)]
    error_m = rows["position_m"] - rows["reference_m"]
    return np.array([np.sqrt(np.mean(error_m**2, axis=0)), error_m.mean(axis=0), error_m.std(axis=0)])


@pytest.mark.parametrize(
    ("scenario", "rms_nm", "within"),
    [
        ("raster_mild", (2.65, 2.90, 2.44), 20),
        ("raster_lab", (2.10, 2.87, 2.82), 18),
        ("raster", (1.01, 0.97, 0.94), 20),
    ],
)
def test_a_raster_of_a_stage_that_nobody_has_identified(scenario, rms_nm, within):
    """The quadratic mean over the seeds is within what is asked for, and so are most seeds in every axis; about its own
    mean the error is noise.
    """
    rms_m, _, deviation_m = np.stack([last_raster(scenario, seed) for seed in SEEDS], axis=1)
    found_nm = 1e9 * np.sqrt(np.mean(rms_m**2, axis=0))
    assert found_nm == pytest.approx(rms_nm, abs=0.1)
    assert found_nm.max() < ASKED_NM
    assert np.count_nonzero((1e9 * rms_m <= ASKED_NM).all(axis=1)) >= within
    assert 0.8e-9 < deviation_m.min() < deviation_m.max() < 1.9e-9


def test_most_of_what_is_left_is_what_nothing_inside_can_see():
    """The gain of the sense chains, and a tip off the plane that they sense: without both, the mean is a quarter."""
    off = {"sense_gain": SenseGain(), "table_tilt": TableTilt()}
    mean_m, left_m = (
        np.mean([last_raster("raster_lab", seed, **without)[1] for seed in SEEDS], axis=0) for without in ({}, off)
    )
    assert np.linalg.norm(mean_m) == pytest.approx(3.9e-9, abs=0.3e-9)
    assert np.linalg.norm(left_m) < 0.3 * np.linalg.norm(mean_m)

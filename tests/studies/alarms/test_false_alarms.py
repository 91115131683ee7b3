"""Imperfect devices, driven to the ends of their workspace with every monitor on: none of it is called a fault.

The loops are stable here. One that is not, on a device that its law was not made for, is a fault and has to be.
"""

import dataclasses
import itertools
from functools import cache

import numpy as np
import pytest
from loop_rig import monitor_limits, rows_of, stage

from hil.faults.fault import parse
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.controller import MonitorConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.safety.modes import LOOP_CLOSED, Mode
from pkxyz_ctrl.safety.trips import Trip
from pkxyz_ctrl.trajectory import Circle, Hold, Move, Trajectory
from sim.config import PlantConfig

GENTLE = {"velocity_max_m_per_s": 0.5e-3, "acceleration_max_m_per_s2": 0.05, "jerk_max_m_per_s3": 10.0}
BRISK = {"velocity_max_m_per_s": 2e-3, "acceleration_max_m_per_s2": 0.5, "jerk_max_m_per_s3": 500.0}


def at(strokes_um):
    return tuple(stage().forward_kinematics(np.array(strokes_um) * 1e-6))


def hold(duration_s):
    return Hold(kind="hold", duration_s=duration_s)


def move(strokes_um, limits):
    return Move(kind="move", to_m=at(strokes_um), **limits)


@cache
def corner_to_corner():
    """Every corner of the cube of strokes from 1 to 24 um, by way of the middle, as fast as one would."""
    parts = [hold(0.02), move((12.5,) * 3, GENTLE), hold(0.05)]
    for corner in itertools.product((1.0, 24.0), repeat=3):
        parts += [move(corner, BRISK), hold(0.02), move((12.5,) * 3, BRISK), hold(0.01)]
    return Trajectory(parts)


@cache
def circles():
    """4 um at 100 Hz, low, in the middle and high up."""
    parts = [hold(0.02)]
    for middle in (6.0, 12.5, 19.0):
        parts += [
            move((middle,) * 3, GENTLE),
            hold(0.05),
            Circle(kind="circle", radius_m=4e-6, frequency_hz=100.0, turns=6.0, lead_s=0.02),
            hold(0.05),
        ]
    return Trajectory(parts)


def poor(stiffness, combs, mass, quality_factor):
    """The nominal plant with so much of an error in all springs, in each comb, and in the mass."""
    plant = load("plants", "nominal", PlantConfig)
    spread = {"on": True, "leaf": (stiffness,) * 3, "crank_hinge": (stiffness,) * 3, "link_hinge": (stiffness,) * 3}
    return plant.model_copy(
        update={
            "stiffness_mismatch": plant.stiffness_mismatch.model_copy(update=spread),
            "comb_mismatch": plant.comb_mismatch.model_copy(update={"on": True, "relative": combs}),
            "mass_error": plant.mass_error.model_copy(update={"on": True, "relative": mass}),
            "damping": plant.damping.model_copy(update={"on": True, "quality_factor": quality_factor}),
        }
    )


@cache
def setup(law):
    return load_scenario("faults", controller=law).setup()


def driven(law, plant, trajectory):
    run = dataclasses.replace(
        setup(law), plant=plant, trajectory=trajectory, duration_s=0.1 + trajectory.duration_us * 1e-6
    )
    vars(run)["law"] = setup(law).law
    rows, _ = rows_of(run, "fast")
    return rows


def lacking_n(rows):
    """(n, 3), what the combs lack by the filter's disturbance and by what was learnt, while the loop is closed."""
    closed = rows[LOOP_CLOSED[rows["mode"]] != 0]
    back = np.linalg.inv(stage().jacobian(closed["reference_m"]))
    return np.einsum("nki,nk->ni", back, closed["disturbance_n"] - closed["learnt_n"])


LAWS = ["youla", "lqg", "lqg_wide", "pi_notch", "irc", "hinf", "mpc", "robust"]


@pytest.mark.parametrize("motion", [corner_to_corner, circles])
@pytest.mark.parametrize("law", LAWS)
def test_the_harsh_plant_at_full_stroke_is_no_fault(law, motion):
    rows = driven(law, load("plants", "harsh", PlantConfig), motion())
    assert Trip(int(np.bitwise_or.reduce(rows["trips"]))) == Trip(0)
    assert rows["mode"][-1] == Mode.TRACKING
    # two-sided: it is a poor device, and the limit is not far off for nothing
    assert 0.2e-3 < np.abs(lacking_n(rows)).max() < 0.3e-3


@pytest.mark.parametrize(
    ("stiffness", "combs", "mass", "quality_factor"),
    [
        (0.2, (-0.1, -0.1, -0.1), -0.1, 20.0),
        (0.2, (-0.1, 0.1, -0.1), 0.1, 5.0),
        (-0.2, (0.1, 0.1, 0.1), 0.1, 20.0),
        (-0.2, (0.1, 0.1, -0.1), -0.1, 200.0),
    ],
)
def test_the_worst_device_that_a_law_has_to_bear_is_no_fault(stiffness, combs, mass, quality_factor):
    """As far as 200 V take the stiffest one, and gently: a micrometre of innovation, where fast, is a fault."""
    parts = [hold(0.02), move((12.5,) * 3, GENTLE), hold(0.05)]
    for corner in itertools.product((3.0, 20.0), repeat=3):
        parts += [move(corner, GENTLE), hold(0.02)]
    rows = driven("lqg", poor(stiffness, combs, mass, quality_factor), Trajectory(parts))
    assert Trip(int(np.bitwise_or.reduce(rows["trips"]))) == Trip(0)
    assert rows["mode"][-1] == Mode.TRACKING
    assert 0.4e-3 < np.abs(lacking_n(rows)).max() < 0.7e-3


@pytest.mark.parametrize(
    "text",
    ["controller:lost_tick@0.512,ticks=2", "controller:lost_tick@0.5205,ticks=8", "bus.sense:drop@0.5203+0.0006"],
)
def test_lost_ticks_and_frames_in_a_scan_on_the_harsh_plant_are_survived(text):
    """Fewer than the monitors of ticks and frames allow: no other monitor takes their echo for something else."""
    run = load_scenario("raster_harsh", faults=[parse(text)]).setup()
    rows, result = rows_of(run, "lockstep")
    assert result.faults == ()
    assert result.missed_ticks in (2, 8, 3)
    assert rows["mode"][-1] == Mode.TRACKING


def test_a_controller_file_that_says_nothing_has_the_limits_of_the_monitors():
    """Those of ``thresholds``, in the law that runs."""
    limits = monitor_limits()
    defaults = {name: field.default for name, field in MonitorConfig.model_fields.items() if not field.is_required()}
    for name, value in defaults.items():
        if name not in ("force_trend_s", "innovation_memory_s"):
            assert (limits[name] == value).all(), name
    assert limits["unexplained_force_max_n"] == 0.8e-3
    assert limits["force_trend_share"][0] == pytest.approx(200e-6 / defaults["force_trend_s"], rel=1e-12)

"""Moves, sines and circles that are nearly too much for the trajectory check end without a fault under every law.

Jumps have their own tests (``test_jumps.py``).
"""

import dataclasses
import math
import random
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from loop_rig import rows_of, stage

from hil.lanes.setup import Setup
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.files import load, names
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.trajectory import Circle, Hold, Move, Sine, Trajectory, TrajectoryError
from pkxyz_ctrl.trajectory.check import DriveLimits, check_against
from sim.config import PlantConfig

BUS = {"robust_20k": "local_20k"}
GENTLE = {"velocity_max_m_per_s": 0.5e-3, "acceleration_max_m_per_s2": 0.05, "jerk_max_m_per_s3": 10.0}
BRISK = {"velocity_max_m_per_s": 2e-3, "acceleration_max_m_per_s2": 0.5, "jerk_max_m_per_s3": 500.0}
SEED, EACH = 3, 4
STARTS_UM, HIGHEST_HZ = (3.0, 21.0), 2000.0
SHORT = 0.99
"""What is driven is at least this share of what is refused."""

Scaled = Callable[[float], Move | Sine | Circle]


def somewhere(rng, low_um, high_um):
    return stage().forward_kinematics(np.array([rng.uniform(low_um, high_um) for _ in range(3)]) * 1e-6)


def far(rng, start_m) -> Scaled:
    """A way to be scaled, briskly."""
    way_m = somewhere(rng, 1.0, 24.0) - start_m
    return lambda s: Move(kind="move", to_m=tuple(start_m + s * way_m), **BRISK)


def fast(rng, start_m) -> Scaled:
    """A way in a time to be scaled."""
    to_m = tuple(somewhere(rng, 3.0, 22.0))
    return lambda s: Move(
        kind="move", to_m=to_m, velocity_max_m_per_s=2e-3 * s, acceleration_max_m_per_s2=s**2,
        jerk_max_m_per_s3=2e3 * s**3,
    )  # fmt: skip


def some_hz(rng):
    """From well below the resonances to well above."""
    return math.exp(rng.uniform(math.log(20.0), math.log(HIGHEST_HZ)))


def sine(rng, start_m) -> Scaled:
    axis, hz = rng.choice("xyz"), some_hz(rng)
    return lambda s: Sine(kind="sine", axis=axis, amplitude_m=1e-6 * s, frequency_hz=hz, cycles=max(2.0, 0.06 * hz))


def circle(rng, start_m) -> Scaled:
    hz = some_hz(rng)
    return lambda s: Circle(kind="circle", radius_m=1e-6 * s, frequency_hz=hz, turns=max(2.0, 0.06 * hz))


def whole(start_m, motion):
    return Trajectory(
        [
            Hold(kind="hold", duration_s=0.02),
            Move(kind="move", to_m=tuple(start_m), **GENTLE),
            Hold(kind="hold", duration_s=0.02),
            motion,
            Hold(kind="hold", duration_s=0.02),
        ]
    )


def is_accepted(trajectory, drive):
    try:
        check_against(stage(), trajectory, drive)
    except TrajectoryError:
        return False
    return True


def nearly_refused(start_m, scaled, drive):
    """The last that is accepted, scaled up until one is refused."""
    accepted, refused = 0.01, math.inf
    assert is_accepted(whole(start_m, scaled(accepted)), drive)
    while accepted < SHORT * refused:
        tried = 1.5 * accepted if refused == math.inf else 0.5 * (accepted + refused)
        if is_accepted(whole(start_m, scaled(tried)), drive):
            accepted = tried
        else:
            refused = tried
    return whole(start_m, scaled(accepted))


@cache
def trajectories(drive):
    rng, found = random.Random(SEED), []
    for kind in (far, fast, sine, circle):
        for _ in range(EACH):
            start_m = somewhere(rng, *STARTS_UM)
            found.append(nearly_refused(start_m, kind(rng, start_m), drive))
    return found


@cache
def designed(law) -> Setup:
    return load_scenario("raster", controller=law, bus=BUS.get(law)).setup()


@pytest.mark.parametrize("plant", ["nominal", "mild"])
@pytest.mark.parametrize("law", names("controllers"))
def test_no_motion_that_the_check_accepts_ends_in_a_fault(law, plant):
    setup = designed(law)
    for trajectory in trajectories(DriveLimits.of(setup.controller, setup.bus)):
        run = dataclasses.replace(
            setup,
            plant=load("plants", plant, PlantConfig),
            trajectory=trajectory,
            duration_s=trajectory.duration_us * 1e-6 + 0.07,
        )
        vars(run)["law"] = setup.law
        rows, result = rows_of(run, "fast")
        assert result.faults == (), trajectory.segments[3]
        assert rows["mode"][-1] == Mode.TRACKING

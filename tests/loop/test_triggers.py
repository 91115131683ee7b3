"""Triggers of a scan against the truth: where the stage really was when a bit acted."""

import numpy as np
import pytest
from loop_rig import rows_of

from hil.runs.scenario import load_scenario
from hil.server.paths import Planner
from pkxyz_ctrl.config.triggers import FRAME, LINE, PIXEL, POSITION
from pkxyz_ctrl.loop.outputs import POSITION_TRIGGER, position_bit
from pkxyz_ctrl.safety.modes import Mode


def trigger(**fields):
    record = np.zeros(1, POSITION_TRIGGER)
    for name, value in fields.items():
        record[name] = value
    return record[0]


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("axis", [0, 1])
def test_positions_are_passed_when_the_truth_passes_them(axis):
    """Of the default raster: error at the trigger at most 1.2 times the tracking error, and no tick of bias."""
    scenario = load_scenario("raster", controller="youla")
    rows, _ = rows_of(scenario.setup(), "fast")
    period_s = scenario.bus.period_s
    rows = rows[rows["mode"] == Mode.TRACKING]
    pitch_m = 0.25e-6 if axis == 0 else 0.2e-6
    grid = trigger(axis=axis, start_m=-1.9e-6, pitch_m=pitch_m, count=16)
    velocity = np.gradient(rows["reference_m"], period_s, axis=0)
    then = np.concatenate([rows["reference_m"], velocity, np.gradient(velocity, period_s, axis=0)], axis=1)
    late_ticks, errors, speeds = [], [], []
    truth = rows["position_m"][:, axis]
    for n in range(len(rows) - 2):
        if not position_bit(grid, rows["reference_m"][n], then[n + 1], rows["estimate_m"][n], period_s):
            continue
        at, speed = float(grid["at_m"]), float(velocity[n + 1][axis])
        if abs(speed) < 20e-6:
            continue
        passed = [k for k in range(n - 1, n + 3) if (truth[k] - at) * (truth[k + 1] - at) <= 0.0]
        assert passed, (n, at)
        k = passed[0]
        crossing = k + (at - truth[k]) / (truth[k + 1] - truth[k])
        late_ticks.append(n + 1 - crossing)
        late_s = float(grid["late_s"])
        errors.append(truth[n + 1] - speed * late_s + 0.5 * then[n + 1, 6 + axis] * late_s**2 - at)
        speeds.append(speed)
    assert len(errors) > (300 if axis == 0 else 30)
    moving = np.abs(velocity[:, axis]) >= 20e-6
    tracking_m = rms((rows["position_m"] - rows["reference_m"])[moving, axis])
    assert rms(errors) <= 1.2 * tracking_m < 1.2 * 1.1e-9
    assert abs(np.mean(late_ticks)) < 0.1
    assert np.abs(late_ticks).max() < 0.5 + 4.0 * tracking_m / (20e-6 * period_s)
    assert rms(late_ticks) < 0.35, "a tick is 1/sqrt(12) of one"


@pytest.mark.parametrize(("direction", "expected"), [(1, [0, 1, 2]), (-1, [2, 1, 0]), (0, [0, 1, 2, 2, 1, 0])])
def test_a_direction_is_kept_there_and_back(direction, expected):
    period_s = 1e-3
    grid = trigger(axis=0, direction=direction, start_m=0.0, pitch_m=1e-6, count=3)
    x = np.concatenate([np.linspace(-1e-6, 3.5e-6, 100), np.linspace(3.5e-6, -1e-6, 100)])
    fired = []
    for n in range(len(x) - 1):
        now, then = np.array([x[n], 0, 0]), np.zeros(9)
        then[0], then[3] = x[n + 1], (x[n + 1] - x[n]) / period_s
        if position_bit(grid, now, then, now, period_s):
            fired.append(round(float(grid["at_m"]) * 1e6))
    assert fired == expected


def test_standing_noise_fires_nothing():
    period_s = 1e-3
    rng = np.random.default_rng(3)
    still = trigger(axis=0, start_m=0.0, pitch_m=1e-6, count=1)
    zero = np.zeros(3)
    assert not any(position_bit(still, zero, np.zeros(9), rng.normal(0, 1e-9, 3), period_s) for _ in range(1000))


def test_lines_pixels_and_frames_are_those_of_the_path():
    path = Planner("reconstructed", "youla", "fd_5k").of_scenario("frames", 16)
    lines = np.array(path.lines, np.int64)
    assert len(lines) == 80
    assert lines[:, 2].tolist() == [n // 10 for n in range(80)]
    bits = path.outputs(0, path.rows)
    speed = np.array([path.sample(row, 1)[0, 3] for row in range(path.rows)])
    on_line = (bits & LINE) != 0
    assert on_line.sum() == (lines[:, 1] - lines[:, 0]).sum()
    assert np.ptp(np.abs(speed[on_line])) < 1e-9 * np.abs(speed).max(), "at constant velocity"
    starts = np.flatnonzero(on_line & ~np.roll(on_line, 1))
    assert starts.tolist() == lines[:, 0].tolist()
    assert ((bits[starts] & FRAME) != 0).tolist() == [n % 10 == 0 for n in range(80)]
    pixel = (bits[lines[3, 0] : lines[3, 1]] & PIXEL) != 0
    assert np.count_nonzero(pixel & ~np.concatenate([[False], pixel[:-1]])) == 16
    assert not (bits & POSITION).any()

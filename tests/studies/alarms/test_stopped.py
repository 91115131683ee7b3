"""Sampled devices that are stopped in the middle of a scan: led down, none meets its stops."""

import pytest
from stopped import stopped

from pkxyz_ctrl.safety.trips import Trip


@pytest.mark.parametrize("law", ["youla", "open_loop", "lqg", "robust", "mpc"])
@pytest.mark.parametrize("scenario", ["circle", "steps"])
def test_no_sampled_device_meets_its_stops_when_it_is_led_down(scenario, law):
    """`python tests/studies/alarms/stopped.py` has 500 of them, at eight instants each."""
    lowest = [
        low for seed in range(3 if law == "mpc" else 12) for hits, low in stopped(scenario, law, seed, Trip.OPERATOR)
    ]
    hits = [hits for seed in range(3) for hits, _ in stopped(scenario, law, seed, Trip.OPERATOR)]
    assert max(hits) == 0
    assert -0.6e-6 < min(lowest) < 0.0


@pytest.mark.parametrize(("bus", "law"), [("unix_1k", "lqg"), ("unix_1k", "youla"), ("unix_2k", "lqg")])
def test_a_slow_bus_has_steps_enough_for_the_way_down(bus, law):
    """A millisecond each, and the stage's modes are above half the rate: 5 steps shook more than half of them."""
    found = [stop for seed in range(8) for stop in stopped("circle", law, seed, Trip.OPERATOR, 4, bus)]
    assert len(found) >= 24
    assert max(hits for hits, _ in found) == 0
    assert -1.5e-6 < min(low for _, low in found) < 0.0


def test_at_once_they_do():
    """What it is for: 13 to 64 hits each."""
    assert all(hits > 10 for hits, _ in stopped("circle", "youla", 1, Trip.GATE_BLOCKED))

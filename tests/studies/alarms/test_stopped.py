"""Devices that are stopped on their way: of the 500 that are kept (``docs/tables/stops.jsonl``) none that is led down
meets a mechanical stop, and what is kept is what they do today.
"""

from pathlib import Path

import pytest
from sampled import MOTIONS, SCENARIOS, designed, read
from stopped import INSTANTS, KEPT, stops, study_of

from pkxyz_ctrl.design.law import way_down_ticks

ROOT = Path(__file__).parents[3]
STOPS = read(KEPT)


@pytest.mark.parametrize("motion", [*MOTIONS, *SCENARIOS])
def test_none_of_500_devices_meets_its_stops_under_the_default_law(motion):
    kept = STOPS[motion, "youla"]
    assert kept["devices"] == 500
    assert kept["hits"] == []
    assert 0 <= 500 * INSTANTS - kept["stops"] <= INSTANTS * len(kept["before"])
    assert kept["hits_at_once"] > 0.9 * kept["stops"], "what it is for"
    assert -2.0 < kept["lowest_um"] < 0.0


def test_only_a_device_that_200_v_no_longer_hold_does_and_one_that_faulted_was_not_led_down():
    """In moves to strokes of 24 um: no scenario of those that are shipped comes near."""
    found = {key[0]: kept for key, kept in STOPS.items() if key[1] == "youla"}
    assert {motion: kept["beyond"] for motion, kept in found.items() if kept["beyond"]} == {"moves": [336]}
    assert {motion: kept["before"] for motion, kept in found.items() if kept["before"]} == {"moves": [316]}


def test_the_page_says_what_is_kept():
    text = " ".join((ROOT / "docs" / "understand" / "safety.md").read_text(encoding="utf-8").split())
    shipped = [STOPS[motion, "youla"] for motion in SCENARIOS]
    count, at_once = (sum(kept[key] for kept in shipped) for key in ("stops", "hits_at_once"))
    assert f"none of {count:,} stops meets a mechanical stop. At once, each does.".replace(",", " ", 1) in text
    assert at_once == count


@pytest.mark.parametrize("motion", ["circle", "raster_lab", "moves"])
def test_three_devices_fare_today_as_the_500_did(motion):
    """The lowest stroke of the 500 isn't theirs, and so isn't lower; the one that hits is among them."""
    kept = STOPS[motion, "youla"]
    for seed in (1, 250, 336):
        found = stops(motion, "youla", seed)
        assert len(found) == INSTANTS
        assert any(stop.hits for stop in found) == (seed in kept["hits"] + kept["beyond"])
        assert min(stop.lowest_m for stop in found) * 1e6 >= kept["lowest_um"] - 1e-3
        assert sum(stop.hits_at_once > 0 for stop in found) >= INSTANTS - 4


def test_the_study_is_made_of_its_devices():
    found = study_of("circle", "youla", 3)
    each = [stop for seed in (1, 2, 3) for stop in stops("circle", "youla", seed)]
    assert (found["stops"], found["hits"], found["before"]) == (len(each), [], [])
    assert found["lowest_um"] == pytest.approx(1e6 * min(stop.lowest_m for stop in each), abs=1e-3)


@pytest.mark.parametrize("law", ["youla", "open_loop", "lqg", "robust", "mpc"])
@pytest.mark.parametrize("motion", ["circle", "steps"])
def test_no_sampled_device_meets_its_stops_when_it_is_led_down(motion, law):
    """Under laws and with seeds that are not all among those that are kept."""
    found = [s for seed in range(501, 504 if law == "mpc" else 513) for s in stops(motion, law, seed, 4)]
    assert [s.hits for s in found] == [0] * len(found)
    assert -0.6e-6 < min(s.lowest_m for s in found) < 0.0


@pytest.mark.parametrize(("bus", "law"), [("unix_1k", "lqg"), ("unix_2k", "lqg"), ("unix_2k", "youla")])
def test_a_slow_bus_has_steps_enough_for_the_way_down(bus, law):
    """A millisecond each, and the stage's modes are above half the rate: 5 steps shook more than half of them."""
    found = [stop for seed in range(1, 9) for stop in stops("circle", law, seed, 4, bus)]
    assert len(found) >= 24
    assert max(s.hits for s in found) == 0
    assert -1.5e-6 < min(s.lowest_m for s in found) < 0.0


@pytest.mark.parametrize("motion", ["circle", "raster", "moves", "sweep"])
def test_at_a_millisecond_a_step_the_stiffest_devices_are_braked_before_they_go_down(motion):
    """14 to 18 % stiffer than drawn: led down with the speed that they have, 21 of 474 stops of 60 devices met their
    lower end out of the circle, and more out of the others.
    """
    found = [stop for seed in (1, 4, 9, 10, 17, 31, 46, 56) for stop in stops(motion, "youla", seed, bus="unix_1k")]
    assert len(found) > 56
    assert max(stop.hits for stop in found) == 0
    assert -1.9e-6 < min(stop.lowest_m for stop in found) < 0.0


@pytest.mark.parametrize("landing_s", [0.01, 0.02, 0.05])
@pytest.mark.parametrize("motion", ["circles", "moves"])
def test_a_way_down_that_may_take_long_leads_no_further_astray(motion, landing_s, monkeypatch):
    """The speed of a circle or a move, taken along for 20 ms, carried each third device into a stop."""
    _, setup = designed(motion, "youla")
    law = setup.law.copy()
    law["braking_ticks"], law["landing_ticks"] = way_down_ticks(landing_s, setup.bus.period_us)
    monkeypatch.setitem(vars(setup), "law", law)
    found = [stop for seed in (1, 4, 6, 10) for stop in stops(motion, "youla", seed)]
    assert len(found) == 4 * INSTANTS
    assert max(stop.hits for stop in found) == 0


def test_at_once_they_do():
    """What it is for: 13 to 64 hits each."""
    assert all(stop.hits_at_once > 10 for stop in stops("circle", "youla", 1))

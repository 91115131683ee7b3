"""A stop where combs and sensors can be trusted: led down in a given time, then 0 V. Everything else is 0 V at once."""

import numpy as np
import pytest
from cycle_rig import AT_REST, in_the_middle, noisy, tracking
from loop_rig import MIDDLE, Cycle, counts_at
from numpy.typing import NDArray

from pkxyz_ctrl.safety.modes import Event, Mode
from pkxyz_ctrl.safety.monitors import NodeEvent, SenseStatus
from pkxyz_ctrl.safety.trips import EXPLANATIONS, LANDS, STOPS, Trip

TICKS = 25  # 5 ms


def down(c: Cycle, most: int = 60) -> list[np.void]:
    """Rows until the way down is over."""
    rows = []
    while c.mode is Mode.LANDING and len(rows) < most:
        rows.append(c.tick(noisy(counts_at(MIDDLE), len(rows))))
    return rows


@pytest.mark.parametrize("trip", [t for t in Trip if t in LANDS])
def test_a_soft_stop_goes_down_smoothly_for_its_time_and_then_says_why(trip):
    c = in_the_middle()
    first = c.tick(noisy(counts_at(MIDDLE), 1), trips=int(trip))
    assert (first["mode"], first["event"], first["trips"]) == (Mode.LANDING, Event.LAND, trip)
    rows = down(c)
    assert len(rows) == TICKS + 1
    assert [r["mode"] for r in rows] == [Mode.LANDING] * TICKS + [Mode.FAULT]
    assert rows[-1]["trips"] == trip
    counts = np.array([first["drive_count"], *(r["drive_count"] for r in rows)]).astype(int)
    assert counts[0].min() > 20_000
    assert counts[1].min() > 0.98 * counts[0].min()
    assert not counts[-1].any()
    assert counts[-2].max() < 0.12 * counts[0].max(), "the last step to 0 V is small"
    assert np.abs(np.diff(counts, axis=0)).max() <= c.law["tick"]["drive"]["count_slew_max"][0]
    assert (np.diff(counts[3:].mean(axis=1)) <= 0).all()
    again = c.tick(noisy(AT_REST, 1))
    assert (again["mode"], again["trips"]) == (Mode.FAULT, 0)


@pytest.mark.parametrize("trip", [t for t in Trip if t not in LANDS])
def test_every_other_stop_is_0_v_at_once_on_the_way_down_too(trip):
    c = in_the_middle()
    row = c.tick(noisy(counts_at(MIDDLE), 1), trips=int(trip | Trip.OPERATOR))
    assert (row["mode"], row["drive_count"].any()) == (Mode.FAULT, False)
    c = in_the_middle()
    c.tick(noisy(counts_at(MIDDLE), 1), trips=int(Trip.OPERATOR))
    for k in range(5):
        assert c.tick(noisy(counts_at(MIDDLE), k))["drive_count"].all()
    row = c.tick(noisy(counts_at(MIDDLE), 9), trips=int(trip))
    assert (row["mode"], row["drive_count"].any()) == (Mode.FAULT, False)
    assert row["trips"] == trip | Trip.OPERATOR, "both are told"


@pytest.mark.parametrize("trip", [t for t in Trip if t in LANDS])
def test_a_second_soft_stop_changes_nothing_but_a_computer_that_stays_late_is_not_waited_for(trip):
    c = in_the_middle()
    c.tick(noisy(counts_at(MIDDLE), 1), trips=int(Trip.SATURATION))
    c.tick(noisy(counts_at(MIDDLE), 2))
    row = c.tick(noisy(counts_at(MIDDLE), 3), trips=int(trip))
    at_once = trip is Trip.OVERRUN
    assert (row["mode"] == Mode.FAULT, not row["drive_count"].any()) == (at_once, at_once)
    if not at_once:
        assert down(c)[-1]["trips"] == trip | Trip.SATURATION


@pytest.mark.parametrize("mode", [Mode.BOOT, Mode.PRE_OPERATIONAL, Mode.IDLE])
def test_where_nothing_is_driven_a_soft_stop_is_a_fault(mode):
    c = Cycle(in_the_middle().law, mode=mode)
    row = c.tick(noisy(AT_REST, 0), trips=int(Trip.OPERATOR))
    assert (row["mode"], row["trips"]) == (Mode.FAULT, Trip.OPERATOR)


@pytest.mark.parametrize("event", [e for e in Event if e not in (Event.LANDED, Event.TRIP, Event.NODE_LOST)])
def test_nothing_that_is_asked_for_stops_or_prolongs_the_way_down(event):
    c, asked = in_the_middle(), in_the_middle()
    for one in (c, asked):
        one.tick(noisy(counts_at(MIDDLE), 1), event=Event.DISABLE)
    for k in range(TICKS + 1):
        row, other = c.tick(noisy(counts_at(MIDDLE), k)), asked.tick(noisy(counts_at(MIDDLE), k), event=event)
        if c.mode is Mode.LANDING:
            assert np.array_equal(row["drive_count"], other["drive_count"])
            assert asked.mode is Mode.LANDING
    assert c.mode is Mode.IDLE
    assert c.memory["homed"][0] == 1


def led_to(c: Cycle) -> NDArray[np.float64]:
    """Where the set-points (3,) are led to by the end of this tick's action, what is left of a jump taken off."""
    place: NDArray[np.float64] = c.memory["after"][0, :3] + c.memory["tick"]["set_point_model"]["short_m"][0]
    return place


@pytest.mark.parametrize(("ticks", "missing_m"), [(3, 0.0), (5, 5e-6), (6, 2e-6), (8, 0.0)])
def test_the_way_down_begins_where_the_set_points_were_led_to(ticks, missing_m):
    """On a scan, before, in and after a jump of 8 um, 3 um of it in a tick: not where the jump was to end."""
    c = in_the_middle()
    motion, tick = c.reference["motion"], np.arange(16)
    motion[:, 3] = 0.1e-3
    motion[:, 0] += 0.1e-3 * 200e-6 * tick + np.where(tick < 8, 0.0, 8e-6)
    for k in range(ticks):
        c.tick(noisy(counts_at(MIDDLE), k))
    assert c.mode is Mode.TRACKING
    place = led_to(c)
    assert c.memory["after"][0, :3] - place == pytest.approx([missing_m, 0.0, 0.0], rel=1e-9, abs=1e-15)
    c.tick(noisy(counts_at(MIDDLE), ticks), event=Event.DISABLE)
    assert c.mode is Mode.LANDING
    assert c.memory["now"][0, :3] == pytest.approx(place, rel=0, abs=1e-15)
    assert c.memory["now"][0, 3:6] == pytest.approx([0.1e-3, 0.0, 0.0], rel=0, abs=1e-12)
    assert led_to(c) == pytest.approx(c.memory["after"][0, :3], rel=0, abs=1e-15), "the rest of the jump is not made"


@pytest.mark.parametrize(("off_m", "stays"), [(0.1e-9, True), (20e-9, False)])
def test_a_push_that_nobody_would_notice_is_no_saturation(off_m, stays):
    """Where a move was stopped just before rest, a tenth of a nanometre beside it: combs can't push, and need not."""
    c = tracking(np.tile(np.r_[0.0, off_m, np.zeros(7)], (16, 1)))
    rows = [c.tick(noisy(AT_REST, k)) for k in range(400)]
    assert rows[300]["saturated"] == 1 or not stays
    assert (c.mode is Mode.TRACKING) == stays
    assert any(r["trips"] & Trip.SATURATION for r in rows) != stays


def test_what_is_measured_on_the_way_down_reaches_no_voltage():
    c, wild = in_the_middle(), in_the_middle()
    for one in (c, wild):
        one.tick(noisy(counts_at(MIDDLE), 1), trips=int(Trip.OPERATOR))
    for k in range(TICKS):
        row = c.tick(noisy(counts_at(MIDDLE), k))
        status = SenseStatus.MISSING if k % 7 == 3 else 0
        other = wild.tick(counts_at(MIDDLE * (0.2 if k % 3 else 1.0)), status=int(status))
        assert np.array_equal(row["drive_count"], other["drive_count"])
        assert wild.mode is Mode.LANDING


def test_node_and_bus_are_watched_on_the_way_down():
    for tick in ({"status": int(SenseStatus.MISSING)}, {"node_events": int(NodeEvent.EMERGENCY)}):
        c = in_the_middle()
        c.tick(noisy(counts_at(MIDDLE), 1), trips=int(Trip.OPERATOR))
        for k in range(5):
            row = c.tick(noisy(counts_at(MIDDLE), k), **tick)
        assert (row["mode"], row["drive_count"].any()) == (Mode.FAULT, False)


def test_every_trip_says_how_it_stops_and_why():
    stems = {(t.name or "").removesuffix(s) for t in Trip for s in ("_1", "_2", "_3", "_X", "_Y", "_Z", "")}
    assert set(STOPS) <= stems
    for trip in EXPLANATIONS:
        name = trip.name or ""
        assert (name in STOPS) != (name.rpartition("_")[0] in STOPS)

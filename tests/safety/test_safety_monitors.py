"""Each monitor alone: it trips at its N-th tick, not before, and forgives as it says."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import monitor_limits
from monitor_bench import COUNTS, Bench, Changes, beyond, only

from pkxyz_ctrl.safety.modes import LOOP_CLOSED, NODE_EXPECTED, Mode
from pkxyz_ctrl.safety.monitors import LIMITS, MONITOR_MEMORY, NodeEvent, SenseStatus
from pkxyz_ctrl.safety.trips import EXPLANATIONS, Trip, explain

# What counts consecutive ticks: its limit, a bad tick, the trip.
STATES: list[tuple[str, Changes, Trip]] = [
    *(
        ("stale_count", {"sense_status": status}, Trip.SENSE_STALE)
        for status in (SenseStatus.MISSING, SenseStatus.CRC, SenseStatus.LENGTH, SenseStatus.DUPLICATE)
    ),
    *(
        ("range_count", {"sense_count": [rail if i == comb else 7 for i in range(3)]}, Trip(Trip.SENSE_RANGE_1 << comb))
        for comb in range(3)
        for rail in (-32768, 32767)
    ),
    *(
        (
            "range_count",
            {"stroke_m": [stroke_m if i == comb else 1e-6 for i in range(3)]},
            Trip(Trip.SENSE_RANGE_1 << comb),
        )
        for comb in range(3)
        for stroke_m in (-2.001e-6, 27.001e-6, math.nan, math.inf, -math.inf)
    ),
    *(
        ("innovation_count", {"innovation_m": beyond(axis, value)}, Trip(Trip.INNOVATION_X << axis))
        for axis in range(3)
        for value in (0.501e-6, -0.501e-6, math.nan, math.inf)
    ),
    *(
        ("slew_count", {"voltage_step_v": beyond(comb, value)}, Trip.SLEW)
        for comb in range(3)
        for value in (20.01, -20.01, math.nan)
    ),
    *(
        ("unexplained_force_count", {"unexplained_force_n": beyond(comb, value)}, Trip(Trip.COMB_FORCE_1 << comb))
        for comb in range(3)
        for value in (0.801e-3, -0.801e-3, math.nan, math.inf)
    ),
    *(
        ("unexplained_force_count", {"commanded_force_n": beyond(comb, math.nan)}, Trip(Trip.COMB_FORCE_1 << comb))
        for comb in range(3)
    ),
    ("saturation_count", {"saturated": 1}, Trip.SATURATION),
    ("solver_count", {"solver_ok": 0}, Trip.SOLVER),
]

# What fills a bucket: its limit, the name of its leak, one event, the trip.
EVENTS: list[tuple[str, str, Changes, Trip]] = [
    ("sequence_count", "frame_leak_ticks", {"sense_status": SenseStatus.MISSING}, Trip.SENSE_SEQUENCE),
    ("crc_count", "frame_leak_ticks", {"sense_status": SenseStatus.CRC}, Trip.SENSE_CRC),
    ("length_count", "frame_leak_ticks", {"sense_status": SenseStatus.LENGTH}, Trip.SENSE_LENGTH),
    ("overrun_count", "overrun_leak_ticks", {"overrun": 1}, Trip.OVERRUN),
    *(
        ("residual_count", "frame_leak_ticks", {"implausible_combs": 1 << comb}, Trip(Trip.COMB_MISFIT_1 << comb))
        for comb in range(3)
    ),
]


@pytest.mark.parametrize("count", [1, 2, 5, 50])
@pytest.mark.parametrize(("count_name", "bad", "trip"), STATES)
def test_state_trips_at_exactly_n_and_recovers(count_name: str, bad: Changes, trip: Trip, count: int) -> None:
    limits = only(count_name, count)
    limits["force_change_max_n"] = 1.0  # for itself below
    bench = Bench(limits=limits)
    for _ in range(2):  # the second time shows that one good tick forgives all
        assert [bench.tick(bad) for _ in range(count - 1)] == [Trip(0)] * (count - 1)
        assert bench.tick() == 0
    reports = [bench.tick(bad) for _ in range(count + 2)]
    assert reports == [Trip(0)] * (count - 1) + [trip] * 3
    assert bench.tick() == 0


@pytest.mark.parametrize("count", [1, 2, 5, 50])
@pytest.mark.parametrize(("count_name", "leak_name", "bad", "trip"), EVENTS)
def test_event_trips_at_exactly_n_and_leaks(
    count_name: str, leak_name: str, bad: Changes, trip: Trip, count: int
) -> None:
    leak = 7
    limits = only(count_name, count)
    limits[leak_name] = leak
    bench = Bench(limits=limits)
    assert [bench.tick(bad) for _ in range(count - 1)] == [Trip(0)] * (count - 1)
    assert bench.tick(bad) == trip
    assert bench.tick() == 0  # a good tick takes it below again: latching is the caller's
    bench = Bench(limits=limits)
    if count > 1:
        for _ in range(count - 1):
            bench.tick(bad)
        for _ in range(leak):
            assert bench.tick() == 0
        assert bench.tick(bad) == 0  # one was forgiven
        assert bench.tick(bad) == trip


@pytest.mark.parametrize(("count_name", "leak_name", "bad", "trip"), EVENTS)
def test_rate_decides_in_the_long_run(count_name: str, leak_name: str, bad: Changes, trip: Trip) -> None:
    limits = only(count_name, 3)
    limits[leak_name] = 10
    tolerated, refused = Bench(limits=limits), Bench(limits=limits)
    assert not any(tolerated.tick(bad if k % 11 == 0 else None) for k in range(3000))
    assert any(refused.tick(bad if k % 10 == 0 else None) == trip for k in range(3000))


@pytest.mark.parametrize("odd", [SenseStatus.COUNTER, SenseStatus.DUPLICATE, SenseStatus.COUNTER | SenseStatus.MISSING])
def test_a_frame_that_cannot_be_counts_twice(odd: SenseStatus) -> None:
    for count in (1, 2, 8):
        bench = Bench(limits=only("sequence_count", count))
        needed = (count + 1) // 2
        assert [bench.tick({"sense_status": odd}) for _ in range(needed - 1)] == [Trip(0)] * (needed - 1)
        # a duplicate makes the tick unusable, so the next one may be its echo
        extra = 0 if odd is SenseStatus.COUNTER or odd & SenseStatus.MISSING else needed
        assert any(bench.tick({"sense_status": odd}) == Trip.SENSE_SEQUENCE for _ in range(1 + extra))


def test_a_lost_frame_counts_as_it_fails_to_come_and_as_the_next_counter_has_jumped() -> None:
    missing, jumped = {"sense_status": SenseStatus.MISSING}, {"sense_status": SenseStatus.COUNTER}
    bench = Bench(limits=only("sequence_count", 8))
    assert [bench.tick(changes) for changes in [missing, jumped] * 4] == [Trip(0)] * 7 + [Trip.SENSE_SEQUENCE]


def test_several_missed_ticks_count_as_several() -> None:
    assert Bench(limits=only("overrun_count", 10)).tick({"overrun": 9}) == 0
    assert Bench(limits=only("overrun_count", 10)).tick({"overrun": 10}) == Trip.OVERRUN
    assert Bench(limits=only("overrun_count", 10)).tick({"overrun": 2**31 - 1}) == Trip.OVERRUN


@pytest.mark.parametrize("comb", [0, 1, 2])
def test_frozen_channel_trips_at_the_nth_equal_count(comb: int) -> None:
    bench = Bench(limits=only("frozen_count", 50))

    def frame(value: int, k: int) -> Changes:
        return {"sense_count": [value if i == comb else k % 5 for i in range(3)]}

    assert [bench.tick(frame(42, k)) for k in range(49)] == [Trip(0)] * 49
    assert bench.tick(frame(43, 49)) == 0
    assert [bench.tick(frame(42, k)) for k in range(49)] == [Trip(0)] * 49
    assert bench.tick(frame(42, 49)) == Trip(Trip.SENSE_FROZEN_1 << comb)


def test_frozen_and_range_wait_for_usable_frames() -> None:
    """A missing frame repeats old numbers: that is stale, and says nothing about the converter."""
    limits = only("frozen_count", 4)
    limits["range_count"] = 4
    bench = Bench(limits=limits)
    bad = {"sense_count": [32767] * 3}
    assert [bench.tick(bad) for _ in range(3)] == [Trip(0)] * 3
    assert [bench.tick({**bad, "sense_status": SenseStatus.MISSING}) for _ in range(50)] == [Trip(0)] * 50
    every = Trip(0b111 * Trip.SENSE_RANGE_1 | 0b111 * Trip.SENSE_FROZEN_1)
    assert bench.tick(bad) == every


def test_boundaries_themselves_are_permitted() -> None:
    limits = monitor_limits()
    for name in COUNTS:
        limits[name] = 1
    limits["frozen_count"] = 50
    limits["force_change_max_n"] = 0.8e-3
    edge = {
        "stroke_m": [limits["stroke_min_m"][0], limits["stroke_max_m"][0], 0.0],
        "sense_count": [-32767, 32766, 0],
        "innovation_m": [0.5e-6, -0.5e-6, 0.0],
        "unexplained_force_n": [0.8e-3, -0.8e-3, 0.0],
        "voltage_step_v": [limits["voltage_step_max_v"][0], -limits["voltage_step_max_v"][0], 0.0],
    }
    assert Bench(limits=limits).tick(edge) == 0


@pytest.mark.parametrize("event", list(NodeEvent))
def test_node_events_trip_at_once(event: NodeEvent) -> None:
    expected = {
        NodeEvent.HEARTBEAT_LOST: Trip.HEARTBEAT_LOST,
        NodeEvent.NOT_OPERATIONAL: Trip.NODE_NOT_OPERATIONAL,
        NodeEvent.REBOOTED: Trip.NODE_REBOOTED,
        NodeEvent.EMERGENCY: Trip.NODE_EMERGENCY,
        NodeEvent.FOREIGN_FRAME: Trip.FOREIGN_FRAME,
        NodeEvent.SAFETY_OBJECTS: Trip.SAFETY_OBJECTS,
    }
    for mode in Mode:
        assert Bench(mode).tick({"node_events": event}) == (expected[event] if NODE_EXPECTED[mode] else 0)


@pytest.mark.parametrize("mode", list(Mode))
def test_not_finite_trips_at_once_in_every_mode(mode: Mode) -> None:
    """NaN and infinity end here: the wire carries integers, and the gate never sees them."""
    assert Bench(mode).tick({"finite": 0}) == Trip.NOT_FINITE


ALL_BAD: Changes = {
    "sense_status": SenseStatus.COUNTER,
    "sense_count": [32767] * 3,
    "innovation_m": 1.0,
    "unexplained_force_n": 1.0,
    "voltage_step_v": 100.0,
    "saturated": 1,
    "solver_ok": 0,
    "overrun": 5,
    "node_events": 31,
}


@pytest.mark.parametrize("mode", list(Mode))
def test_what_is_watched_in_which_mode(mode: Mode) -> None:
    bench = Bench(mode)
    trips = Trip(0)
    for _ in range(300):
        trips |= bench.tick(ALL_BAD)
    frames = Trip.SENSE_SEQUENCE | 0b111 * Trip.SENSE_RANGE_1 | 0b111 * Trip.SENSE_FROZEN_1 | Trip.OVERRUN
    frames |= 0b1111 * Trip.HEARTBEAT_LOST | Trip.FOREIGN_FRAME
    loop = 0b111 * Trip.INNOVATION_X | Trip.SATURATION | Trip.SLEW | Trip.SOLVER | 0b111 * Trip.COMB_FORCE_1
    assert trips == (frames if NODE_EXPECTED[mode] else 0) | (loop if LOOP_CLOSED[mode] else 0)


def test_memory_is_cleared_where_nothing_is_expected() -> None:
    bench = Bench(Mode.FAULT)
    for name in MONITOR_MEMORY.names or ():
        bench.memory[name] = 7
    bench.tick(ALL_BAD)
    clean = np.zeros(1, MONITOR_MEMORY)
    clean["frozen_sense_count"] = bench.memory["frozen_sense_count"]  # without meaning while frozen is 0
    assert bench.memory.tobytes() == clean.tobytes()


@pytest.mark.parametrize("mode", [-1, -2, 8, 99])
def test_unknown_mode_owes_nothing(mode: int) -> None:
    """The mode table makes FAULT of it; here it must only not read beyond a table."""
    bench = Bench()
    assert not any(bench.tick({**ALL_BAD, "mode": mode}) for _ in range(60))
    assert bench.tick({"mode": mode, "finite": 0}) == Trip.NOT_FINITE


def test_opening_the_loop_forgets_what_only_the_loop_can_do() -> None:
    limits = only("innovation_count", 5)
    limits["saturation_count"] = limits["solver_count"] = limits["slew_count"] = 5
    limits["unexplained_force_count"] = limits["residual_count"] = 5
    bench = Bench(limits=limits)
    bad = {"innovation_m": 1.0, "saturated": 1, "solver_ok": 0, "voltage_step_v": 99.0, "unexplained_force_n": 1.0}
    bad["implausible_combs"] = 1
    for mode in (Mode.TRACKING, Mode.IDLE, Mode.ENABLED):
        bench.mode = mode
        assert [bench.tick(bad) for _ in range(4)] == [Trip(0)] * 4
    loop = Trip.SATURATION | Trip.SOLVER | Trip.SLEW | 0b111 * Trip.COMB_FORCE_1 | Trip.COMB_MISFIT_1
    assert bench.tick(bad) == 0b111 * Trip.INNOVATION_X | loop


def test_limits_that_were_never_filled_in_trip_at_once() -> None:
    trips = Bench(limits=np.zeros(1, LIMITS)).tick()
    assert {Trip.SENSE_STALE, Trip.SENSE_CRC, Trip.SATURATION, Trip.SLEW, Trip.OVERRUN, Trip.SOLVER} <= set(trips)


def test_healthy_ticks_never_trip_with_the_defaults_and_fill_no_bucket() -> None:
    for mode in Mode:
        bench = Bench(mode)
        for _ in range(2000):
            assert bench.tick() == 0
            assert not any(bench.memory[name].any() for name in MONITOR_MEMORY.names or () if name.endswith("_level"))


def test_silence_is_called_stale_at_the_fifth_tick() -> None:
    bench = Bench()
    missing = {"sense_status": SenseStatus.MISSING}
    assert [bench.tick(missing) for _ in range(5)] == [0, 0, 0, 0, Trip.SENSE_STALE]


@settings(max_examples=60)
@given(
    st.lists(st.tuples(st.sampled_from(Mode), st.booleans(), st.booleans()), min_size=1, max_size=60),
    st.integers(1, 6),
)
def test_consecutive_counts_against_the_history(ticks: list[tuple[Mode, bool, bool]], count: int) -> None:
    """Oracle: look back at the last N ticks instead of counting."""
    limits = only("stale_count", count)
    limits["innovation_count"] = count
    bench = Bench(limits=limits)
    for k, (mode, stale, astray) in enumerate(ticks):
        bench.mode = mode
        status = SenseStatus.MISSING if stale else SenseStatus(0)
        trips = bench.tick({"sense_status": status, "innovation_m": [0.0, 1.0 if astray else 0.0, 0.0]})
        recent = ticks[k - count + 1 : k + 1] if k + 1 >= count else []
        expected = Trip(0)
        if recent and all(NODE_EXPECTED[m] and was_stale for m, was_stale, _ in recent):
            expected |= Trip.SENSE_STALE
        if recent and all(LOOP_CLOSED[m] and was_astray for m, _, was_astray in recent):
            expected |= Trip.INNOVATION_Y
        assert trips == expected


def test_counting_stops_long_before_a_counter_overflows() -> None:
    enough = 1 << 30
    bench = Bench()
    bench.memory["stale"] = bench.memory["crc_level"] = enough
    for _ in range(3):
        assert bench.tick({"sense_status": SenseStatus.CRC}) & Trip.SENSE_STALE
        assert bench.memory["stale"] == bench.memory["crc_level"] == enough


def test_every_trip_is_explained_with_what_to_check() -> None:
    assert list(EXPLANATIONS) == list(Trip)
    for trip in Trip:
        text = explain(trip)
        assert text.count("\n") == 0
        assert str(trip.name) in text
        happened, remedy = EXPLANATIONS[trip]
        assert len(happened) > 10
        assert len(remedy) > 20
    assert explain(0) == ""
    assert len(explain(int(sum(Trip))).splitlines()) == len(Trip)
    assert "0x10000000000" in explain(1 << 40)
    assert explain(Trip.SENSE_FROZEN_2).startswith("Sense comb 2 repeats")


def test_neighbouring_bits_are_combs_and_axes() -> None:
    for first in (Trip.SENSE_RANGE_1, Trip.SENSE_FROZEN_1, Trip.INNOVATION_X, Trip.COMB_MISFIT_1, Trip.COMB_FORCE_1):
        stem = str(first.name)[:-1]
        assert [str(Trip(first << i).name) for i in range(3)] in (
            [stem + digit for digit in "123"],
            [stem + axis for axis in "XYZ"],
        )

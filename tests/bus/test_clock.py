"""The lockstep clock: order, time that never runs back, no re-entry."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.bus.clock import ClockReentryError, Lockstep, TimeInPastError


@given(times=st.lists(st.integers(0, 50), max_size=60), horizon=st.integers(0, 60))
@settings(max_examples=100)
def test_events_run_by_time_then_by_insertion(times: list[int], horizon: int) -> None:
    clock = Lockstep()
    seen: list[tuple[int, int]] = []
    for order, t_us in enumerate(times):
        clock.call_at(t_us, lambda order=order, t_us=t_us: seen.append((clock.now_us, order)))
    clock.run_until(horizon)
    due = sorted((t_us, order) for order, t_us in enumerate(times) if t_us <= horizon)
    assert seen == due
    assert clock.now_us == horizon
    later = [t_us for t_us in times if t_us > horizon]
    assert clock.next_event_us() == (min(later) if later else None)


@given(steps=st.lists(st.integers(0, 40), min_size=1, max_size=20))
@settings(max_examples=50)
def test_any_partition_of_the_time_gives_the_same_run(steps: list[int]) -> None:
    def run(stops: list[int]) -> list[tuple[int, str]]:
        clock, seen = Lockstep(), []

        def periodic(name: str, period_us: int) -> None:
            seen.append((clock.now_us, name))
            clock.call_at(clock.now_us + period_us, lambda: periodic(name, period_us))

        clock.call_at(0, lambda: periodic("slow", 7))
        clock.call_at(0, lambda: periodic("fast", 3))
        for t_us in stops:
            clock.run_until(t_us)
        return seen

    total, stops = 0, []
    for step in steps:
        total += step
        stops.append(total)
    assert run(stops) == run([total])


def test_an_event_may_add_events_at_its_own_time_which_run_last() -> None:
    clock, seen = Lockstep(), []
    clock.call_at(5, lambda: (seen.append("first"), clock.call_at(5, lambda: seen.append("added"))))
    clock.call_at(5, lambda: seen.append("second"))
    clock.run_until(5)
    assert seen == ["first", "second", "added"]


def test_the_past_is_refused() -> None:
    clock = Lockstep(start_us=100)
    for forbidden in (lambda: clock.call_at(99, print), lambda: clock.run_until(99)):
        with pytest.raises(TimeInPastError, match="already 100 us"):
            forbidden()
    assert clock.now_us == 100
    assert clock.next_event_us() is None


def test_an_event_cannot_run_the_clock() -> None:
    clock = Lockstep()
    clock.call_at(3, lambda: clock.run_until(10))
    clock.call_at(4, lambda: clock.run_until_event())
    for t_us in (3, 4):
        with pytest.raises(ClockReentryError, match=rf"event at {t_us} us"):
            clock.run_until(10)
        assert clock.now_us == t_us
        clock.call_at(t_us, lambda: None)
    clock.run_until(10)  # and it can be run on after an error
    assert clock.now_us == 10


def test_stepping_from_event_to_event() -> None:
    clock, seen = Lockstep(), []
    for t_us in (9, 4, 4):
        clock.call_at(t_us, lambda t_us=t_us: seen.append(t_us))
    assert [clock.run_until_event(), clock.run_until_event(), clock.run_until_event()] == [4, 9, None]
    assert seen == [4, 4, 9]
    assert clock.now_us == 9

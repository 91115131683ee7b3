"""The mode table, state by event, against an expectation written by hand, and the laws that it must obey."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pkxyz_ctrl.safety import modes
from pkxyz_ctrl.safety.modes import (
    Event,
    Mode,
    clear_event,
    enable_event,
    next_homed,
    next_mode,
    next_safe_cycles,
    refusal,
)

# Columns: mode now. Rows: event. Cell: mode then; "-" is refused, the mode stays.
EXPECTED = """
                BOOT            PRE_OPERATIONAL  IDLE     HOMING  ENABLED   TRACKING  FAULT     LANDING
NONE            -               -                -        -       -         -         -         -
NODE_FOUND      PRE_OPERATIONAL -                -        -       -         -         -         -
NODE_READY      -               IDLE             -        -       -         -         -         -
NODE_LOST       -               BOOT             BOOT     BOOT    FAULT     FAULT     -         FAULT
HOME            -               -                HOMING   -       -         -         -         -
HOMED           -               -                -        IDLE    -         -         -         -
ENABLE          -               -                ENABLED  -       -         -         -         -
ENABLE_UNHOMED  -               -                -        -       -         -         -         -
TRACK           -               -                -        -       TRACKING  -         -         -
HOLD            -               -                -        -       -         ENABLED   -         -
DISABLE         -               -                -        IDLE    LANDING   LANDING   -         -
TRIP            FAULT           FAULT            FAULT    FAULT   FAULT     FAULT     -         FAULT
CLEAR           -               -                -        -       -         -         BOOT         -
ENABLE_UNSETTLED -              -                -        -       -         -         -         -
CLEAR_UNSETTLED -               -                -        -       -         -         -         -
LAND            FAULT           FAULT            FAULT    FAULT   LANDING   LANDING   -         -
LANDED          -               -                -        -       -         -         -         IDLE
"""


def expected_cells() -> list[tuple[str, str, str]]:
    header, *rows = (line.split() for line in EXPECTED.strip().splitlines())
    return [(mode, row[0], cell) for row in rows for mode, cell in zip(header, row[1:], strict=True)]


def test_expectation_names_every_pair_once() -> None:
    pairs = [(mode, event) for mode, event, _ in expected_cells()]
    assert sorted(pairs) == sorted((mode.name, event.name) for mode in Mode for event in Event)


@pytest.mark.parametrize(("mode_name", "event_name", "cell"), expected_cells())
def test_every_mode_and_event(mode_name: str, event_name: str, cell: str) -> None:
    mode, event = Mode[mode_name], Event[event_name]
    target = mode if cell == "-" else Mode[cell]
    assert next_mode(int(mode), int(event)) == target
    assert (refusal(mode, event) is None) == (cell != "-" or event is Event.NONE)


@pytest.mark.parametrize(
    ("mode", "may_energise", "loop_closed", "node_expected"),
    [
        (Mode.BOOT, 0, 0, 0),
        (Mode.PRE_OPERATIONAL, 0, 0, 0),
        (Mode.IDLE, 0, 0, 1),
        (Mode.HOMING, 0, 0, 1),
        (Mode.ENABLED, 1, 1, 1),
        (Mode.TRACKING, 1, 1, 1),
        (Mode.FAULT, 0, 0, 0),
        (Mode.LANDING, 1, 0, 1),
    ],
)
def test_facts_by_mode(mode: Mode, may_energise: int, loop_closed: int, node_expected: int) -> None:
    facts = modes.MAY_ENERGISE[mode], modes.LOOP_CLOSED[mode], modes.NODE_EXPECTED[mode]
    assert facts == (may_energise, loop_closed, node_expected)


def test_numbers_are_a_contract_of_recordings() -> None:
    assert [mode.value for mode in Mode] == list(range(8))
    assert [event.value for event in Event] == list(range(17))


@pytest.mark.parametrize("mode", [-1, 8, 127])
def test_unknown_mode_is_a_fault(mode: int) -> None:
    assert all(next_mode(mode, int(event)) == Mode.FAULT for event in Event)


@pytest.mark.parametrize("event", [-1, 17, 1 << 20])
def test_unknown_event_is_refused(event: int) -> None:
    assert all(next_mode(int(mode), event) == mode for mode in Mode)


def test_tables_cannot_be_changed() -> None:
    for table in (modes.TRANSITION_TABLE, modes.MAY_ENERGISE, modes.LOOP_CLOSED, modes.NODE_EXPECTED):
        with pytest.raises(ValueError, match="read-only"):
            table[...] = np.int8(1)


def test_voltage_is_entered_only_by_enable_and_left_by_trip_in_one_step() -> None:
    energised = {mode for mode in Mode if modes.MAY_ENERGISE[mode]}
    entries = {
        (mode, event)
        for mode in set(Mode) - energised
        for event in Event
        if next_mode(int(mode), int(event)) in energised
    }
    assert entries == {(Mode.IDLE, Event.ENABLE)}
    assert all(next_mode(int(mode), int(Event.TRIP)) == Mode.FAULT for mode in Mode)


def test_refusal_tells_where_it_would_be_possible() -> None:
    assert "TRACK is not possible in IDLE" in str(refusal(Mode.IDLE, Event.TRACK))
    assert str(refusal(Mode.IDLE, Event.TRACK)).endswith("ENABLED")
    assert "home first" in str(refusal(Mode.IDLE, Event.ENABLE_UNHOMED))
    assert "for enough cycles" in str(refusal(Mode.IDLE, Event.ENABLE_UNSETTLED))
    assert "for enough cycles" in str(refusal(Mode.FAULT, Event.CLEAR_UNSETTLED))


def test_a_wish_is_an_event_that_says_what_is_missing() -> None:
    assert [Event(enable_event(homed, settled)) for homed in (False, True) for settled in (False, True)] == [
        Event.ENABLE_UNHOMED, Event.ENABLE_UNHOMED, Event.ENABLE_UNSETTLED, Event.ENABLE,
    ]  # fmt: skip
    assert [Event(clear_event(settled)) for settled in (False, True)] == [Event.CLEAR_UNSETTLED, Event.CLEAR]


@pytest.mark.parametrize("mode", [-1, *Mode, 8])
def test_safe_cycles_by_mode(mode: int) -> None:
    """A voltage always ends the count, a bad frame where one is owed; an unknown mode owes everything."""
    is_owed = mode not in list(Mode) or modes.MODE_FACTS[Mode(mode)].node_expected
    for is_usable in (False, True):
        assert next_safe_cycles(41, mode, is_usable, False) == 0
        assert next_safe_cycles(41, mode, is_usable, True) == (42 if is_usable or not is_owed else 0)
    assert next_safe_cycles(1 << 30, mode, True, True) == 1 << 30


@settings(max_examples=200)
@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=40))
def test_safe_cycles_are_those_since_the_last_unsafe_one(ticks: list[tuple[bool, bool]]) -> None:
    """Oracle: look back to the last tick that was not safe."""
    cycles = 0
    for k, (is_usable, is_discharged) in enumerate(ticks):
        cycles = next_safe_cycles(cycles, int(Mode.IDLE), is_usable, is_discharged)
        unsafe = [n for n in range(k + 1) if not all(ticks[n])]
        assert cycles == k - max(unsafe, default=-1)


@settings(max_examples=200)
@given(st.lists(st.tuples(st.booleans(), st.integers(0, len(Event) - 1)), max_size=60))
def test_loop_closes_only_after_homing_since_the_last_boot(choices: list[tuple[bool, int]]) -> None:
    """Whoever asks through ``enable_event`` cannot close the loop on offsets of another life.

    Half of the events are sampled from those that the mode accepts, else the walk would hardly ever leave BOOT.
    """
    mode, homed = int(Mode.BOOT), False
    homed_since_boot = False
    for fitting, number in choices:
        accepted = [event for source, event in modes.TRANSITIONS if source == mode]
        event = accepted[number % len(accepted)] if fitting else Event(number)
        asked = enable_event(homed, True) if event in (Event.ENABLE, Event.ENABLE_UNHOMED) else int(event)
        was = mode
        homed, mode = next_homed(homed, mode, asked), int(next_mode(mode, asked))
        if was == Mode.HOMING and event is Event.HOMED:
            homed_since_boot = True
        if mode in (Mode.BOOT, Mode.HOMING):
            homed_since_boot = False
        assert homed == homed_since_boot
        if modes.LOOP_CLOSED[mode]:
            assert homed_since_boot


@pytest.mark.parametrize("way", [[Event.NODE_LOST], [Event.TRIP, Event.CLEAR], [Event.ENABLE, Event.TRIP, Event.CLEAR]])
def test_offsets_are_forgotten_with_the_node_and_with_a_fault(way: list[Event]) -> None:
    mode, homed = int(Mode.IDLE), True
    for event in way:
        assert homed
        homed, mode = next_homed(homed, mode, int(event)), int(next_mode(mode, int(event)))
    assert (mode, homed) == (Mode.BOOT, False)


@pytest.mark.parametrize("ending", [Event.DISABLE, Event.NODE_LOST, Event.TRIP])
def test_a_homing_broken_off_leaves_no_offsets(ending: Event) -> None:
    """It has put them to zero; what was known before it is gone."""

    def after(homed: bool, mode: Mode, event: Event) -> bool:
        return bool(next_homed(homed, int(mode), int(event)))

    assert not after(True, Mode.IDLE, Event.HOME)
    assert not after(False, Mode.HOMING, Event.NONE)
    assert not after(after(True, Mode.IDLE, Event.HOME), Mode.HOMING, ending)
    assert after(False, Mode.HOMING, Event.HOMED)
    assert after(True, Mode.IDLE, Event.ENABLE)


def test_the_way_to_tracking_and_back() -> None:
    mode = int(Mode.BOOT)
    path = [Event.NODE_FOUND, Event.NODE_READY, Event.HOME, Event.HOMED, Event.ENABLE, Event.TRACK, Event.HOLD]
    path += [Event.TRACK, Event.TRIP, Event.CLEAR]
    visited = []
    for event in path:
        mode = int(next_mode(mode, int(event)))
        visited.append(Mode(mode).name)
    assert visited == [
        "PRE_OPERATIONAL", "IDLE", "HOMING", "IDLE", "ENABLED", "TRACKING", "ENABLED", "TRACKING", "FAULT", "BOOT",
    ]  # fmt: skip

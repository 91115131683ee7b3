"""The mode machine, whole: every state of mode, homing and safe cycles, and everything that can happen in it.

The shipped functions decide; what is asked here is written from docs/understand/safety.md, and none of the tables are
looked at. A ``wish`` goes through the guards as in the cycle: to close the loop asks for homing and safe cycles, to
clear a fault for safe cycles.
"""

from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

import pytest

from pkxyz_ctrl.safety import modes
from pkxyz_ctrl.safety.gate_rules import PERMITTED, FrameKind
from pkxyz_ctrl.safety.modes import MODE_FACTS, TRANSITIONS, Event, Mode

ENOUGH = 3
ACTIVE = {Mode.ENABLED, Mode.TRACKING}
DRIVEN = ACTIVE | {Mode.LANDING}
WISHES = {Event.ENABLE, Event.CLEAR}  # whatever else is one comes as it is


class State(NamedTuple):
    mode: int
    homed: bool
    safe: int


class Machine(NamedTuple):
    """The five functions that decide; a planted defect is another one in a place."""

    next_mode: Callable[[int, int], int] = modes.next_mode
    next_homed: Callable[[bool, int, int], bool] = modes.next_homed
    next_safe: Callable[[int, int, bool, bool], int] = modes.next_safe_cycles
    enable: Callable[[bool, bool], int] = modes.enable_event
    clear: Callable[[bool], int] = modes.clear_event


def ticks(machine: Machine, state: State) -> Iterator[tuple[Event, State]]:
    """Every tick that can follow: an event, then whether this tick's frame was usable and its voltage 0."""
    settled = state.safe >= ENOUGH
    for asked in Event:
        event = int(asked)
        if asked is Event.ENABLE:
            event = machine.enable(state.homed, settled)
        elif asked is Event.CLEAR:
            event = machine.clear(settled)
        mode = int(machine.next_mode(state.mode, event))
        homed = bool(machine.next_homed(state.homed, state.mode, event))
        for usable in (False, True):
            for discharged in (False, True) if MODE_FACTS[Mode(mode)].may_energise else (True,):
                safe = min(int(machine.next_safe(state.safe, mode, usable, discharged)), ENOUGH)
                yield asked, State(mode, homed, safe)


def holds(machine: Machine) -> tuple[int, int]:
    """Raises AssertionError where the machine does what it must not; states and ticks that there are."""
    first = State(int(Mode.BOOT), False, 0)
    seen, waiting, count, onward = {first}, deque([first]), 0, {}
    while waiting:
        state = waiting.popleft()
        onward[state] = {after for _, after in ticks(machine, state)}
        for event, after in ticks(machine, state):
            count += 1
            if after.mode in ACTIVE and state.mode not in ACTIVE:
                assert event is Event.ENABLE, f"{event.name} energises"
                assert state.homed, "energised without homing"
                assert state.safe >= ENOUGH, "energised before the combs have settled"
            if after.mode in DRIVEN:
                assert after.homed, "energised without sense offsets"
            if after.mode == Mode.LANDING and state.mode != Mode.LANDING:
                assert state.mode in ACTIVE, f"a way down from {Mode(state.mode).name}"
                assert event in (Event.LAND, Event.DISABLE), f"{event.name} leads down"
            if state.mode == Mode.LANDING and after.mode != Mode.LANDING:
                ends = {Event.LANDED: Mode.IDLE, Event.TRIP: Mode.FAULT, Event.NODE_LOST: Mode.FAULT}
                assert ends.get(event) == after.mode, f"{event.name} ends the way down in {Mode(after.mode).name}"
            if event is Event.LAND:
                stopped = DRIVEN - ACTIVE if state.mode in DRIVEN else {Mode.FAULT}
                assert after.mode in stopped, f"a stop in {Mode(state.mode).name} leads to {Mode(after.mode).name}"
            if event is Event.TRIP:
                assert after.mode == Mode.FAULT, f"a trip in {Mode(state.mode).name} leads to {Mode(after.mode).name}"
            if state.mode == Mode.FAULT and after.mode != Mode.FAULT:
                assert (event, after.mode) == (Event.CLEAR, Mode.BOOT), "a fault is left without a clear"
                assert state.safe >= ENOUGH, "a fault is cleared before the combs have settled"
                assert not after.homed, "offsets outlive a fault"
            if event is Event.NODE_LOST:
                assert after.mode not in DRIVEN, "the node is gone, and the loop stays closed"
            if event is Event.DISABLE:
                assert after.mode not in ACTIVE
            if after.homed and not state.homed:
                assert (state.mode, event) == (Mode.HOMING, Event.HOMED), "offsets from nowhere"
            if after not in seen:
                seen.add(after)
                waiting.append(after)
    reach = {state for state in seen if state.mode in ACTIVE}
    while more := {state for state in seen - reach if onward[state] & reach}:
        reach |= more
    assert reach == seen, f"no way back to a closed loop from {sorted(seen - reach)}"
    return len(seen), count


def test_every_state_and_everything_that_can_happen() -> None:
    states, count = holds(Machine())
    assert set(Mode) == {Mode(mode) for mode, _ in TRANSITIONS}
    assert states >= 30
    assert count > 1000


def test_holding_and_following_differ_in_nothing_but_the_reference() -> None:
    """So the exploration may stay in ENABLED: gate, facts and events are those of TRACKING."""
    assert PERMITTED[Mode.ENABLED] == PERMITTED[Mode.TRACKING]
    assert MODE_FACTS[Mode.ENABLED][:3] == MODE_FACTS[Mode.TRACKING][:3]
    for event in set(Event) - {Event.TRACK, Event.HOLD}:
        both = {TRANSITIONS.get((mode, event)) for mode in ACTIVE}
        assert len(both) == 1, event


def test_a_voltage_passes_the_gate_in_active_modes_only() -> None:
    assert {mode for mode, kinds in PERMITTED.items() if kinds & FrameKind.DRIVE} == DRIVEN
    assert {mode for mode, facts in MODE_FACTS.items() if facts.may_energise} == DRIVEN


@pytest.mark.parametrize("mode", [-(1 << 31), -1, 8, 9, 127, 1 << 30])
def test_a_mode_that_does_not_exist_is_a_fault(mode: int) -> None:
    assert all(modes.next_mode(mode, int(event)) == Mode.FAULT for event in (-1, *Event, 17, 1 << 30))


@pytest.mark.parametrize("event", [-(1 << 31), -1, 17, 18, 1 << 30])
def test_an_event_that_does_not_exist_changes_nothing(event: int) -> None:
    assert all(modes.next_mode(int(mode), event) == mode for mode in Mode)


def _also(pair: tuple[Mode, Event], target: Mode) -> Callable[[int, int], int]:
    return lambda mode, event: target if (mode, event) == pair else int(modes.next_mode(mode, event))


PLANTED = {
    "energises": Machine(next_mode=_also((Mode.IDLE, Event.TRACK), Mode.TRACKING)),
    "without homing": Machine(enable=lambda homed, settled: Event.ENABLE),
    "before the combs have settled": Machine(enable=lambda homed, settled: Event.ENABLE if homed else Event.NONE),
    "a trip in": Machine(next_mode=_also((Mode.HOMING, Event.TRIP), Mode.IDLE)),
    "without a clear": Machine(next_mode=_also((Mode.FAULT, Event.NODE_LOST), Mode.BOOT)),
    "is cleared before": Machine(clear=lambda settled: Event.CLEAR),
    "outlive a fault": Machine(next_homed=lambda homed, *pair: homed or pair == (Mode.HOMING, Event.HOMED)),
    "stays closed": Machine(next_mode=_also((Mode.TRACKING, Event.NODE_LOST), Mode.ENABLED)),
    "from nowhere": Machine(next_homed=lambda homed, mode, event: mode == Mode.HOMING and event != Event.NODE_LOST),
    "energised without": Machine(next_mode=_also((Mode.IDLE, Event.LAND), Mode.LANDING)),
    "TRACK energises": Machine(next_mode=_also((Mode.LANDING, Event.TRACK), Mode.TRACKING)),
    "a stop in ENABLED leads to IDLE": Machine(next_mode=_also((Mode.ENABLED, Event.LAND), Mode.IDLE)),
    "HOLD leads down": Machine(next_mode=_also((Mode.TRACKING, Event.HOLD), Mode.LANDING)),
    "no way back": Machine(next_mode=_also((Mode.FAULT, Event.CLEAR), Mode.FAULT)),
}  # fmt: skip


@pytest.mark.parametrize("wrong", PLANTED)
def test_each_planted_defect_is_found(wrong: str) -> None:
    with pytest.raises(AssertionError, match=wrong):
        holds(PLANTED[wrong])

"""The path in the compiled cycle: rows of the reference by their index, holds on the path, and what cuts them short."""

import numpy as np
import pytest
from cycle_rig import AT_REST, homed, noisy, tracking
from loop_rig import Cycle, bus, controller_with, stage
from numpy.typing import NDArray

from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.safety.modes import Event, Mode
from pkxyz_ctrl.safety.trips import Trip


def ramp(n: int = 16) -> NDArray[np.float64]:
    """Rows that tell their index: 1 nm a tick in x, from 1 um."""
    rows = np.zeros((n, 9))
    rows[:, 0] = 1e-6 + 1e-9 * np.arange(n)
    return rows


def index_of(row: NDArray[np.float64]) -> int:
    return round(float(row[0] - 1e-6) / 1e-9)


@pytest.mark.parametrize("delay", [1, 2])
@pytest.mark.parametrize("base", [0, 5, -3])
def test_reference_rows_by_index_and_clamped_at_both_ends(delay, base):
    # the stage of this script does not move at all, and nobody waits for it
    off = {"innovation_count": -1, "unexplained_force_count": -1, "residual_max_m": 1.0, "safe_cycles": 0}
    blind = controller_with(monitors=off)
    designed = design_law(stage(), blind, bus("fd_5k", delay), autostart=False)
    c = Cycle(designed, ramp(), Mode.IDLE)
    c.memory["homed"] = 1
    c.tick(noisy(AT_REST, 0), event=Event.ENABLE)
    for k in range(20):
        row = c.tick(noisy(AT_REST, k + 1), event=Event.TRACK if k == 0 else Event.NONE, base=base)
        assert c.mode is Mode.TRACKING
        assert row["reference_tick"] == k
        assert index_of(row["reference_m"]) == min(max(k - base, 0), 15)
        assert index_of(c.memory["after"][0]) == min(max(k - base + delay + 1, 0), 15)


SWING_M, SWING_TICKS = 100e-9, 200


def swing(tick):
    """Rows (n, 9) of a slow circle in x and y that stays within a tenth of a micrometre of rest."""
    w = 2 * np.pi / (SWING_TICKS * 200e-6)
    phase = w * 200e-6 * np.asarray(tick, float)
    rows = np.zeros((len(phase), 9))
    for order in range(3):
        rows[:, 3 * order] = SWING_M * w**order * np.cos(phase + order * np.pi / 2)
        rows[:, 3 * order + 1] = SWING_M * w**order * np.sin(phase + order * np.pi / 2)
    return rows


def asked(c, ticks, event=Event.NONE, base=0):
    """Set-points (n, 9) of so many ticks, the first with an event. ``base``: the block's first row of the path."""
    rows = []
    for k in range(ticks):
        c.tick(noisy(AT_REST, k), event=event if k == 0 else Event.NONE, base=base)
        rows.append(c.memory["here"][0].copy())
    return np.array(rows)


def phases(rows):
    """Ticks along the circle."""
    return np.unwrap(np.arctan2(rows[:, 1], rows[:, 0])) * SWING_TICKS / (2 * np.pi)


def test_hold_stops_on_the_path_and_track_goes_on_along_it():
    """The path is never left, its speed falls from 1 to 0 and rises again, nothing jumps, and a hold costs half its
    length on either side."""
    c = tracking(swing(range(300)))
    ramp_ticks = int(c.law["feed_hold_ticks"][0])
    assert ramp_ticks == 20
    asked(c, 30)
    slowing = asked(c, ramp_ticks, Event.HOLD)
    assert c.mode is Mode.ENABLED
    standing = asked(c, 15)
    assert c.mode is Mode.ENABLED
    starting = asked(c, ramp_ticks, Event.TRACK)
    assert c.mode is Mode.TRACKING
    going_on = asked(c, 30)
    rows = np.concatenate([slowing, standing, starting, going_on])
    assert np.hypot(rows[:, 0], rows[:, 1]) == pytest.approx(np.full(len(rows), SWING_M), rel=1e-6)
    steps = np.diff(phases(rows))
    assert steps.min() >= -1e-9
    assert steps.max() <= 1 + 1e-6
    assert (np.diff(steps[: ramp_ticks - 1]) < 0).all()
    assert (np.diff(steps[ramp_ticks + 15 : -31]) > 0).all()
    assert np.abs(np.diff(steps)).max() < 1.6 / ramp_ticks  # the steepest of a smooth ramp is 1.5 / n
    at = phases(standing[:1])[0]
    assert at == pytest.approx(31 + ramp_ticks / 2, abs=1e-6)
    assert not standing[:, 3:].any()
    assert going_on == pytest.approx(swing(at + ramp_ticks / 2 + np.arange(30)), rel=1e-6, abs=1e-12)
    assert c.memory["phase"][0] == 0.0
    # velocity and acceleration are those of the positions
    by_differences = (rows[2:, :3] - rows[:-2, :3]) / 400e-6
    assert np.abs(by_differences - rows[1:-1, 3:6]).max() < 0.01 * np.abs(rows[:, 3:6]).max()
    twice = (rows[2:, :3] - 2.0 * rows[1:-1, :3] + rows[:-2, :3]) / 200e-6**2
    off = np.abs(twice - rows[1:-1, 6:9]).max(axis=1) / np.abs(rows[:, 6:9]).max()
    bends = np.array([0, ramp_ticks, ramp_ticks + 15, 2 * ramp_ticks + 15])  # where the ramp begins or ends at once
    away = np.abs(np.arange(1, len(rows) - 1)[:, None] - bends).min(axis=1) > 2
    assert off[away].max() < 0.01
    assert off.max() < 0.12


def test_each_hold_stands_where_the_path_was_then():
    """Neither at rest nor at the hold before: the set-point of a hold is the last that the path asked for."""
    c = tracking(swing(range(600)))
    stood = []
    for _ in range(2):
        asked(c, 60, Event.TRACK)
        slowing = asked(c, 21, Event.HOLD)
        standing = asked(c, 30)
        assert c.mode is Mode.ENABLED
        assert standing[0, :3] == pytest.approx(slowing[-1, :3], abs=1e-12)
        assert (standing == standing[0]).all()
        stood.append(phases(standing[:1])[0])
    assert (stood[1] - stood[0]) % SWING_TICKS == pytest.approx(60, abs=1e-6)


@pytest.mark.parametrize("after", [1, 7, 13, 19])
def test_a_hold_that_is_cut_short_turns_round_without_a_jump(after):
    c = tracking(swing(range(300)))
    asked(c, 30)
    rows = [asked(c, after, Event.HOLD), asked(c, 60, Event.TRACK)]
    rows = np.concatenate(rows)
    steps = np.diff(phases(rows))
    assert np.abs(np.diff(steps)).max() < 1.6 / 20
    assert np.hypot(rows[:, 0], rows[:, 1]) == pytest.approx(np.full(len(rows), SWING_M), rel=1e-6)
    assert steps[-20:] == pytest.approx(np.ones(20), abs=1e-6)
    # between two rows of the path, at its own speed: so are velocity and acceleration, 2e-4 off as chords of a circle
    on_path = swing(phases(rows)[-20:])
    for part in (slice(3, 6), slice(6, 9)):
        assert np.abs(rows[-20:, part] - on_path[:, part]).max() < 1e-3 * np.abs(on_path[:, part]).max()
    again = np.concatenate([rows[-20:], asked(c, 40, Event.HOLD)])
    assert np.abs(np.diff(phases(again), 2)).max() < 1.6 / 20
    assert not again[-1, 3:].any()


def test_a_hold_is_the_same_wherever_the_block_of_rows_begins():
    whole, later = tracking(swing(range(300))), tracking(swing(range(300)))
    for c in (whole, later):
        asked(c, 30)
    later.reference = reference_rows(swing(range(20, 300)))
    for ticks, event in ((7, Event.HOLD), (60, Event.TRACK), (60, Event.HOLD), (60, Event.TRACK)):
        rows = asked(whole, ticks, event)
        assert asked(later, ticks, event, base=20) == pytest.approx(rows, rel=1e-9, abs=1e-15)


BEFORE = {
    "standing on the path": [(60, Event.HOLD)],
    "slowing down": [(7, Event.HOLD)],
    "starting again": [(60, Event.HOLD), (7, Event.TRACK)],
    "between two rows of the path": [(7, Event.HOLD), (60, Event.TRACK)],
}


@pytest.mark.parametrize("before", BEFORE.values(), ids=BEFORE)
def test_a_loop_that_is_closed_again_holds_rest_and_the_path_begins_anew(before):
    """Nothing of a hold outlives the way down: neither where it stood, nor where the path was, nor that it was asked
    for, by which the path would begin with a ramp.
    """
    c = tracking(swing(range(300)))
    asked(c, 30)
    for ticks, event in before:
        asked(c, ticks, event)
    assert c.memory["here"][0, :3].any()
    asked(c, 60, Event.DISABLE)
    assert c.mode is Mode.IDLE
    held = asked(c, 30, Event.ENABLE)
    assert c.mode is Mode.ENABLED
    assert not held.any()
    assert np.array_equal(asked(c, 40, Event.TRACK), swing(range(40)))


@pytest.mark.parametrize("before", BEFORE.values(), ids=BEFORE)
def test_a_path_does_not_go_on_after_a_fault(before):
    """Else the record would show a set-point that moves where nothing is driven."""
    c = tracking(swing(range(300)))
    asked(c, 30)
    for ticks, event in before:
        asked(c, ticks, event)
    c.tick(noisy(AT_REST, 0), trips=int(Trip.GATE_BLOCKED))
    assert c.mode is Mode.FAULT
    rows = asked(c, 30)
    assert (rows == rows[0]).all()


def test_the_automatic_start_leaves_a_hold_alone():
    c = homed(autostart=True, reference=swing(range(300)))
    asked(c, 40)
    assert c.mode is Mode.TRACKING
    asked(c, 60, Event.HOLD)
    assert c.mode is Mode.ENABLED
    asked(c, 1, Event.TRACK)
    assert c.mode is Mode.TRACKING


def test_the_automatic_start_no_longer_knows_of_a_hold_once_the_stage_was_led_down():
    c = homed(autostart=True, reference=swing(range(300)))
    asked(c, 40)
    asked(c, 60, Event.HOLD)
    assert c.mode is Mode.ENABLED
    asked(c, 60, Event.DISABLE)
    assert c.mode is Mode.TRACKING

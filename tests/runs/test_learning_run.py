"""Learning in the running loop: how much, how soon, that it does no harm, and the same bits in every lane."""

import dataclasses

import numpy as np
import pytest
from learning_rig import PERIOD, errors_of, setup
from loop_rig import first_difference

from hil.lanes.fast import run_block
from hil.lanes.in_process import instants_us
from hil.lanes.live_reference import LiveReference
from hil.runs.learning import belongs
from hil.runs.period_errors import PeriodErrors
from pkxyz_ctrl.learning import LearningConfig
from pkxyz_ctrl.learning.store import Stored
from pkxyz_ctrl.learning.timetable import FADE_TICKS
from pkxyz_ctrl.loop.cycle import new_memory
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode


def stored_of(run_setup, learner):
    here = belongs(run_setup.trajectory, run_setup.stage, run_setup.controller, run_setup.bus)
    return Stored(here, learner.correction, {})


@pytest.fixture(scope="module")
def harsh():
    return errors_of(setup())


def test_ten_times_less_within_five_periods_on_the_harsh_plant(harsh):
    errors, learner, _ = harsh
    assert 30.0 < errors.sensed_nm[0] < 120.0
    assert 10.0 < errors.figures().learning_factor < 40.0
    assert 7.0 < errors.figures().learning_factor_true < 30.0  # gain errors of the sense chain are not seen
    assert [step.share for step in learner.steps] == [1.0] * learner.table.windows
    assert sum(step.reverted for step in learner.steps) <= 2


def test_learning_changes_nothing_before_it_has_seen_a_window(harsh):
    _, learner, rows = harsh
    _, _, plain = errors_of(setup(learning=None))
    change = int(np.flatnonzero(rows["reference_tick"] == learner.table.change(0))[0])
    assert first_difference(rows[: change - 4], plain[: change - 4]) is None
    assert first_difference(rows, plain) is not None
    assert np.array_equal(rows["reference_m"], plain["reference_m"])  # a record shows what was asked for


@pytest.mark.parametrize(("plant", "seed"), [("nominal", 2), ("mild", 3), ("harsh", 4), ("harsh", 5)])
def test_it_never_makes_a_period_worse(plant, seed):
    """Than without learning, the same period of the same seed, but for what noise explains."""
    with_it, _, _ = errors_of(setup(plant, seed))
    without, _, _ = errors_of(setup(plant, seed, learning=None))
    noise_nm = {"nominal": 0.5, "mild": 0.5, "harsh": 1.0}[plant]
    for learnt, plain in ((with_it.sensed_nm, without.sensed_nm), (with_it.true_nm, without.true_nm)):
        assert len(learnt) == len(plain) == 8
        assert (np.array(learnt) < np.array(plain) + noise_nm).all()


def test_a_quiet_plant_comes_down_to_its_noise():
    errors, _, rows = errors_of(setup("nominal"))
    still = next(s.still_us for s in setup().trajectory.segments if s.still_us)
    t_us = rows["reference_tick"] * setup().bus.period_us
    hold = rows[(t_us >= still[0]) & (t_us < still[1])]
    floor_nm = (hold["position_m"] - hold["reference_m"]).std(axis=0) * 1e9
    last = np.sqrt(np.mean([line**2 for line in errors.line_error_nm[5:]], axis=0))
    assert (last < 1.2 * floor_nm.max()).all()
    assert (last > 0.7 * floor_nm.min()).all()


def test_both_lanes_learn_the_same_bits():
    short = setup(frames=4)
    _, fast, fast_rows = errors_of(short)
    _, slow, slow_rows = errors_of(short, "lockstep")
    assert first_difference(fast_rows, slow_rows) is None
    assert np.array_equal(fast.correction, slow.correction)
    assert fast.steps == slow.steps
    assert np.abs(fast.correction).max() > 1e-9


def test_in_pieces_between_ticks_it_learns_the_same_bits():
    """As the wall clock has it: rows written ahead a few at a time, work done in pieces."""
    short = setup(frames=4)
    _, fast, fast_rows = errors_of(short)
    law, plant, memory = short.law, short.new_plant(), new_memory(Mode.IDLE)
    live = LiveReference(short.trajectory, short.bus.period_us, short.new_learner())
    rows = np.zeros(1, ROW)
    sample_us = instants_us(short, 0, short.ticks)
    for tick in range(short.ticks):
        run_block(law, memory, live.rows, plant.params, plant.state, sample_us[tick : tick + 1], rows, 1)
        live.after(memory)
        assert first_difference(rows, fast_rows[tick : tick + 1]) is None, tick
    assert np.array_equal(live.learner.correction, fast.correction)


def test_applying_begins_where_learning_ended_and_changes_nothing_more(harsh):
    learnt_errors, learner, _ = harsh
    stored = stored_of(setup(), learner)
    applying = dataclasses.replace(
        setup(frames=4, learning=LearningConfig(mode="apply", file="learnt.json")), stored=stored
    )
    errors, applied, _ = errors_of(applying)
    assert np.array_equal(applied.correction, learner.correction)
    assert applied.steps == []
    assert errors.sensed_nm[0] < 0.1 * learnt_errors.sensed_nm[0]  # with what the way in has stirred up, once
    later = np.array(errors.sensed_nm[1:]) / learnt_errors.sensed_nm[-1]
    assert ((later > 0.7) & (later < 1.4)).all()


def test_refresh_goes_on_from_what_was_stored(harsh):
    learnt_errors, learner, _ = harsh
    half = Stored(stored_of(setup(), learner).belongs, 0.5 * learner.correction, {})
    refresh = dataclasses.replace(setup(learning=LearningConfig(mode="refresh", file="learnt.json")), stored=half)
    errors, _, _ = errors_of(refresh)
    assert 0.3 < errors.sensed_nm[0] / learnt_errors.sensed_nm[0] < 0.7
    assert errors.sensed_nm[-1] < 1.3 * learnt_errors.sensed_nm[-1]


def test_a_correction_that_suits_another_device_is_unlearnt(harsh):
    """A plant that has changed: what the harsh one taught makes the nominal one worse, and is taken back."""
    _, learner, _ = harsh
    run = setup("nominal", learning=LearningConfig(mode="refresh", file="learnt.json"))
    errors, _, _ = errors_of(dataclasses.replace(run, stored=stored_of(setup(), learner)))
    assert errors.sensed_nm[0] > 20.0
    assert errors.sensed_nm[-1] < 3.0
    assert errors.figures().learning_factor > 10.0


def test_limits_that_leave_no_room_leave_the_reference_alone():
    run = setup(frames=4)
    learner = run.new_learner()
    learner._within_limits = lambda rows: False
    _, _, rows = errors_of(setup(frames=4, learning=None))
    for part in np.split(rows, np.flatnonzero(rows["reference_tick"] == learner.due)):
        learner.see(part)
        learner.finish()
    assert learner.steps[0].share == 0.0
    assert not learner.shift(0, 5 * PERIOD).any()


def test_from_a_window_with_a_missing_sample_nothing_is_learnt():
    run = setup(frames=4)
    _, taught, rows = errors_of(setup(frames=4, learning=None))
    for field, value in (("sense_status", 1), ("overrun", 2)):
        learner = run.new_learner()
        table = learner.table
        damaged = rows.copy()
        damaged[field][np.flatnonzero(rows["reference_tick"] == table.window_begin(0) + 77)] = value
        stop = int(np.flatnonzero(rows["reference_tick"] == table.window_end(0))[0])
        learner.see(damaged[:stop])
        learner.finish()
        assert learner.steps[0].share is None
        assert not learner.shift(0, 5 * PERIOD).any()
    assert taught is None


def test_a_reference_that_begins_anew_is_left_alone():
    run = setup(frames=4)
    learner = run.new_learner()
    _, _, rows = errors_of(setup(frames=4, learning=None))
    stop = int(np.flatnonzero(rows["reference_tick"] == learner.due)[0])
    learner.see(rows[:stop])
    learner.finish()
    table = learner.table
    assert learner.shift(table.change(0) + FADE_TICKS, 10).any()
    learner.see(rows[rows["reference_tick"] == 0])
    assert not learner.shift(table.change(0) + FADE_TICKS, 10).any()
    assert learner.due > table.end


def test_errors_by_period_are_those_of_the_rows(harsh):
    errors, learner, rows = harsh
    first = int(np.flatnonzero(rows["reference_tick"] == learner.table.begin)[0])
    part = rows[first + 2 * PERIOD : first + 3 * PERIOD]
    error = part["position_m"] - part["reference_m"]
    spectrum = np.fft.rfft(error, axis=0)[1 : len(learner.correction) + 1] / PERIOD
    assert errors.true_nm[2] == pytest.approx(np.sqrt(2 * (np.abs(spectrum) ** 2).sum()) * 1e9, rel=1e-12)
    whole = PeriodErrors(setup().trajectory, 200, LearningConfig())
    whole.update(rows)
    assert whole.sensed_nm == errors.sensed_nm

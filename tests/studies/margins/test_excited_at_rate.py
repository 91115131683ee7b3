"""A loop excited at the machine's clock: what is measured there is what is measured in the lanes, and ticks that a busy
machine misses spoil their periods and not the result.
"""

import dataclasses
import json

import numpy as np
import pytest
from command_line import pkxyz
from loop_rig import MIDDLE, bus, setup, stage
from patience import patient_law, slow_bus, slow_stage
from two_processes import plant_on

from hil.lanes import in_process
from hil.lanes.excitation import Excitation, Passage, excitation, tones
from hil.lanes.lane import Lane
from hil.lanes.streamed_reference import StreamedReference
from hil.studies.excited_lane import lane_on
from hil.studies.margins import excited
from hil.studies.margins.excited import PERIODS_LEAST, MeasurementError, at_point
from hil.studies.margins.measured import measure
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.law_about import law_about
from pkxyz_ctrl.design.margins.sensitivity import closed_loop
from pkxyz_ctrl.design.margins.settling import settling_ticks
from pkxyz_ctrl.design.model.discrete_law import LawError
from pkxyz_ctrl.design.model.loop_plant import Perturbation, loop_plant
from pkxyz_ctrl.loop.cycle import MEMORY

pytestmark = pytest.mark.at_rate

PERIOD_TICKS = 250
SETTLED_TICKS = 70
"""More than the 52 ticks that this loop takes for 1e-3 of what stirs it up."""


def five_periods():
    added = excitation(
        "multisine", tones(PERIOD_TICKS, 12, 3), period_ticks=PERIOD_TICKS, periods=5, amplitude_m=8e-9, first_tick=0,
        seed=3,
    )  # fmt: skip
    return at_point(setup(), MIDDLE, added)


def played_back(run, monkeypatch, change=lambda rows: None):
    """What is measured where the machine's clock gives the rows of the fast lane, ``change``d."""
    blocks = []
    in_process.run(run, Lane.FAST, on_block=lambda block: blocks.append(block.copy()))
    rows = np.concatenate(blocks)
    change(rows)
    monkeypatch.setattr(excited, "run_at_rate", lambda setup, say, on_progress: (rows, ()))
    return measure(run, Lane.WALL)


def test_the_same_rows_measure_the_same(monkeypatch):
    run = five_periods()
    at_rate, fast = played_back(run, monkeypatch), measure(run, Lane.FAST)
    assert np.array_equal(at_rate.s, fast.s)
    assert np.array_equal(at_rate.standard_error, fast.standard_error)
    assert (at_rate.periods, at_rate.missed_ticks) == (5, 0)


@pytest.mark.parametrize("how", ["overrun", "sense_status"])
@pytest.mark.parametrize(("into", "lost"), [(100, {1}), (PERIOD_TICKS - 10, {1, 2})])
def test_a_missed_tick_costs_its_period_and_the_next_only_if_the_loop_is_still_settling(how, into, lost, monkeypatch):
    """Nonsense in both changes not a bit of what the other periods of each axis say."""
    run = five_periods()
    second = run.excitation.measured_from(0) + PERIOD_TICKS

    def miss(rows):
        at = np.flatnonzero(rows["reference_tick"] == second + into)[0]
        rows[how][at] |= 1
        spoilt = slice(at, at + SETTLED_TICKS)
        rows["measurement_m"][spoilt] += np.random.default_rng(1).normal(0.0, 1e-6, (SETTLED_TICKS, 3))

    seen = played_back(run, monkeypatch, miss)
    assert (seen.periods, seen.missed_ticks) == (5 - len(lost), 1)
    untouched = measure(run, Lane.FAST)
    assert np.abs(seen.s - untouched.s).max() < 6.0 * untouched.standard_error.max()
    kept = excited.excite(run, Lane.WALL, ("measurement_m",)).periods
    assert list(kept[0]) == sorted(set(range(5)) - lost)
    assert [list(each) for each in kept[1:]] == [list(range(5 - len(lost)))] * 2


def test_a_loop_settles_as_fast_as_what_a_pulse_leaves_of_itself_says():
    """By the poles' own decay, an independent bound; a lightly damped loop takes its time."""
    plant = loop_plant(stage(), bus(), MIDDLE)
    for name, least, most in (("lqg", 55, 90), ("youla", 55, 90), ("pi_notch", 100, 400)):
        law = design_law(stage(), load("controllers", name, ControllerConfig), bus(), autostart=True)
        about = law_about(stage(), law, MIDDLE)
        found = settling_ticks(plant, about)
        slowest = np.abs(np.linalg.eigvals(closed_loop(plant, about))).max()
        assert least < found < most
        assert found < 3.0 * np.log(1e-4) / np.log(slowest)
        assert settling_ticks(plant, about, most=20) == 20
    with pytest.raises(LawError, match="never settles"):
        settling_ticks(loop_plant(stage(), bus(), MIDDLE, Perturbation(comb_gain=(3.0, 3.0, 3.0))), about)


def test_where_the_model_would_not_be_stable_a_whole_period_has_to_be_undisturbed(monkeypatch):
    """A slow loop whose stage the file describes badly: it was closed, so it is measured."""
    run, plant_of = five_periods(), excited.loop_plant
    too_strong = Perturbation(comb_gain=(3.0, 3.0, 3.0))
    monkeypatch.setattr(excited, "loop_plant", lambda stage, bus, strokes, _: plant_of(stage, bus, strokes, too_strong))

    def miss(rows):
        second = run.excitation.measured_from(0) + PERIOD_TICKS
        rows["overrun"][np.flatnonzero(rows["reference_tick"] == second + 100)[0]] = 1

    assert played_back(run, monkeypatch, miss).periods == 3


def test_a_machine_that_misses_too_many_measures_nothing(monkeypatch):
    run = five_periods()

    def miss(rows):
        at = run.excitation.measured_from(1) + np.array([30, 500, 800, 1100])
        rows["overrun"][np.isin(rows["reference_tick"], at)] = 3

    with pytest.raises(MeasurementError, match=f"4 ticks were missed, which leaves 1 .*{PERIODS_LEAST} are"):
        played_back(run, monkeypatch, miss)


def test_a_period_after_a_spoilt_one_is_left_out_wherever_it_lies():
    """Exhaustively: one tick of one passage, the settling period included, whatever the loop takes to settle."""
    n, m = 4, 5
    played = Excitation(n, m, 1.0, 7, (Passage(0, np.array([1]), np.zeros(1)), Passage(1, np.array([1]), np.zeros(1))))
    for tick in range(played.ticks):
        spoilt = np.zeros(played.ticks, np.bool_)
        spoilt[tick] = True
        for passage in range(2):
            for settling in range(3 * n):
                begins = {k: played.measured_from(passage) + k * n for k in range(m)}
                lost = {k for k, begin in begins.items() if begin - settling <= tick < begin + n}
                assert set(played.undisturbed(passage, spoilt, settling)) == set(range(m)) - lost


def test_an_excitation_streamed_in_pieces_is_that_of_the_lanes():
    run = dataclasses.replace(five_periods(), duration_s=1.0)
    memory = np.zeros(1, MEMORY)
    streamed = StreamedReference(run.trajectory, run.bus.period_us, memory, run.excitation)
    for tick in range(run.excitation.ticks):
        memory["reference_tick"] = tick
        rows = streamed(tick)
        at = tick - int(rows["tick"][0])
        assert rows["tick"][at] == tick
        if tick % 7 == 0:
            assert np.array_equal(rows["added_m"][at], run.excitation.sample(tick, 1)[0])
        streamed.prepare()


def test_bus_lane_and_plant_go_together_or_it_is_said():
    fd_5k, unix_2k = (load("buses", name, BusConfig) for name in ("fd_5k", "unix_2k"))
    assert lane_on(fd_5k, None, "harsh") == Lane.FAST
    assert lane_on(fd_5k, Lane.LOCKSTEP, None) == Lane.LOCKSTEP
    assert lane_on(unix_2k, None, None) == Lane.WALL
    for on_bus, lane, plant, words in (
        (unix_2k, Lane.FAST, None, "leads to other processes or devices, where no lane can be chosen"),
        (unix_2k, None, "harsh", "`pkxyz plant --plant harsh` serves this one"),
        (fd_5k, Lane.WALL, None, "is simulated and ends with this process; give a --bus"),
    ):
        with pytest.raises(ConfigError, match=words):
            lane_on(on_bus, lane, plant)


def test_a_loop_is_excited_over_a_bus_to_another_process(tmp_path):
    """On the plant as drawn, ten times slower than the stage: late ticks move the samples, not so that it would be told
    from the computed loop by more than 5 % of its greatest S.
    """
    slow, device = slow_bus(tmp_path / "bus.toml"), slow_stage(tmp_path / "slow.toml")
    words = ("--bus", slow, "--stage", device, "--controller", patient_law(tmp_path), "--periods", "5", "--json")
    with plant_on(slow, device):
        done = pkxyz("margins", "--measured", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    measured, computed = told["measured"], told["computed"]
    assert measured["lane"] == "wall"
    assert PERIODS_LEAST <= measured["periods"] <= 20
    assert measured["tones"] >= 8
    assert all(error > 0.0 for error in (measured["agreement"]["bound"], measured["agreement"]["mean_square"]))
    for which in ("x", "y", "z", "mimo"):
        for what, within in (("peak_s", 0.05), ("disk_margin", 0.1), ("bandwidth_hz", 0.15)):
            assert measured[which][what] == pytest.approx(computed[which][what], rel=within), (which, what)
    assert measured["agreement"]["largest_difference"] < 0.05 * computed["mimo"]["peak_s"]

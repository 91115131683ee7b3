"""The search for a drawing: what it keeps to, what it values, and that it goes on where it stopped."""

from dataclasses import replace

import numpy as np
import optuna
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from process_rig import SHIPPED, STAGE, process

from hil.bench.study import short_scan
from hil.runs.scenario import load_scenario
from hil.studies.spread.trials import judged
from hil.studies.wafer.closed_loop import PART_DEVICES, ClosedLoops
from hil.studies.wafer.drawing import FINGER_M, OPEN, DrawingProblem, evaluate, least_room, working
from hil.studies.wafer.drawing_search import Confirmed, best, gained, nearest, open_study, search
from hil.studies.wafer.effects import MEAN, effects, standard_deviation
from pkxyz_ctrl.config.bound import Bound
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.fabrication.process import Spread
from pkxyz_ctrl.fabrication.wafer import sample_wafers, sizes
from pkxyz_ctrl.mechanics.selection import MARGINS, Requirements, margins


def problem(**changes):
    laws = tuple(load("controllers", name, ControllerConfig) for name in ("youla", "lqg"))
    return replace(DrawingProblem(Requirements(), STAGE, SHIPPED, load_scenario("raster"), laws, 1, 2), **changes)


def drawn():
    return problem().nearest_choice(STAGE)


# -- what a choice is ------------------------------------------------------------------------------------------------


def test_the_templates_own_choice_is_its_drawing_with_fingers_as_high_as_the_layer():
    stage = problem().stage(drawn(), "reconstructed")
    assert stage.geometry == STAGE.geometry
    assert stage.flexures == STAGE.flexures
    for name in ("drive_comb", "sense_comb"):
        assert getattr(stage, name) == getattr(STAGE, name).model_copy(update={"finger_height_m": 90e-6})


@settings(max_examples=50, deadline=None)
@given(st.floats(4.0, 8.0))
def test_a_comb_is_never_longer_than_drawn_nor_shorter_by_a_finger(gap_um):
    comb = problem().flexed(drawn() | {"gap_um": gap_um}).drive_comb
    pitch = comb.finger_gap_m + FINGER_M
    room = STAGE.drive_comb.finger_count * (STAGE.drive_comb.finger_gap_m + FINGER_M)
    assert comb.finger_count * pitch <= room * (1.0 + 1e-9)
    assert (comb.finger_count + 1) * pitch > room


def test_the_inequalities_are_those_of_design_and_the_cube_is_exact():
    asked = problem()
    kept, by_design = asked.margins(drawn()), margins(asked.need, STAGE, 500e-6, 500e-6)
    cube = MARGINS.index("cube")
    assert np.array_equal(np.delete(kept, cube), np.delete(by_design, cube))
    assert 0.0 < kept[cube] <= by_design[cube] + 1e-6


def test_what_misses_an_inequality_is_not_looked_at_any_further():
    found = evaluate(problem(), drawn() | {"projection_um": 549.0})
    assert found.value is None
    assert "cube" in found.reason
    assert [name for name, beyond in found.constraints.items() if beyond >= 0.0] == ["cube"]


def test_what_is_kept_is_valued_by_devices_that_work():
    found = evaluate(problem(), drawn())
    assert found.value is not None
    assert found.figures["works"] in (0.0, 0.5, 1.0)  # of two devices
    assert found.figures["works"] < found.value < found.figures["works"] + 0.5
    assert all(beyond < 0.0 for beyond in found.constraints.values())


def test_devices_of_a_choice_are_run_together_to_the_bits_of_each_alone(monkeypatch):
    """A part and two more."""
    asked = problem(loops=PART_DEVICES + 2, scenario=short_scan())
    together, at_once = ClosedLoops.devices, []

    def noted(self, numbers):
        at_once.append(len(numbers))
        return together(self, numbers)

    monkeypatch.setattr(ClosedLoops, "devices", noted)
    found = evaluate(asked, drawn())
    assert at_once == [PART_DEVICES, 2]
    monkeypatch.setattr(ClosedLoops, "devices", lambda self, numbers: [together(self, numbers[[n]])[0] for n in
                                                                      range(len(numbers))])  # fmt: skip
    assert evaluate(asked, drawn()) == found
    assert found.figures["room"] != 0.0


def test_a_drawing_gets_the_law_that_leaves_it_the_lowest_peak():
    asked = problem()
    stage = asked.stage(drawn() | {"crank_hinge_um": 4.4, "leaf_um": 8.5, "leaf_length": 0.95}, "other")
    peaks = {law.name: asked.closed(stage, law, 1).drawn_peak_s() for law in asked.laws}
    assert asked.law(stage).name == min(peaks, key=peaks.get) == "lqg"
    assert peaks["youla"] > 2.5  # its taps are the shipped drawing's


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=20), st.floats(0.1, 100.0))
def test_room_is_positive_just_where_every_bound_is_kept(values, limit):
    found = {"a": np.array(values), "b": -np.array(values)}
    bounds = {"a": Bound(max=limit), "b": Bound(min=-2.0 * limit, max=3.0 * limit), "c": Bound(max=-1.0)}
    room = least_room(found, bounds)
    kept = (found["a"] < limit) & (found["b"] > -2.0 * limit) & (found["b"] < 3.0 * limit)
    assert ((room > 0.0) == kept).all()
    assert (np.abs(room) < 1.0).all()


def test_a_loop_that_ended_in_a_fault_has_no_room_at_all():
    assert least_room({"a": np.array([np.inf])}, {"a": Bound(max=5.0)}) == pytest.approx(-1.0, abs=1e-5)


# -- the search ------------------------------------------------------------------------------------------------------


def test_the_digest_is_that_of_the_whole_problem():
    asked, scenario = problem(), problem().scenario
    others = [
        problem(seed=2), problem(loops=3), problem(need=Requirements(stroke_m=24e-6)), problem(laws=asked.laws[:1]),
        problem(process=process()), problem(template=STAGE.model_copy(update={"name": "other"})),
        problem(scenario=replace(scenario, plant=load_scenario("raster_mild").plant)),
        problem(scenario=replace(scenario, bus=scenario.bus.model_copy(update={"period_us": 250}))),
        problem(scenario=replace(scenario, config=scenario.config.model_copy(update={"duration_s": 1.2}))),
    ]  # fmt: skip
    assert len({p.digest() for p in [asked, *others]}) == 1 + len(others)


def tried(study):
    return [(t.state, t.params, t.value) for t in judged(study)]


def test_a_search_that_was_killed_goes_on_and_tries_what_it_would_have_tried(tmp_path):
    asked = problem(need=Requirements(cube_side_m=25e-6))  # no drawing keeps that: nothing is run
    whole = open_study(asked, tmp_path / "whole.db", [drawn()])
    search(whole, asked, 12, 1)
    begun = open_study(asked, tmp_path / "begun.db", [drawn()])
    search(begun, asked, 4, 1)
    begun.ask()  # it was killed in the middle of this one
    again = open_study(asked, tmp_path / "begun.db", [drawn()])
    search(again, asked, 12, 2)
    assert tried(again) == tried(whole)
    assert len(tried(whole)) == 12
    assert tried(whole)[0][1] == drawn()
    assert best(whole, 3) == []
    assert nearest(whole)["cube"] > 0.1
    for trial in judged(whole):
        assert trial.state == optuna.trial.TrialState.PRUNED
        assert all(OPEN[k].low * drawn()[k] <= v <= OPEN[k].high * drawn()[k] for k, v in trial.params.items())


def test_a_study_of_another_problem_is_refused(tmp_path):
    open_study(problem(), tmp_path / "study.db", [])
    with pytest.raises(ConfigError, match=r"--out: .*is of another problem"):
        open_study(problem(seed=2), tmp_path / "study.db", [])
    (tmp_path / "text.db").write_text("no database")
    with pytest.raises(ConfigError, match="give another --out, of a database that can be written"):
        open_study(problem(), tmp_path / "text.db", [])


def test_a_gain_is_counted_device_by_device():
    columns = {"device": np.arange(8)}
    one, other = (Confirmed(columns, np.array(w, bool)) for w in ([1, 1, 1, 1, 1, 1, 0, 0], [1, 1, 1, 1, 0, 0, 0, 1]))
    by, within = gained(one, other)
    assert by == pytest.approx(1 / 8)
    assert within == pytest.approx(1.96 * np.std([0, 0, 0, 0, 1, 1, 0, -1], ddof=1) / np.sqrt(8))
    assert one.share.passed == 6


def test_a_device_works_if_it_does_under_both_laws_and_by_itself():
    asked = problem().closed(STAGE, problem().laws[0], 1)
    found = {name: np.full(4, 1.0) for name in asked.columns} | {"own": np.array([1.0, 0.0, 1.0, 1.0])}
    found["shipped.error_nm"] = np.array([1.0, 1.0, 2000.0, 1.0])
    found["known.error_about_mean_nm"] = np.array([1.0, 1.0, 1.0, 6.0])
    assert working(asked, found).tolist() == [True, False, False, False]


# -- what a source does ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["etch_bias_m", "layer_1_m", "handle_m", "hinge_m"])
def test_a_sources_standard_deviation_is_that_of_its_devices(name):
    spread = getattr(SHIPPED, name)
    size = sizes(SHIPPED, sample_wafers(SHIPPED, 3, range(300)))[name].mean(axis=1)
    assert standard_deviation(spread) == pytest.approx(size.std(), rel=0.12)


def test_a_thicker_handle_is_the_error_that_is_left_and_other_springs_are_not():
    only = {"handle_m": SHIPPED.handle_m, "etch_bias_m": SHIPPED.etch_bias_m}
    asked = problem(process=process(**only)).closed(STAGE, problem().laws[0], 1)
    found = effects(asked)
    assert set(found) == {MEAN, *only}
    figure = {name: figures["known.error_about_mean_nm"] for name, figures in found.items()}
    assert figure["handle_m"] > 2.0 * figure[MEAN]
    assert figure["etch_bias_m"] < 1.5 * figure[MEAN]
    assert standard_deviation(Spread()) == 0.0

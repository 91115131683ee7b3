"""Tuning: how numbers are valued, against what the parts say, and a small study from search file to controller."""

import json

import numpy as np
import pytest
from loop_rig import MIDDLE, bus, rows_of, setup, stage
from typer.testing import CliRunner

from hil.cli import app
from hil.pictures.tuning import draw_tuning
from hil.studies.margins.loop import Loop, over_changed_plants
from hil.studies.spread.cluster import Cluster
from hil.studies.spread.workers import as_done, worker_pool
from hil.studies.tune.search import UNUSABLE, evaluate, load_problem
from hil.studies.tune.taps import asks_for_taps
from hil.studies.tune.tuning import best, importances, nearest, open_study, rounded, search, write_controller
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import CONFIG_DIR, ConfigError, load, names
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.margins.tolerances import Tolerances

LQG = (CONFIG_DIR / "searches" / "lqg.toml").read_text(encoding="utf-8")


def problem_with(folder, *changes):
    text = LQG
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "search.toml"
    path.write_text(text, encoding="utf-8")
    return load_problem(path)


EASY = (('plants = ["nominal", "mild"]', 'plants = ["nominal"]'), ('points = "all"', 'points = "middle"'))
BY_MARGINS = (*EASY, ('objective = "rms_error_nm"', 'objective = "bandwidth_hz"'))


def test_every_shipped_search_is_one_of_its_controllers_numbers():
    for name in names("searches"):
        if asks_for_taps(name):
            continue
        problem = load_problem(name)
        assert len(problem.start()) == len(problem.search.number)


def test_the_shipped_law_is_valued_at_what_its_run_and_its_margins_say(tmp_path):
    problem = problem_with(tmp_path, *EASY)
    evaluation = evaluate(problem, {})
    rows, _ = rows_of(setup(), "fast")
    scan = setup().trajectory.segments
    window = next(s.scan_us for s in scan if s.scan_us)
    t_us = rows["reference_tick"] * bus().period_us
    inside = (rows["reference_tick"] >= 0) & (t_us >= window[0]) & (t_us < window[1])
    error = (rows["position_m"] - rows["reference_m"])[inside]
    assert evaluation.value == pytest.approx(1e9 * np.sqrt((error**2).mean(axis=0)).max(), rel=1e-6)
    assert max(evaluation.constraints.values()) <= 0.0
    found = Loop(stage(), bus(), setup().law).margins(MIDDLE).mimo
    assert evaluation.figures["peak_s"] == found.peak_s
    assert evaluation.figures["bandwidth_hz"] == found.bandwidth_hz
    assert evaluation.constraints["peak_s_max"] == found.peak_s / 2.0 - 1.0


def test_at_all_points_the_changed_plants_are_those_of_the_margins_command(tmp_path):
    """135 of them, of which the worst is not at mid-workspace; looked at only where the goals are kept there."""
    everywhere = (EASY[0], BY_MARGINS[-1])
    evaluation = evaluate(problem_with(tmp_path, *everywhere), {})
    changed = over_changed_plants(Loop(stage(), bus(), setup().law), load("tolerances", "wide", Tolerances).cases())
    assert evaluation.figures["peak_s_changed"] == changed.worst[1]
    assert max(evaluation.constraints.values()) <= 0.0
    missed = evaluate(problem_with(tmp_path, *everywhere, ("bandwidth_min_hz = 40.0", "bandwidth_min_hz = 94.0")), {})
    assert missed.figures["peak_s_changed"] == max(changed.peak_s[:15]) < changed.worst[1]


def test_what_misses_a_margin_is_not_run_and_what_is_no_loop_misses_all(tmp_path):
    problem = problem_with(tmp_path, *EASY, ("bandwidth_min_hz = 40.0", "bandwidth_min_hz = 94.0"))
    evaluation = evaluate(problem, {})
    assert evaluation.value is None
    assert evaluation.reason == "misses bandwidth_min_hz"
    assert evaluation.constraints["bandwidth_min_hz"] == pytest.approx(0.5, abs=0.01)  # 47 Hz
    hopeless = evaluate(problem, {"regulator.force_n": -1.0})
    assert set(hopeless.constraints.values()) == {UNUSABLE}
    assert "greater than 0" in hopeless.reason


def test_a_key_that_is_not_there_is_named_with_those_that_are(tmp_path):
    for old, words in (("regulator.force_n", "position_error_m"), ("estimator.force_noise_n_per_rthz", "regulator")):
        with pytest.raises(ConfigError, match=words):
            problem_with(tmp_path, (old, old.replace("_n", "_newton") if "reg" in old else "estimate.x"))
    with pytest.raises(ConfigError, match="low must be below high"):
        problem_with(tmp_path, ("low = 2.0e-10", "low = 1.0"))


def test_a_study_goes_on_where_it_was_and_its_best_is_a_controller_that_runs(tmp_path):
    """By margins, without runs; one process."""
    problem = problem_with(tmp_path, *BY_MARGINS)
    storage = f"sqlite:///{tmp_path / 'study.db'}"
    search(open_study(problem, storage, 1), problem, 5, 1)
    study = open_study(problem, storage, 1)
    assert len(study.trials) == 5
    first = best(study, problem)
    assert first is not None
    assert first.value >= 47.0  # the shipped numbers are the first trial
    search(study, problem, 1, 1)
    assert len({tuple(t.params.values()) for t in study.trials}) == 6  # it doesn't begin with the same choices again
    found = best(study, problem)
    path = tmp_path / "mine.toml"
    write_controller(problem, found, path)
    assert "# Bryson weights" in path.read_text()
    controller = load("controllers", path, ControllerConfig)
    assert controller.regulator.force_n == found.numbers["regulator.force_n"]
    loop = Loop(stage(), bus(), design_law(stage(), controller, bus(), autostart=True))
    assert loop.margins(MIDDLE).mimo.bandwidth_hz == pytest.approx(found.value, rel=1e-9)
    importance = importances(study)
    assert importance.keys() <= {n.key for n in problem.search.number}
    draw_tuning(study, problem, importance, tmp_path)
    assert (tmp_path / "history.png").stat().st_size > 5000
    with pytest.raises(ConfigError, match="another problem"):
        open_study(problem_with(tmp_path, *BY_MARGINS, ("peak_s_max = 2.0", "peak_s_max = 1.9")), storage, 1)


def test_a_database_that_cannot_be_had_is_one_line():
    with pytest.raises(ConfigError, match="--storage"):
        open_study(load_problem("lqg"), "sqlite:////nowhere/at/all.db", 1)


def test_without_numbers_that_keep_all_the_command_says_what_is_missed(tmp_path):
    problem_with(tmp_path, *BY_MARGINS, ("peak_s_max = 2.0", "peak_s_max = 1.0"))
    arguments = ["tune", str(tmp_path / "search.toml"), "--trials", "1", "--workers", "1", "--out", str(tmp_path / "o")]
    done = CliRunner().invoke(app, [*arguments, "--json"])
    assert done.exit_code == 1, done.output
    data = json.loads(done.stdout)
    assert data["best"] is None
    assert data["missed"] == {"peak_s_max": pytest.approx(0.63, abs=0.01)}
    assert not list((tmp_path / "o").glob("*.toml"))


def test_numbers_are_tried_with_the_digits_that_are_written():
    assert rounded(0.123456) == 0.1235
    assert rounded(1.99999e-7) == 2e-7


# -- workers ---------------------------------------------------------------------------------------------------------


def square(n):
    return n * n


def test_a_dask_cluster_does_the_same_as_processes():
    from distributed import LocalCluster

    with (
        LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None) as cluster,
        worker_pool(1, Cluster(cluster.scheduler_address)) as (pool, width),
    ):
        assert width == 2
        assert dict(as_done(pool, width, square, range(20))) == {n: n * n for n in range(20)}


def test_no_scheduler_is_one_line(monkeypatch):
    import distributed

    def refuse(address, **_):
        raise OSError("timed out")

    monkeypatch.setattr(distributed, "Client", refuse)
    with (
        pytest.raises(ConfigError, match=r"no scheduler answers at tcp://127\.0\.0\.1:1"),
        worker_pool(1, Cluster("tcp://127.0.0.1:1")),
    ):
        pass


def test_items_are_asked_for_when_a_hand_is_free():
    """So that each choice may look at what is known by then."""
    from concurrent.futures import ThreadPoolExecutor

    known = []

    def items():
        for n in range(6):
            assert len(known) >= n - 2
            yield n

    with ThreadPoolExecutor(2) as pool:
        for item, result in as_done(pool, 2, square, items()):
            known.append(item)
            assert result == item * item
    assert sorted(known) == list(range(6))


def test_nearest_is_empty_without_trials(tmp_path):
    problem = problem_with(tmp_path, *EASY)
    assert nearest(open_study(problem, "sqlite:///:memory:", 1)) == {}

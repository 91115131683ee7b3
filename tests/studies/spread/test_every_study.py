"""Each study that takes --cluster, small: on two workers of a Dask cluster it has the bits that it has without one."""

import os
import signal
from dataclasses import replace

import pytest
from process_rig import SHIPPED, STAGE

from hil.bench.study import short_scan
from hil.runs.scenario import load_scenario
from hil.studies.faults.every_law import break_all
from hil.studies.faults.matrix import CASES
from hil.studies.montecarlo import Results, Study, run_study
from hil.studies.soak import as_json, soaked_scenario
from hil.studies.soaks import KeptSoaks, soak_each
from hil.studies.spread.cluster import Cluster
from hil.studies.spread.trials import judged
from hil.studies.tune.search import load_problem
from hil.studies.tune.tuning import open_study, search
from hil.studies.wafer.closed_loop import ClosedLoops
from hil.studies.wafer.study import WaferStudy
from hil.studies.wafer.study import run_study as run_wafers
from hil.studies.wafer.table import Table
from pkxyz_ctrl.config.files import CONFIG_DIR, load
from pkxyz_ctrl.design.margins.tolerances import Tolerances

pytestmark = pytest.mark.at_rate

WORKERS = 2
OF_THE_MACHINE = ("realtime_factor", "memory_mb")
"""What a soak says of where it ran."""


@pytest.fixture(scope="module")
def dask():
    """Two processes of one thread each."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=WORKERS, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        yield cluster


@pytest.fixture
def spread(dask):
    return Cluster(dask.scheduler_address)


def test_of_sampled_plants(spread, tmp_path):
    asked = Study(load_scenario("circle", controller="lqg"), load("tolerances", "wide", Tolerances))
    found = {}
    for name, cluster in (("alone", None), ("spread", spread)):
        results = Results(tmp_path / f"{name}.jsonl", asked)
        run_study(asked, range(4), results, 1, cluster)
        found[name] = sorted((tmp_path / f"{name}.jsonl").read_bytes().splitlines())
    assert len(found["alone"]) == 5
    assert found["spread"] == found["alone"]


def test_of_faults(spread):
    cases = [CASES[0], next(case for case in CASES if "probability" in case.text or case.text == "bus.sense:corrupt")]
    alone, apart = (break_all(["lqg", "youla"], cases, 1, cluster) for cluster in (None, spread))
    assert len(alone.outcomes) == 4
    assert apart == alone


def test_of_soaks(spread, tmp_path):
    asked = soaked_scenario("lqg"), 0.6
    alone, apart = (
        [as_json(soaked) for soaked in soak_each(asked, [1, 2, 3], 1, KeptSoaks(tmp_path / name, asked), cluster)]
        for name, cluster in (("alone", None), ("spread", spread))
    )
    assert [soaked["seed"] for soaked in alone] == [1, 2, 3]
    assert sum(soaked["decisions"] for soaked in alone) > 0
    for one, other in zip(alone, apart, strict=True):
        assert {k: v for k, v in one.items() if k not in OF_THE_MACHINE} == {
            k: v for k, v in other.items() if k not in OF_THE_MACHINE
        }


def test_of_a_tuning(spread, tmp_path):
    """The first trials are the shipped numbers and random ones, so their order decides nothing yet."""
    text = (CONFIG_DIR / "searches" / "lqg.toml").read_text(encoding="utf-8")
    for long, short in (
        ('plants = ["nominal", "mild"]', 'plants = ["nominal"]'),
        ('points = "all"', 'points = "middle"'),
    ):
        assert long in text
        text = text.replace(long, short)
    (tmp_path / "search.toml").write_text(text, encoding="utf-8")
    problem = load_problem(tmp_path / "search.toml")
    trials = {}
    for name, cluster in (("alone", None), ("spread", spread)):
        study = open_study(problem, f"sqlite:///{tmp_path / name}.db", 1)
        search(study, problem, 3, 1, cluster)
        trials[name] = [(t.number, t.params, t.value, t.user_attrs) for t in judged(study)]
    assert [number for number, *_ in trials["alone"]] == [0, 1, 2]
    assert trials["alone"][0][2] is not None
    assert trials["spread"] == trials["alone"]


def loops():
    """Some milliseconds a device: a part is at work for long enough to be killed in."""
    return ClosedLoops(WaferStudy(SHIPPED, STAGE, 1), replace(short_scan(), stage=STAGE), known=False)


@pytest.fixture(scope="module")
def parts_alone(tmp_path_factory):
    """The bytes of a yield's table, worked out in this process."""
    folder = tmp_path_factory.mktemp("alone")
    asked = loops()
    run_wafers(asked, 6, Table(folder, asked.digest()), 1)
    return read(folder)


def read(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_of_a_yield_a_worker_of_which_is_killed(dask, spread, parts_alone, tmp_path):
    """At the first part that is through; by then both are at others."""
    killed = []

    def kill(done, total):
        assert total == 6
        if done == 1 and not killed:
            killed.append(dask.workers[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    asked = loops()
    run_wafers(asked, 6, Table(tmp_path, asked.digest()), 1, spread, kill)
    assert len(parts_alone) == 6
    assert read(tmp_path) == parts_alone
    dask.wait_for_workers(WORKERS)
    assert killed[0] not in {worker.pid for worker in dask.workers.values()}  # another took its place


def test_of_a_yield(spread, parts_alone, tmp_path):
    asked = loops()
    run_wafers(asked, 6, Table(tmp_path, asked.digest()), 1, spread)
    assert read(tmp_path) == parts_alone

"""Work that is spread: whatever is killed, each piece comes once, and the results are those of one process."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time

import pytest

from hil.studies.faults.every_law import KeptOutcomes, break_all
from hil.studies.faults.matrix import CASES
from hil.studies.soak import soaked_scenario
from hil.studies.soaks import KeptSoaks, soak_each, totals
from hil.studies.spread.cluster import Cluster
from hil.studies.spread.workers import as_done, worker_pool
from pkxyz_ctrl.config.files import ConfigError

pytestmark = pytest.mark.at_rate

PIECES = range(24)
WORKERS = 2
SHORT_S = 0.6
"""Of stage time: a fault or two."""


def slow_square(n):
    time.sleep(0.05)
    return n * n, os.getpid()


def fatal(n):
    os.kill(os.getpid(), signal.SIGKILL)


def kills_one_worker(pool, width):
    """All pieces; the process that did the fifth is killed at once, at work on another one by then."""
    found, processes = [], set()
    for n, (item, (square, pid)) in enumerate(as_done(pool, width, slow_square, PIECES, ahead=width)):
        found.append((item, square))
        processes.add(pid)
        if n == 5:
            os.kill(pid, signal.SIGKILL)
    return found, processes


def test_of_processes_here():
    with worker_pool(WORKERS) as (pool, width):
        found, processes = kills_one_worker(pool, width)
    assert sorted(found) == [(n, n * n) for n in PIECES]
    assert len(processes) > WORKERS  # others took their place


def test_of_workers_of_a_cluster():
    from distributed import LocalCluster

    with (
        LocalCluster(n_workers=WORKERS, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        worker_pool(1, Cluster(cluster.scheduler_address)) as (pool, width),
    ):
        assert width == WORKERS
        found, _ = kills_one_worker(pool, width)
    assert sorted(found) == [(n, n * n) for n in PIECES]


def test_a_piece_that_kills_whoever_does_it_is_given_up():
    with (
        pytest.raises(ConfigError, match=r"worker processes were killed 4 times .* fewer --workers"),
        worker_pool(1) as (pool, width),
    ):
        list(as_done(pool, width, fatal, [1]))


def pkxyz_killed_after(lines, path, *words):
    """The command is killed when that many lines are in its file of results; what it leaves."""
    process = subprocess.Popen([sys.executable, "-m", "hil", *map(str, words)], stdout=subprocess.DEVNULL)
    while process.poll() is None and (not path.exists() or len(path.read_bytes().splitlines()) < lines):
        time.sleep(0.005)
    process.kill()
    process.wait()
    return path.read_bytes()


def test_a_killed_client_goes_on_and_counts_nothing_twice(tmp_path):
    words = ("montecarlo", "circle", "--plants", "12", "--workers", "2", "--json", "--out")
    before = pkxyz_killed_after(4, tmp_path / "killed" / "results.jsonl", *words, tmp_path / "killed")
    assert 4 <= len(before.splitlines()) < 13  # the head, and not all of them
    for folder in ("killed", "whole"):
        subprocess.run([sys.executable, "-m", "hil", *words, str(tmp_path / folder)], check=False, capture_output=True)
    killed, whole = (
        sorted((tmp_path / folder / "results.jsonl").read_text().splitlines()) for folder in ("killed", "whole")
    )
    assert killed == whole
    assert len(whole) == 13


# -- faults and soaks ------------------------------------------------------------------------------------------------


def test_faults_are_the_same_here_spread_and_continued(tmp_path):
    cases = CASES[:3]
    here = break_all(["lqg", "pi_notch"], cases, 1)
    path = tmp_path / "outcomes.jsonl"
    first = break_all(["lqg"], cases[:2], WORKERS, kept=KeptOutcomes(path))
    assert first.outcomes == here.outcomes[:2]
    told = []
    again = break_all(
        ["lqg", "pi_notch"], cases, WORKERS, None, KeptOutcomes(path), lambda *said: told.append(said[:2])
    )
    assert again == here
    assert told == [(n, 6) for n in range(3, 7)]  # two were kept
    assert len(path.read_text().splitlines()) == 7
    assert [outcome.law for outcome in here.outcomes] == ["lqg"] * 3 + ["pi_notch"] * 3


def test_soaks_are_those_of_their_seeds_wherever_they_ran(tmp_path):
    asked = soaked_scenario("lqg"), SHORT_S
    kept = KeptSoaks(tmp_path / "soaks.jsonl", asked)
    soak_each(asked, [2], 1, kept)
    found = soak_each(asked, [1, 2, 3], WORKERS, KeptSoaks(tmp_path / "soaks.jsonl", asked))
    alone = soak_each(asked, [1, 2, 3], 1, KeptSoaks(tmp_path / "alone.jsonl", asked))
    assert [soaked.seed for soaked in found] == [1, 2, 3]
    for one, other in zip(found, alone, strict=True):
        assert (one.ticks, one.faults, one.decisions, one.reasons, one.voltage_max_v, one.zero_ticks) == (
            other.ticks, other.faults, other.decisions, other.reasons, other.voltage_max_v, other.zero_ticks
        )  # fmt: skip
    all_of_them = totals(found)
    assert all_of_them["ticks"] == all_of_them["recorded_ticks"] == 3 * 3000
    assert all_of_them["faults"] == sum(soaked.faults for soaked in found) > 0
    assert all_of_them["voltage_max_v"] == max(soaked.voltage_max_v for soaked in found) < 200.0
    with pytest.raises(ConfigError, match="holds results of another study"):
        KeptSoaks(tmp_path / "soaks.jsonl", (asked[0], 2 * SHORT_S))


def test_interrupted_soaks_leave_nothing_but_what_is_through(tmp_path, monkeypatch):
    """Ctrl-C as the first is through: the processes are in the midst of others, and are ended."""
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setenv("TMPDIR", str(scratch))  # of the processes, and of this one:
    monkeypatch.setattr(tempfile, "tempdir", None)
    at_work = []

    def interrupt(done, total):
        if done > 0:
            at_work.extend(scratch.iterdir())
            raise KeyboardInterrupt

    asked = soaked_scenario("lqg"), 60.0
    found = soak_each(
        asked, range(1, 6), WORKERS, KeptSoaks(tmp_path / "soaks.jsonl", asked), on_progress=interrupt
    )  # fmt: skip
    assert len(found) == 1
    assert at_work != []
    assert list(scratch.iterdir()) == []


def test_problems_of_a_soak_are_told_with_its_seed(tmp_path):
    asked = soaked_scenario("lqg"), SHORT_S
    (found,) = soak_each(asked, [1], 1, KeptSoaks(tmp_path / "soaks.jsonl", asked))
    found.problems = ["the stage is damaged"]
    assert totals([found])["problems"] == {1: ["the stage is damaged"]}
    assert not totals([found])["ok"]
    line = json.loads((tmp_path / "soaks.jsonl").read_text().splitlines()[1])
    assert line["seed"] == 1

"""Run folders: nobody's files are touched, an earlier run goes only when it may and when the new one has recorded."""

import dataclasses
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import ROOT, pkxyz

from hil.lanes.lane import Lane
from hil.recording.recording import Recording
from hil.runs import at_rate
from hil.runs.run import run_into
from hil.runs.run_folder import CONFIG, RECORDING, RunFolder, next_free
from hil.runs.scenario import load_scenario, resolve
from pkxyz_ctrl.config.files import CONFIG_DIR, ConfigError, read_toml, write_toml
from pkxyz_ctrl.loop.controller import StartUpError

pytestmark = pytest.mark.at_rate

EARLIER = ".earlier"


def scenario_of(name="raster", duration_s=0.05, **changes):
    loaded = load_scenario(name, **changes)
    return dataclasses.replace(loaded, config=loaded.config.model_copy(update={"duration_s": duration_s}))


def content(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def earlier(tmp_path):
    """The folder of a run that is over, and what it holds."""
    folder = tmp_path / "run"
    run_into(RunFolder(folder), scenario_of("path"), Lane.FAST)
    assert (folder / "reference.3.csv").is_file() or list(folder.glob("reference.*.csv"))
    return folder, content(folder)


def test_an_earlier_run_is_replaced_only_if_that_is_said(earlier):
    folder, before = earlier
    with pytest.raises(ConfigError, match="holds an earlier run; give another folder, or --replace"):
        RunFolder(folder)
    assert content(folder) == before
    run_into(RunFolder(folder, replace=True), scenario_of("raster"), Lane.FAST)
    assert read_toml(folder / CONFIG)["name"] == "raster"
    assert not list(folder.glob("reference.*.csv"))  # nothing of the earlier one is left
    assert not (folder / EARLIER).exists()


@pytest.mark.parametrize("replace", [False, True])
def test_files_that_are_not_a_runs_are_left_alone(tmp_path, replace):
    """A config.toml of somebody's, alone in its folder, was deleted once: only one with its own digest is a run's."""
    shipped = (CONFIG_DIR / "scenarios" / "raster.toml").read_text(encoding="utf-8")
    changed = resolve(scenario_of()) | {"seed": 99}
    for n, (name, text) in enumerate(
        [(CONFIG, shipped), (CONFIG, "name = 'mine'\n"), (CONFIG, ""), (RECORDING, "x"), ("notes.txt", "mine")]
    ):
        folder = tmp_path / str(n)
        folder.mkdir()
        (folder / name).write_text(text, encoding="utf-8")
        with pytest.raises(ConfigError, match=r"--out: .*: holds (files that are not a run's|parts of a run)"):
            RunFolder(folder, replace=replace)
        assert (folder / name).read_text(encoding="utf-8") == text
    folder = tmp_path / "changed"
    folder.mkdir()
    write_toml(changed, folder / CONFIG)
    with pytest.raises(ConfigError, match=r"not a run's \(config\.toml\)"):
        RunFolder(folder, replace=replace)


def test_a_run_that_never_begins_leaves_the_earlier_one(earlier, tmp_path):
    """At rate, on a bus without an amplifier: nothing answers, and nothing is lost."""
    folder, before = earlier
    text = (CONFIG_DIR / "buses" / "unix_1k.toml").read_text(encoding="utf-8")
    text = text.replace('channel = "pkxyz"', f'channel = "{tmp_path}/bus"') + "boot_timeout_us = 20_000\nretries = 0\n"
    (tmp_path / "bus.toml").write_text(text, encoding="utf-8")
    scenario = scenario_of(bus=str(tmp_path / "bus.toml"))
    with pytest.raises(StartUpError):
        at_rate.run_into(RunFolder(folder, replace=True), scenario, lambda words: None, company_s=0.1)
    assert content(folder) == before
    assert not (folder / EARLIER).exists()


def test_a_run_that_never_recorded_anything_is_none_to_keep(tmp_path):
    """No amplifier answered: the same command again is not refused. What can't be read may be a run, and is kept."""
    folder = RunFolder(tmp_path / "run")
    with folder.taken():
        folder.write_config(scenario_of())
    run_into(RunFolder(folder.path), scenario_of(), Lane.FAST)
    os.truncate(folder.recording, 1000)
    with pytest.raises(ConfigError, match="holds an earlier run"):
        RunFolder(folder.path)


def dying_at(step, work):
    """Do ``work`` in a child that is gone before its ``step``-th change of the folder; whether it got so far."""
    child = os.fork()
    if child == 0:
        left = [step]

        def counted(real):
            def change(self, *words, **more):
                if left[0] == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
                left[0] -= 1
                return real(self, *words, **more)

            return change

        for name in ("rename", "unlink", "mkdir", "rmdir"):
            setattr(Path, name, counted(getattr(Path, name)))
        status = 1
        try:
            work()
            status = 0
        finally:
            os._exit(status)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status in (0, -signal.SIGKILL)
    return status != 0


def test_a_kill_at_any_step_of_replacing_loses_no_run(earlier):
    """Set aside and back again: killed before any change of the folder, the next one finds the earlier run."""
    folder, before = earlier

    other = resolve(scenario_of("raster"))

    def begins_and_gives_up():
        with RunFolder(folder, replace=True).taken():
            write_toml(other, folder / CONFIG)
            (folder / "frames.log").write_text("new")

    step = 0
    while dying_at(step, begins_and_gives_up):
        step += 1
        with RunFolder(folder, replace=True).taken():
            assert {p.relative_to(folder / EARLIER) for p in (folder / EARLIER).iterdir()} == before.keys()
        assert content(folder) == before, step
    assert step > 2 * len(before)
    assert content(folder) == before


def test_a_kill_at_any_step_of_dropping_the_earlier_run_keeps_the_new_one(earlier, tmp_path):
    folder, before = earlier
    new = tmp_path / "new"
    run_into(RunFolder(new), scenario_of("raster"), Lane.FAST)
    wanted = content(new)

    def succeeds():
        with RunFolder(folder, replace=True).taken():
            for name, data in wanted.items():
                (folder / name).write_bytes(data)

    step = len(before) + 2  # the folder, the folder inside, and all in it set aside
    while dying_at(step, succeeds):
        with RunFolder(folder, replace=True).taken():
            pass
        assert content(folder) == wanted, step
        for name in wanted:
            (folder / name).unlink()
        for name, data in before.items():
            (folder / name).write_bytes(data)
        step += 1
    assert step == 2 * len(before) + 3  # all of it gone, and the folder inside
    assert content(folder) == wanted


def test_two_runs_never_share_a_folder(tmp_path):
    folder = tmp_path / "run"
    with RunFolder(folder).taken():
        with pytest.raises(ConfigError, match="another run is being written there"), RunFolder(folder).taken():
            raise AssertionError("two have it")
        child = os.fork()  # as the recorder of a run at rate, which goes on when the loop was killed
        if child == 0:
            signal.pause()
    with pytest.raises(ConfigError, match="another run is being written there"), RunFolder(folder).taken():
        raise AssertionError("its recorder still writes")
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with RunFolder(folder).taken():
        pass


def test_a_second_process_is_told_and_the_first_is_not_disturbed(tmp_path):
    words = [sys.executable, "-m", "hil", "sil", "raster", "--out", "run"]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(words, cwd=tmp_path, env=env, stdout=subprocess.DEVNULL) as first:
        while first.poll() is None and not (tmp_path / "run" / (RECORDING + ".journal")).is_file():
            pass
        assert first.poll() is None
        second = pkxyz("sil", "raster", "--out", "run", cwd=tmp_path)
        assert first.wait() == 0
    assert (second.returncode, second.stdout) == (2, "")
    assert second.stderr.count("\n") == 1
    assert "holds an earlier run" in second.stderr or "another run is being written there" in second.stderr
    recording = Recording.open(tmp_path / "run" / RECORDING)
    assert recording.whole
    assert recording.ticks == 5500


def test_the_command_asks_before_it_replaces(tmp_path):
    words = ("sil", "raster", "--lane", "fast", "--out", "run")
    assert pkxyz(*words, cwd=tmp_path).returncode == 0
    before = content(tmp_path / "run")
    refused = pkxyz(*words, cwd=tmp_path)
    assert (refused.returncode, refused.stdout) == (2, "")
    told = "pkxyz: --out: run: holds an earlier run; give another folder, or --replace to have it replaced\n"
    assert refused.stderr == told
    assert content(tmp_path / "run") == before
    again = pkxyz("sil", "run/config.toml", "--lane", "fast", "--out", "run", "--replace", cwd=tmp_path)
    assert again.returncode == 0
    after = content(tmp_path / "run")
    assert {after[path] == before[path] for path in before if path.name in (CONFIG, RECORDING)} == {True}


def test_free_names_are_given_to_one_only(tmp_path):
    given = [next_free(tmp_path / "runs", "a[b]*", Lane.FAST) for _ in range(3)]
    assert [path.name for path in given] == [f"a[b]*-fast-{n}" for n in (1, 2, 3)]
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="not a directory"):
        next_free(tmp_path / "file", "raster", Lane.FAST)


@pytest.mark.parametrize(("name", "lane"), [("raster", Lane.FAST), ("path", Lane.LOCKSTEP)])
def test_the_configuration_of_a_run_runs_again_to_the_same_bits(tmp_path, name, lane):
    """Its tables lie beside it, under other names than in the scenario; the digest stays, and every bit."""
    first = RunFolder(tmp_path / "first")
    run_into(first, scenario_of(name, 0.2, plant="harsh"), lane)
    again = load_scenario(first.config)
    second = RunFolder(tmp_path / "elsewhere" / "second")
    run_into(second, again, lane)
    third = RunFolder(first.path, replace=True)  # in its own place
    run_into(third, load_scenario(second.config), lane)
    read = [Recording.open(folder.recording) for folder in (second, third)]
    assert read[0].metadata == read[1].metadata
    assert content(second.path).keys() == content(third.path).keys()
    for column in ("position_x_m", "voltage_2_v", "estimate_z_m"):
        assert read[0][column].tobytes() == read[1][column].tobytes()
    assert second.config.read_bytes() == third.config.read_bytes()
    assert read_toml(second.config)["digest"] == resolve(again)["digest"]


def test_a_configuration_in_its_own_folder_replaces_itself(tmp_path):
    folder = RunFolder(tmp_path / "run")
    run_into(folder, scenario_of("path", 0.2), Lane.FAST)
    kept = (CONFIG, *(path.name for path in folder.path.glob("reference.*.csv")))
    before = {path: data for path, data in content(folder.path).items() if path.name in kept}
    run_into(RunFolder(folder.path, replace=True), load_scenario(folder.config), Lane.FAST)
    after = content(folder.path)
    assert {path: after[path] for path in before} == before


def test_what_is_changed_beside_a_configuration_is_told(tmp_path):
    folder = RunFolder(tmp_path / "run")
    run_into(folder, scenario_of("path", 0.2), Lane.FAST)
    assert load_scenario(folder.config, seed=5, plant="mild").plant.name == "mild"
    (table,) = folder.path.glob("reference.*.csv")
    table.write_text(table.read_text(encoding="utf-8").rstrip() + "0\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="its table is not the one of the run"):
        load_scenario(folder.config)
    table.unlink()
    with pytest.raises(ConfigError, match="no such file"):
        load_scenario(folder.config)
    data = read_toml(folder.config)
    for key in ("stage", "plant", "controller", "bus"):
        write_toml({**data, key: {**data[key], "surplus": 1}}, tmp_path / "bent.toml")
        with pytest.raises(ConfigError, match=rf"bent\.toml: {key}: surplus: unknown key"):
            load_scenario(tmp_path / "bent.toml")

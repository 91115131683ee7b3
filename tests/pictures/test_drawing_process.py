"""The process that draws while the run goes on: the same picture, gone afterwards, and no error kept to itself."""

import os
from pathlib import Path

import pytest

import hil.pictures.run
from hil.lanes.lane import Lane
from hil.pictures import drawing_process
from hil.pictures.drawing_process import DrawingProcess
from hil.runs.run import run_into
from hil.runs.run_folder import RunFolder
from hil.runs.scenario import load_scenario
from hil.runs.summary import Summary
from pkxyz_ctrl.config.files import ConfigError


@pytest.fixture
def ran(tmp_path: Path) -> tuple[RunFolder, Summary]:
    folder = RunFolder(tmp_path / "run")
    return folder, run_into(folder, load_scenario("raster"), Lane.FAST)


@pytest.fixture
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing_process, "cores", lambda: 2)


def is_there(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.usefixtures("two_cores")
def test_it_draws_the_same_picture_and_is_gone_afterwards(ran, monkeypatch):
    folder, summary = ran
    hil.pictures.run.draw(folder, summary)
    here = folder.picture.read_bytes()
    folder.picture.unlink()
    with DrawingProcess() as pictures:
        pid = pictures._process.pid
        with monkeypatch.context() as patched:
            patched.setattr(hil.pictures.run, "draw", None)
            pictures.draw(folder, summary)
    assert folder.picture.read_bytes() == here
    assert not is_there(pid)


@pytest.mark.usefixtures("two_cores")
def test_where_it_was_killed_the_picture_is_drawn_here(ran):
    folder, summary = ran
    with DrawingProcess() as pictures:
        pictures._process.kill()
        pictures._process.wait()
        pictures.draw(folder, summary)
    assert folder.picture.stat().st_size > 50_000


@pytest.mark.usefixtures("two_cores")
def test_what_it_can_t_write_is_told_as_ever(ran):
    folder, summary = ran
    folder.picture.mkdir()
    with DrawingProcess() as pictures, pytest.raises(ConfigError, match=r"report\.png: cannot be written"):
        pictures.draw(folder, summary)


@pytest.mark.usefixtures("two_cores")
def test_a_run_that_ends_early_does_not_wait_for_it():
    pids = []

    def interrupted() -> None:
        with DrawingProcess() as pictures:
            pids.append(pictures._process.pid)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not is_there(pids[0])


def test_on_a_single_core_there_is_none(ran):
    folder, summary = ran
    with DrawingProcess() as pictures:
        assert pictures._process is None
        pictures.draw(folder, summary)
    assert folder.picture.is_file()

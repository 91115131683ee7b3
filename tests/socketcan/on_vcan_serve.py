"""``pkxyz serve`` over the kernel's CAN sockets, classic and FD, and a program that operates its stage; run in a guest
by ``run.py``. Plant, bus and law are those of ``on_vcan.py``, whose rig this is; the loop is the native one, if it is
there.
"""

import json
import os
import signal
import time
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from on_vcan import DRIVE, Command, bench, drive_frames, is_fd, observer, plant

import hil.commands.operation.serve
import hil.server.beside
import hil.server.serving  # noqa: F401  in the guest an import takes a while
import pkxyz_ctrl
from hil.lanes.wall_plant import TRUTH
from pkxyz_ctrl.client import place
from pkxyz_ctrl.client.reply import AbortedError, NoStageError, RefusedError

__all__ = ["bench", "plant"]

ATTEMPTS = 6
STARTS_S = 120
ABOVE_M = 19.25e-6
CORNERS_M = [[1e-6, 1e-6, ABOVE_M], [-1e-6, 1e-6, ABOVE_M]]
SLOW = {"velocity_m_per_s": 0.05e-3, "acceleration_m_per_s2": 1.0e-3, "jerk_m_per_s3": 0.05}
SLOW_PATH = {name.replace("_m_", "_max_m_"): value for name, value in SLOW.items()}


@pytest.fixture
def server(bench, plant, monkeypatch):
    """``pkxyz serve`` in its process, found by its default name, which ends by SIGTERM."""
    plant.seen("pre-operational", False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(bench))
    words = ("--bus", "bus.toml", "--controller", "patient.toml", "--port", "0", "--json", "--silence-s", "10")
    with Command(bench, "serve", *words, "--saves", "saves", "--settings", "settings") as command:
        yield command
        for kind in ("loop", "server"):  # whatever has become of the test
            if (found := place.read("stage", kind)) is not None:
                os.kill(found["pid"], signal.SIGKILL)


@contextmanager
def operating(server):
    """A program with control, once there is a loop."""
    end_s = time.monotonic() + STARTS_S

    def goes_on():
        assert server.process.is_alive(), server.wait()
        assert time.monotonic() < end_s, server.err.read_text(encoding="utf-8")
        time.sleep(0.1)

    while "url" not in server.out.read_text(encoding="utf-8"):
        goes_on()
    assert json.loads(server.out.read_text(encoding="utf-8"))["url"].startswith("http://127.0.0.1:")
    with ExitStack() as stack:
        stage = None
        while stage is None:
            goes_on()
            with suppress(NoStageError):
                stage = stack.enter_context(pkxyz_ctrl.connect())
        while stage.status.activity == "starting":
            goes_on()
        yield stage


def patiently(operate, stage):
    """Operate from off to off. A guest that stands still has put the stage in fault, or out of position: then again."""
    said = []
    for _ in range(ATTEMPTS):
        try:
            status = stage.next_status()
            if status.activity == "fault":
                stage.clear()
            elif status.driven:
                stage.park()
            return operate(stage)
        except (AbortedError, RefusedError) as error:
            said.append(f"{error}; {stage.next_status().last_fault}")
    pytest.fail(f"the stage was not operated: {said}")


def test_a_stage_is_operated_from_off_to_off_and_nothing_is_left(bench, plant, server):
    def operate(stage):
        stage.home()
        stage.enable()
        stage.move_to(z=ABOVE_M)
        assert "in position at (1, 0, 19.25) um" in stage.move_to(x=1e-6).words
        stage.follow(segments=[{"kind": "waypoints", "points_m": CORNERS_M, **SLOW_PATH}])
        assert np.allclose(stage.next_status().target_m, CORNERS_M[-1], rtol=0.0, atol=1e-12)
        with pytest.raises(RefusedError) as refused:
            stage.move_to(x=50e-6)
        if stage.next_status().activity == "fault":
            raise refused.value
        assert "x = 50 um is asked for, limits" in str(refused.value)
        stage.park()

    with operating(server) as stage:
        stage.limits(**SLOW)
        stage.settle_window(window_m=0.5e-6, dwell_s=0.02)
        patiently(operate, stage)
        while stage.next_status().activity != "off":  # the tick of the answer may be a moment old
            pass
        assert not stage.status.voltage_v.any()
        with observer(bench) as looking:
            seen = drive_frames(looking, server, driven=False)
        assert seen
        assert not any(any(data[:6]) for can_id, data, *_ in seen if can_id == DRIVE)
        assert {fd for *_, fd, _ in seen} == {is_fd(bench)}
        loop = place.read("stage", "loop")
    plant.seen("operational", False)
    server.signal(signal.SIGTERM)
    code, _, err = server.wait()
    assert code == 0, err
    plant.seen("pre-operational", False)
    assert [place.read("stage", kind) for kind in ("server", "loop", "plant")] == [None] * 3
    assert not Path(f"/proc/{loop['pid']}").exists()
    assert not Path(loop["memory"]).exists()
    position = np.fromfile(bench / "truth.bin", TRUTH)["position_m"]
    assert position[:, 2].max() == pytest.approx(ABOVE_M, abs=1e-6)
    assert position[:, 0].min() == pytest.approx(-1e-6, abs=0.5e-6)
    assert position[:, :2].max() == pytest.approx(1e-6, abs=0.5e-6), "what was refused has moved nothing"
    assert np.abs(position[-1]).max() < 0.2e-6

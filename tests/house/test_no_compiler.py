"""Kernels are plain Python that is compiled, not a language of their own: with the compiler off, nothing is missed."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scripted_ticks import from_rest, in_the_middle

from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import Trip

ROOT = Path(__file__).parents[2]
HERE, RIGS = Path(__file__).parent, ROOT / "tests" / "rigs"


def without_compiler(*arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join((str(ROOT), str(RIGS)))}
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, cwd=ROOT, env=environment, check=False
    )


@pytest.fixture(scope="module")
def compiled():
    return np.concatenate([in_the_middle(), from_rest()])


def test_the_stories_tell_something(compiled):
    """Feedback under noise, lost frames, limits met, a fault; homing, enabling, and a move that began."""
    middle, rest = compiled[:60], compiled[60:]
    assert (middle["mode"][:54] == Mode.TRACKING).all()
    assert middle["mode"][54] == Mode.FAULT
    assert middle["trips"][54] & Trip.SENSE_STALE
    assert middle["saturated"].any()
    assert (np.abs(middle["innovation_m"][:40]).max(axis=0) > 1e-9).all()
    assert set(rest["mode"].tolist()) == {Mode.HOMING, Mode.IDLE, Mode.ENABLED, Mode.TRACKING}
    assert rest["position_m"][-1, 2] > 1e-6


def test_140_ticks_agree_to_a_billionth(compiled, tmp_path):
    """Counts, modes and events exactly, everything else to 1e-9 of the largest value of its field."""
    done = without_compiler(str(HERE / "scripted_ticks.py"), str(tmp_path / "rows.npy"))
    assert done.returncode == 0, done.stderr
    interpreted = np.load(tmp_path / "rows.npy")
    assert interpreted.dtype == ROW
    for name in ROW.names:
        a, b = compiled[name], interpreted[name]
        if a.dtype.kind == "f":
            assert np.isfinite(a).all()
            assert np.abs(a - b).max() <= 1e-9 * np.abs(a).max(), name
        else:
            assert np.array_equal(a, b), name


@pytest.mark.slow
def test_tests_of_the_core_pass():
    """Kinematics, measuring, 0 V, allocation: their own tests, interpreted."""
    done = without_compiler("-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/core/test_core_tick.py")
    assert done.returncode == 0, done.stdout[-3000:]
    assert " passed" in done.stdout or "[100%]" in done.stdout

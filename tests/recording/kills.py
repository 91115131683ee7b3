"""SIGKILL at random moments of runs in a process of their own: what is left opens, and is never silently short.

``python tests/recording/kills.py 300`` kills so many; the suite kills a few.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT)]

from hil.recording.recording import Recording  # noqa: E402

TICKS = 5500
_RUNS = (
    (),  # start-up, homing, tracking
    ("--fault", "bus.sync:drop@0.3+0.05"),  # a fault decision, and FAULT to the end
    ("--plant", "harsh", "--bus", "fd_5k"),
)


def kill_one(seed: int, folder: Path) -> str:
    """One run, killed somewhere between its first file and its end; what was left of it."""
    rng = random.Random(f"kill {seed}")
    words = [sys.executable, "-m", "hil", "sil", "raster", "--out", "run", *rng.choice(_RUNS)]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(words, cwd=folder, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and not (folder / "run" / "config.toml").is_file():
            time.sleep(0.002)
        time.sleep(rng.uniform(0.0, 3.0))
        process.send_signal(signal.SIGKILL)
    path = folder / "run" / "recording.parquet"
    if not path.exists() and not path.with_name(path.name + ".journal").exists():
        assert process.returncode == -signal.SIGKILL, "a run that ended has a recording"
        return "no recording yet"
    recording = Recording.open(path)
    assert recording["tick"].tolist() == list(range(recording.ticks)), f"seed {seed}: rows are missing"
    assert np.isfinite(recording.vector("position_m")).all()
    assert recording.whole == (recording.ticks == TICKS and path.exists()), f"seed {seed}: short without a word"
    return "whole" if recording.whole else "cut off, and says so"


def main(count: int) -> None:
    """Kill ``count`` runs and tell what was left."""
    outcomes: dict[str, int] = {}
    for seed in range(count):
        with tempfile.TemporaryDirectory() as folder:
            outcome = kill_one(seed, Path(folder))
        outcomes[outcome] = outcomes.get(outcome, 0) + 1
    print(f"{count} killed: {outcomes}")


if __name__ == "__main__":
    main(int(sys.argv[1]))

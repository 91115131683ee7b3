"""`pkxyz check-amplifier` on a real bus: our own node, served by `pkxyz plant` in another process, passes every line.

The bus is a slow one, so only a machine that stands still for milliseconds can make an answer late. Whether it did
is looked at all the while: then the lines that are about time are the machine's, and the others are still the node's.
"""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from hil.conformance.run import CHECKS
from pkxyz_ctrl.config.files import CONFIG_DIR

ROOT = Path(__file__).parents[2]
ABOUT_TIME = {
    "boot-up and NMT: boot-up",
    "heartbeat: heartbeat period",
    "heartbeat: heartbeat in the loop",
    "sense PDO: latency",
    "outputs: heartbeat consumer",
}
SLACK_S = 1.0e-3  # a heartbeat of 20 ms may come 2 ms late, an answer 2.3


class Stillness:
    """Looks at the clock every half millisecond; ``longest_s`` is how long the machine gave no processor in between."""

    def __init__(self):
        self.longest_s = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look)

    def _look(self):
        last_s = time.monotonic()
        while not self._ended.wait(0.5e-3):
            now_s = time.monotonic()
            self.longest_s, last_s = max(self.longest_s, now_s - last_s - 0.5e-3), now_s

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join()


def pkxyz(*words, stdout):
    return subprocess.Popen(
        [sys.executable, "-m", "hil.cli", *map(str, words)], text=True, stdout=stdout, stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip


@pytest.fixture
def bus(tmp_path):
    """A bus file of 400 Hz whose sockets are in the test's folder, with node and plant served on it."""
    text = (CONFIG_DIR / "buses" / "unix_1k.toml").read_text(encoding="utf-8")
    for old, new in (
        ('channel = "pkxyz"', f'channel = "{tmp_path}/bus"'),
        ("period_us = 1000", "period_us = 2500"),
        ("sense_deadline_us = 600", "sense_deadline_us = 2300"),
    ):
        assert old in text
        text = text.replace(old, new, 1)
    path = tmp_path / "slow.toml"
    path.write_text(text, encoding="utf-8")
    with (tmp_path / "changes").open("wb") as out:
        plant = pkxyz("plant", "--bus", path, "--json", stdout=out)
    try:
        end_s = time.monotonic() + 120
        while "pre-operational" not in (tmp_path / "changes").read_text(encoding="utf-8"):
            assert time.monotonic() < end_s
            assert plant.poll() is None
            time.sleep(0.05)
        yield path
    finally:
        plant.terminate()
        _, err = plant.communicate(timeout=60)
    assert plant.returncode == 0, err


def test_our_node_in_another_process_passes(bus, tmp_path):
    with Stillness() as machine:
        words = ("check-amplifier", "--bus", bus, "--allow-voltage", "--out", tmp_path / "report", "--json")
        check = pkxyz(*words, stdout=subprocess.PIPE)
        out, err = check.communicate(timeout=240)
    result = json.loads(out)
    assert len(result["lines"]) == len(CHECKS)
    assert result["not_tested"] == 0
    failed = {f"{line['group']}: {line['name']}" for line in result["lines"] if line["verdict"] != "PASS"}
    assert failed <= (ABOUT_TIME if machine.longest_s > SLACK_S else set()), (machine.longest_s, out, err)
    assert check.returncode == (1 if failed else 0)
    assert json.loads((tmp_path / "report" / "conformance.json").read_text(encoding="utf-8")) == result
    assert "Traceback" not in err

"""`pkxyz check-amplifier` on a real bus: our own node, served by `pkxyz plant` in another process, passes every line.

The bus is a slow one, so only a machine that stands still can make an answer late. The run itself looks at that all the
while: a line that it spoils three times is not tested, and none is ever held against the node.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hil.conformance.run import CHECKS
from pkxyz_ctrl.config.files import CONFIG_DIR

pytestmark = pytest.mark.at_rate

ROOT = Path(__file__).parents[2]


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


@pytest.mark.slow
def test_our_node_in_another_process_passes(bus, tmp_path):
    words = ("check-amplifier", "--bus", bus, "--allow-voltage", "--out", tmp_path / "report", "--json")
    check = pkxyz(*words, stdout=subprocess.PIPE)
    out, err = check.communicate(timeout=400)
    result = json.loads(out)
    assert len(result["lines"]) == len(CHECKS)
    deviating = [line for line in result["lines"] if line["verdict"] not in ("PASS", "NOT TESTED")]
    assert deviating == [], err
    left_out = [line for line in result["lines"] if line["verdict"] == "NOT TESTED"]
    assert all(line["got"].startswith("this machine itself was") for line in left_out), left_out
    assert result["passed"] > len(CHECKS) // 2  # those that are about no times cannot be left out
    assert check.returncode == 0
    assert json.loads((tmp_path / "report" / "conformance.json").read_text(encoding="utf-8")) == result
    assert "Traceback" not in err

"""The loop in C by the law that plans, in ticks in which limits hold: the same program, the bits of Python's solver."""

import re
import shutil
import subprocess

import numpy as np
import pytest
from patience import patient_bus, patient_law
from two_processes import assert_ended_by_the_controller, bench_in, controller, served

from hil.commands.export import exported_of
from hil.native.program import compiled, compiler
from hil.native.teller import Teller
from hil.recording.recording import Recording
from hil.runs.replay import replay
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.compiled.kernel_cache import choose_kernel_cache
from pkxyz_ctrl.export.folder import write
from pkxyz_ctrl.export.planned import PLANNED_EXCHANGE
from pkxyz_ctrl.export.shared import SHARED
from pkxyz_ctrl.export.words import words_of
from pkxyz_ctrl.loop.predictive_problem import PROBLEM, Problem
from pkxyz_ctrl.safety.modes import Mode

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")

SCENARIO = """
name = "far_jump"
duration_s = 0.3
seed = 3
stage = "reconstructed"
plant = "nominal"
controller = "patient.toml"
bus = "slow.toml"
[[reference]]
kind = "hold"
duration_s = 0.005
measured = false
[[reference]]
kind = "move"
to_m = [0.0, 0.0, 4e-6]
velocity_max_m_per_s = 0.5e-3
acceleration_max_m_per_s2 = 0.05
jerk_max_m_per_s3 = 10.0
[[reference]]
kind = "hold"
duration_s = 0.02
[[reference]]
kind = "steps"
by_m = [0.0, 0.0, 31e-6]
count = 1
dwell_s = 0.04
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    choose_kernel_cache()
    compiled()
    folder = bench_in(tmp_path_factory.mktemp("planned"))
    patient_law(folder, "mpc")
    patient_bus(folder / "slow.toml", "unix_5k")
    (folder / "on_slow.toml").write_text(SCENARIO, encoding="utf-8")
    return folder


@pytest.mark.at_rate
def test_a_run_that_solves_replays_in_every_bit(bench):
    with served(bench) as changes:
        changes("pre-operational", False)
        words = ("on_slow.toml", "--native", "--bus", "slow.toml", "--out", "planned", "--json")
        with controller(bench, *words) as run:
            _, err = run.communicate(timeout=180)
            assert run.returncode == 0, err
    recording = Recording.open(bench / "planned" / "recording.parquet")
    assert recording.ticks == 1500
    assert (recording["mode"] == Mode.TRACKING).sum() > 500
    assert (recording["solver_iterations"] > 0).sum() > 20
    assert replay(bench / "planned" / "recording.parquet").differences == []
    assert_ended_by_the_controller(bench / "planned" / "frames.log")


def self_tested(folder):
    """Builds and runs an exported folder's self-test; what it says, and its exit code."""
    subprocess.run(["make", "--silent", "-C", folder, "selftest"], check=True)
    done = subprocess.run([folder / "selftest"], check=False, capture_output=True, text=True)
    return done.stdout.strip(), done.returncode


@pytest.mark.skipif(shutil.which("make") is None, reason="no make")
@pytest.mark.parametrize("law", ["mpc", "youla"])
def test_the_exported_loop_has_the_bits_of_python_by_its_own_self_test_which_sees_one_that_differs(
    bench, tmp_path, law
):
    exported = exported_of(load_scenario(bench / "on_slow.toml", controller=law), 1000)
    write(tmp_path / "out", "linux", exported)
    words, code = self_tested(tmp_path / "out")
    assert "self-test passed, 1000 periods" in words
    assert code == 0
    config = tmp_path / "out" / "config.c"
    text = config.read_text(encoding="utf-8")
    last = np.flatnonzero(words_of(exported.config))[-1]  # of taps
    word = PLANNED_EXCHANGE.fields["problem"][1] // 8 + 1 if law == "mpc" else last
    at = [match.end() for match in re.finditer(r"0x[0-9a-f]{16}", text)][word] - 1
    config.write_text(f"{text[:at]}{int(text[at], 16) ^ 1:x}{text[at + 1 :]}", encoding="utf-8")  # another bit
    words, code = self_tested(tmp_path / "out")
    assert "self-test FAILED" in words
    assert code == 1


@pytest.mark.parametrize("law", ["mpc", "youla"])
def test_what_the_loop_begins_with_has_a_problem_where_the_law_has_one(law):
    setup, shared = load_scenario("raster", controller=law).setup(), np.zeros(1, SHARED)[0]
    told = Teller(setup)
    told.lay_out(shared)
    config, memory = shared["config"][0], shared["memory"][0]
    assert (words_of(config["own"]) == words_of(told.record)).all()
    assert (words_of(memory["own"]) == words_of(told.exchange)).all()
    problem = Problem(setup.law).record() if law == "mpc" else np.zeros(1, PROBLEM)
    assert (config["problem"] == problem).all()
    assert problem.view(np.uint8).any() == (law == "mpc")

"""Taps for a stage file that `pkxyz identify` wrote: what an identified device is promised, kept by one."""

import json

import numpy as np
import pytest
from loop_rig import MIDDLE, bus
from typer.testing import CliRunner

import hil
from hil.cli import app
from hil.studies.margins.loop import Loop
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.margins.tolerances import Case, Tolerances
from pkxyz_ctrl.design.model.loop_plant import Perturbation
from pkxyz_ctrl.stage import Stage


def answered(*arguments):
    done = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "drawn", "hold_nm", "most_nm"),
    [("mild", "reconstructed", (0.98, 0.99), 3.5), ("lab", "lab", (1.18, 1.17), 4.5)],
)
def test_a_stage_that_was_identified_is_rejected_on_to_280_hz(plant, drawn, hold_nm, most_nm, tmp_path):
    """By both commands: |S| < -3 dB to 280 Hz at Ms 2, and Ms 3 where stiffness is off by 3 %; behind 100 us of sense
    filter with more noise. What is designed runs on the device. Two-sided, as an unexplained improvement is an error
    too.
    """
    answered("identify", "--stage", drawn, "--plant", plant, "--out", tmp_path / "found")
    file = tmp_path / "found" / "stage.toml"
    noise_nm = answered("tune", "youla_identified", "--stage", file, "--out", tmp_path)["hold_noise_nm"]
    assert [noise_nm["plane"], noise_nm["z"]] == pytest.approx(hold_nm, abs=0.03)
    taps = tmp_path / "youla_identified_tuned.toml"
    stage = Stage.load(str(file))
    assert stage.config.calibration.comb_gain != (1.0, 1.0, 1.0)
    loop = Loop(stage, bus(), design_law(stage, load("controllers", taps, ControllerConfig), bus(), autostart=True))
    axes = loop.margins(MIDDLE).axes
    assert 280.0 <= min(axis.bandwidth_hz for axis in axes) < 285.0
    assert 1.7 < max(axis.peak_s for axis in axes) <= 2.0
    off = [Case("stiffness", MIDDLE, Perturbation(stiffness=share)) for share in (-0.03, 0.03)]
    assert 1.9 < max(loop.peak_sensitivity(case) for case in off) <= 3.0
    tolerances = load("tolerances", "identified", Tolerances)
    assert max(loop.peak_sensitivity(tolerances.sample(seed)) for seed in range(1, 41)) <= 3.0
    run = hil.run(hil.load_scenario(f"raster_{plant}", stage=str(file), controller=str(taps)))
    assert run.ok, run.summary
    assert 1.0 < np.max(list(run.summary["rms_error_nm"].values())) < most_nm

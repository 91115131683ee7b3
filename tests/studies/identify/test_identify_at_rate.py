"""A device on a bus to another process is identified at the machine's clock, and the stage file that is left runs."""

import json

import numpy as np
import pytest
from command_line import pkxyz
from loop_rig import MIDDLE, controller
from patience import patient_law, slow_bus, slow_stage
from sim_truth import truth_about
from two_processes import plant_on

from hil.lanes.setup import bare_setup
from hil.studies.identify.identification import modes_hz
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.config.stage import StageConfig

pytestmark = pytest.mark.at_rate


def test_a_device_on_a_bus_is_identified_and_its_stage_file_has_its_modes(tmp_path):
    """Ten times slower than the harsh plant, at 250 Hz: the modes lie in the band as on a bus of 2.5 kHz, and their
    width, of 4 Hz, as late ticks leave it.
    """
    slow, drawn = slow_bus(tmp_path / "bus.toml"), slow_stage(tmp_path / "slow.toml")
    words = ("--bus", slow, "--stage", drawn, "--controller", patient_law(tmp_path), "--periods", "5", "--json")
    with plant_on(slow, drawn, "harsh"):
        done = pkxyz("identify", *words, "--out", tmp_path / "found", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["lane"] == "wall"

    def bench(stage):
        return bare_setup(str(stage), "harsh", controller(), load("buses", slow, BusConfig), 1)

    is_hz = truth_about(bench(drawn).new_plant(), np.array(told["voltage_v"]) ** 2, 5.0).frequency_hz
    assert [mode["frequency_hz"] for mode in told["modes"]] == pytest.approx(is_hz, rel=0.02)
    assert modes_hz(bench(drawn), MIDDLE)[0] > 1.05 * is_hz[0]  # the file alone would not do
    found = tmp_path / "found" / "stage.toml"
    origin = load("stages", found, StageConfig).calibration.measured_by
    assert (origin.lane, origin.plant, origin.run) == ("wall", "device on unix_1k", "found")
    assert modes_hz(bench(found), MIDDLE) == pytest.approx(is_hz, rel=0.02)

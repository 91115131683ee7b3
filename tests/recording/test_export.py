"""What ``pkxyz recording`` writes is read by the programs' own libraries, and is what was recorded."""

import csv

import h5py
import numpy as np
import pytest
from asammdf import MDF
from command_line import pkxyz
from gsffile import read_gsf

from hil.recording.export import USUAL
from hil.recording.recording import Recording, RecordingWriter
from hil.runs.run_folder import RECORDING
from pkxyz_ctrl.loop.row import ROW

LINES, PER_LINE = 21, 200
SIDE_M = 4e-6


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A raster over 4 um by 2 um whose error along z grows with x and falls with y."""
    folder = tmp_path_factory.mktemp("run")
    rows = np.zeros(LINES * PER_LINE, ROW)
    rows["tick"] = np.arange(len(rows))
    rows["t_us"] = 500 * rows["tick"]
    rows["reference_tick"] = rows["tick"] - 100  # the first are of before the scan
    line, along = np.divmod(np.arange(len(rows)), PER_LINE)
    rows["reference_m"][:, 0] = (along / (PER_LINE - 1) - 0.5) * SIDE_M
    rows["reference_m"][:, 1] = (line / (LINES - 1) - 0.5) * SIDE_M / 2
    rows["estimate_m"] = rows["reference_m"]
    rows["estimate_m"][:, 2] += 1e-3 * rows["reference_m"][:, 0] - 2e-3 * rows["reference_m"][:, 1]
    rows["voltage_v"] = 0.1
    with RecordingWriter(folder / RECORDING, {}) as writer:
        writer.write(rows)
    return folder


def test_csv_has_every_number_as_it_was(run, tmp_path):
    done = pkxyz("recording", run, "--out", tmp_path / "r.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "r.csv").open() as file:
        names, *rows = csv.reader(file)
    assert tuple(names) == ("t_s", *USUAL)
    table = np.array(rows, float)
    recorded = Recording.open(run / RECORDING)
    assert (table[:, names.index("estimate_z_m")] == recorded["estimate_z_m"]).all()
    assert (table[:, names.index("error_z_m")] == recorded["estimate_z_m"] - recorded["reference_z_m"]).all()
    assert table[-1, 0] == pytest.approx((LINES * PER_LINE - 1) * 500e-6)


def test_mf4_and_hdf5_carry_units(run, tmp_path):
    for to, file in (("mf4", tmp_path / "r.mf4"), ("hdf5", tmp_path / "r.h5")):
        done = pkxyz("recording", run, "--to", to, "--out", file, "--columns", "error_x_m,voltage_2_v", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    with MDF(tmp_path / "r.mf4") as mdf:
        signal = mdf.get("voltage_2_v")
        assert signal.unit == "V"
        assert (signal.samples == 0.1).all()
        assert signal.timestamps[1] == 500e-6
    with h5py.File(tmp_path / "r.h5") as file:
        assert set(file) == {"t_s", "error_x_m", "voltage_2_v"}
        assert file["error_x_m"].attrs["unit"] == "m"
        assert len(file["t_s"]) == LINES * PER_LINE


def test_a_map_has_its_place_its_unit_and_the_error_where_it_was(run, tmp_path):
    done = pkxyz("recording", run, "--to", "gsf", "--out", tmp_path / "r.gsf", "--pixels", 41, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    image, about = read_gsf(tmp_path / "r.gsf")
    assert image.shape == (21, 41)
    pixel = SIDE_M / 40
    assert about["XReal"] == pytest.approx(41 * pixel)
    assert about["YReal"] == pytest.approx(21 * pixel)
    assert about["ZUnits"] == "m"
    x = np.linspace(-SIDE_M / 2, SIDE_M / 2, 41)
    y = np.linspace(SIDE_M / 4, -SIDE_M / 4, 21)[:, None]
    expected = 1e-3 * x - 2e-3 * y
    expected[-1, :20] = expected[-2, :20]  # before the scan: what no tick fell into is as its neighbours are
    assert np.allclose(image, expected, atol=0.3e-3 * pixel, rtol=0)
    assert "2.3% of its pixels are their neighbours'" in done.stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--to", "xls"], "--to: 'xls' is none of csv, mf4, hdf5, gsf"),
        (["--columns", "error_w_m"], "a recording has no column 'error_w_m'"),
        (["--to", "gsf", "--columns", "nothing"], "a recording has no column 'nothing'"),
    ],
)
def test_what_cannot_be_written_is_one_line(run, tmp_path, words, says):
    done = pkxyz("recording", run, *words, "--out", tmp_path / "r.out", cwd=tmp_path)
    assert done.returncode == 2
    assert says in done.stderr
    assert done.stderr.count("\n") == 1

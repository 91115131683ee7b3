"""``pkxyz new``, and what every command owes at the terminal: -h, whole commands in hints, the errors of each axis."""

import re
import shlex
import tomllib

import pytest
from command_line import pkxyz

from hil.commands.new import _FOLDERS, Kind, _model, commented
from hil.runs.metrics import RowFigures
from hil.screen.figures import error_lines, where_to_read
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import CONFIG_DIR, load, names

SHIPPED = [(kind, name) for kind in Kind for name in names(_FOLDERS[kind])]


@pytest.mark.parametrize(("kind", "name"), SHIPPED)
def test_a_new_file_is_the_shipped_one_under_another_name(kind, name, tmp_path):
    source = CONFIG_DIR / _FOLDERS[kind] / f"{name}.toml"
    text = commented(source, _model(kind), "mine", "pkxyz sil mine.toml")
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    assert tomllib.loads(text) == tomllib.loads(source.read_text(encoding="utf-8")) | {"name": "mine"}
    load(_FOLDERS[kind], tmp_path / "mine.toml", _model(kind))
    assert len(re.findall(r"^\w+ *=.*#", text, re.MULTILINE)) >= 5


def test_new_files_run_and_are_not_written_over(tmp_path):
    for kind in Kind:
        done = pkxyz("new", kind.value, f"my_{kind.value}.toml", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert "run it with: pkxyz " in done.stdout
    files = "--stage", "my_stage.toml", "--controller", "my_controller.toml"
    ran = pkxyz("sil", "my_scenario.toml", "--lane", "fast", *files, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    before = (tmp_path / "my_scenario.toml").read_bytes()
    again = pkxyz("new", "scenario", "my_scenario.toml", "--like", "circle", cwd=tmp_path)
    assert again.returncode == 2
    assert "left alone" in again.stderr
    assert (tmp_path / "my_scenario.toml").read_bytes() == before


def test_a_new_scenario_brings_the_table_that_it_reads(tmp_path):
    assert pkxyz("new", "scenario", "there/mine.toml", "--like", "path", cwd=tmp_path).returncode == 0
    assert (tmp_path / "there" / "path.csv").read_bytes() == (CONFIG_DIR / "scenarios" / "path.csv").read_bytes()


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (("scenario", "mine"), "must end in .toml"),
        (("scenario", "mine.toml", "--like", "rastr"), "did you mean 'raster'?"),
        (("plant", "mine.toml"), "'scenario', 'stage', 'controller', 'bus'"),
    ],
)
def test_what_new_refuses(words, answer, tmp_path):
    done = pkxyz("new", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert answer in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [[], ["sil"], ["new"], ["check-amplifier"]])
def test_h_is_help(words, tmp_path):
    done = pkxyz(*words, "-h", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Usage: pkxyz")


def test_configs_says_where_the_files_are(tmp_path):
    shown = pkxyz("configs", cwd=tmp_path).stdout
    for kind in ("scenarios", "stages", "plants", "controllers", "buses", "tolerances", "processes", "searches"):
        assert f"{CONFIG_DIR / kind}/" in shown


def test_errors_of_each_axis_are_shown_also_where_a_check_fails(tmp_path):
    pkxyz("new", "scenario", "mine.toml", cwd=tmp_path)
    path = tmp_path / "mine.toml"
    path.write_text(path.read_text().replace("rms_error_nm = { max = 5.0 }", "rms_error_nm = { max = 0.01 }"))
    done = pkxyz("sil", "mine.toml", "--lane", "fast", cwd=tmp_path)
    assert done.returncode == 1
    assert re.search(
        r"^rms error while scanning, x / y / z: [01]\.\d\d / [01]\.\d\d / [01]\.\d\d nm$", done.stdout, re.MULTILINE
    )


def test_error_lines_say_whose_errors_they_are():
    rows = RowFigures(10, 0, {"x": 1.0, "y": 2.5, "z": 0.126}, None, None, None, None, None)
    assert list(error_lines(rows, "true position")) == ["rms error while scanning, x / y / z: 1.00 / 2.50 / 0.13 nm"]
    assert ", by the estimate, " in next(error_lines(rows, "estimate"))


@pytest.mark.slow
def test_the_hint_of_a_monte_carlo_study_is_a_command_that_runs(tmp_path):
    done = pkxyz("montecarlo", "--plants", "1", "--workers", "1", "--out", "mc", "--controller", "robust", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    hint = re.search(r"^the worst one alone: pkxyz (.*)$", done.stdout, re.MULTILINE)
    assert hint is not None
    alone = pkxyz(*shlex.split(hint[1]), cwd=tmp_path)
    assert alone.returncode == 0, alone.stderr
    assert (tmp_path / "mc" / "seed-1" / "report.png").is_file()


def test_a_fault_leads_to_what_explains_it(tmp_path):
    faults = [
        "at 0.5 s: Sense comb 2 repeats (SENSE_FROZEN_2): ...\nEMCY 0x8130: heartbeat",
        "comb 1 (COMB_FORCE_1): (x2)",
    ]
    line = where_to_read(faults)
    assert line is not None
    command = re.search("`pkxyz (.*)`", line)
    assert command is not None
    assert command[1] == "explain SENSE_FROZEN_2 0x8130 COMB_FORCE_1"
    told = pkxyz(*shlex.split(command[1]), cwd=tmp_path)
    assert told.returncode == 0, told.stderr
    assert [told.stdout.count(words) for words in ("what clears it: ", "the controller died", "COMB_FORCE_1: ")] == [
        3,
        1,
        1,
    ]
    assert where_to_read(["the node ended (in the middle)"]) is None


def test_a_bus_takes_what_an_eds_says(tmp_path):
    text = (CONFIG_DIR / "comb_amplifier.eds").read_text(encoding="utf-8").replace("0x7078797A", "0x00001234")
    (tmp_path / "other.eds").write_text(text, encoding="utf-8")
    done = pkxyz("new", "bus", "mine.toml", "--like", "fd_5k", "--eds", "other.eds", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    driver = load("buses", tmp_path / "mine.toml", BusConfig).can.driver
    assert (driver.vendor_id, driver.drive_pdo, driver.drive_channels) == (0x1234, 2, (1, 2, 3))
    assert "# other.eds" in (tmp_path / "mine.toml").read_text(encoding="utf-8")
    refused = pkxyz("new", "stage", "mine2.toml", "--eds", "other.eds", cwd=tmp_path)
    assert refused.returncode == 2
    assert "about the amplifier of a bus" in refused.stderr

"""``pkxyz paper``, ``workspace``, ``design``, ``linearisation``: what they print, write
and refuse, with hil.cli's own ``main``.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner, Result

from hil.commands import mechanics as mechanics_cli
from hil.pictures.workspace import edge_path, section
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.mechanics.workspace import geometric_volume, voltage_needed_v
from pkxyz_ctrl.stage import Stage

PNG = b"\x89PNG\r\n\x1a\n"


def run(*arguments: str) -> Result:
    app = Typer()
    for command in (mechanics_cli.paper, mechanics_cli.workspace, mechanics_cli.design, mechanics_cli.linearisation):
        app.command()(command)
    return CliRunner().invoke(app, list(arguments))


def as_json(*arguments: str) -> dict[str, Any]:
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.output
    data: dict[str, Any] = json.loads(result.stdout)
    return data


def refusal(*arguments: str) -> str:
    error = run(*arguments).exception
    assert isinstance(error, ConfigError), error
    assert "\n" not in str(error)
    return str(error)


def test_paper_as_json_and_with_its_figures(tmp_path: Path) -> None:
    rows = {row["quantity"]: row for row in as_json("paper", "--out", str(tmp_path / "figures"))["rows"]}
    assert rows["K_zz"]["verdict"] == "reproduces"
    assert rows["volume of the workspace"]["verdict"] == "not reproducible"
    assert rows["moving mass"]["corrected"]["text"] == pytest.approx(3.655)
    drawn = sorted(path.name for path in (tmp_path / "figures").iterdir())
    assert drawn == [
        "figure_4_design_space.png",
        "figure_7_workspace.png",
        "figure_8_modes.png",
        "figure_b_edge_path.png",
    ]
    assert all((tmp_path / "figures" / name).read_bytes().startswith(PNG) for name in drawn)


@pytest.mark.parametrize("width", [80, 200])
def test_paper_on_a_narrow_and_a_wide_screen(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    out = run("paper").stdout
    assert "57 numbers: 31 reproduces, 13 misprint, 5 rounded, 8 not reproducible" in out
    assert "sec^2[a]" in out
    assert "free of the mass" in out
    assert ("0.122303 printed, 0.113649 reconstructed" in out) == (width == 80)


def test_workspace_figures_and_numbers(tmp_path: Path) -> None:
    data = as_json("workspace", "--v-max", "130", "--out", str(tmp_path))
    assert data["volume_um3"]["exact"] == pytest.approx(geometric_volume(Stage.load("reconstructed")).value_m3 * 1e18)
    assert data["volume_um3"]["held_share"] == pytest.approx(0.1815, abs=1e-4)
    assert data["corners"][-1]["voltage_v"] == pytest.approx(181.93, abs=0.01)
    assert (tmp_path / "workspace.png").read_bytes().startswith(PNG)
    assert "181.9 too much" in run("workspace", "--v-max", "130").stdout
    assert "too much" not in run("workspace").stdout


def test_design_writes_a_stage_that_loads(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    data = as_json("design", "--out", str(path), "--picture", str(tmp_path / "region.png"))
    stage = Stage.load(path)
    assert stage.config.name == "mine"
    assert float(stage.geometry["link_m"][0]) * 1e6 == pytest.approx(data["l2_um"], rel=1e-12)
    assert float(voltage_needed_v(stage, [25e-6] * 3)) < 200
    assert "# z_0 = handle 300 um + 2 oxide 0.5 um + t_3" in path.read_text(encoding="utf-8")
    assert (tmp_path / "region.png").read_bytes().startswith(PNG)


def test_a_force_limit_is_a_voltage_limit(tmp_path: Path) -> None:
    path = tmp_path / "by_force.toml"
    as_json("design", "--force", "2.2", "--out", str(path))
    stage = Stage.load(path)
    assert stage.force_max_n == pytest.approx(2.2e-3, rel=1e-12)


def test_linearisation_in_nanometres(tmp_path: Path) -> None:
    worst = as_json("linearisation", "--out", str(tmp_path))["worst_nm"]
    assert worst["constant_at_rest"]["z"] == pytest.approx(3204, abs=2)
    assert worst["newton_step"]["z"] < 23
    assert (tmp_path / "linearisation.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("design", "--v-max", "130"), "comb force binds"),
        (("design", "--stroke", "-1"), "stroke_m > 0 is violated"),
        (("design", "--layers", "90/27/300"), "--layers takes four thicknesses in um"),
        (("design", "--layers", "90/27/-300/0.5"), "handle_layer_m > 0 is violated"),
        (("design", "--chains", "2"), "--chains must be 1"),
        (("design", "--out", "mine.json"), "--out must be a .toml file"),
        (("design", "--force", "-1"), "voltage_max_v > 0 is violated"),
        (("workspace", "--v-max", "0"), "voltage_max_v > 0 is violated"),
        (("workspace", "--v-max", "nan"), "--v-max must be a finite number"),
        (("workspace", "--stage", "reconstruct"), "did you mean 'reconstructed'?"),
        (("linearisation", "--move", "0"), "move_m > 0 is violated"),
    ],
)
def test_bad_input_is_one_line(
    arguments: tuple[str, ...], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert words in refusal(*arguments)
    assert not list(tmp_path.iterdir())


def test_unwritable_places_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert "file exists; give another folder" in refusal("paper", "--out", str(tmp_path / "file"))
    assert "cannot be written" in refusal("design", "--out", str(tmp_path / "none" / "x.toml"))


def test_the_theory_draws_nothing_and_imports_no_matplotlib() -> None:
    code = (
        "import sys, pkgutil, importlib, pkxyz_ctrl.mechanics as m\n"
        "[importlib.import_module('pkxyz_ctrl.mechanics.' + i.name) for i in pkgutil.iter_modules(m.__path__)]\n"
        "import hil.commands.mechanics\n"
        "sys.exit('matplotlib' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_sections_hold_their_volume() -> None:
    """The areas of the drawn sections, summed over the heights, are the exact volume."""
    stage = Stage.load("reconstructed")
    line, heights = np.linspace(-18e-6, 18e-6, 145), np.linspace(0, 37.2e-6, 40)
    area = [float((section(stage, h, line)[0] > 0).sum()) * (line[1] - line[0]) ** 2 for h in heights]
    assert np.trapezoid(area, heights) == pytest.approx(geometric_volume(stage).value_m3, rel=5e-3)


def test_edge_path_runs_over_the_corners() -> None:
    stage = Stage.load("reconstructed")
    strokes, positions = edge_path(stage, points=11)
    np.testing.assert_allclose(strokes[[0, 10, 21, 32]] * 1e6, [[0, 0, 0], [25, 0, 0], [25, 25, 0], [25, 25, 25]])
    np.testing.assert_allclose(stage.inverse_kinematics(positions), strokes, rtol=0, atol=1e-15)
    assert ((np.isclose(strokes, 0) | np.isclose(strokes, 25e-6)).sum(axis=1) >= 2).all()

"""Numbers of the mechanics page that a command prints: run, and compared with what the page says."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import pkxyz
from test_numbers import page

from pkxyz_ctrl import Stage
from pkxyz_ctrl.mechanics.published import entries
from pkxyz_ctrl.mechanics.reproduction import reproduction_table

TEXT = page("docs/understand/mechanics.md")


@cache
def told(folder: Path, *words: str) -> Any:
    """What a command answers with as JSON."""
    done = pkxyz(*words, "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def says(words: str) -> None:
    assert words in TEXT, words


def test_the_workspace_and_what_the_paper_s_voltage_holds(tmp_path_factory: pytest.TempPathFactory) -> None:
    found = told(tmp_path_factory.getbasetemp(), "workspace", "--v-max", "130")
    says(f"on its corner, {found['volume_um3']['exact']:.0f} um³")
    says(f"{found['inscribed_cube_um']['standing']:.2f} um standing on its corner")
    says(f"130 V, {100 * found['volume_um3']['held_share']:.0f} % of the volume can be held")


def test_what_one_jacobian_costs(tmp_path_factory: pytest.TempPathFactory) -> None:
    worst = told(tmp_path_factory.getbasetemp(), "linearisation")["worst_nm"]
    rest, middle = (1e-3 * max(worst[name].values()) for name in ("constant_at_rest", "constant_at_middle"))
    says(f"wrong by up to {rest:.1f} um if taken at rest, by {middle:.1f} um at mid-stroke")
    says(f"leaves {max(worst['newton_step'].values()):.0f} nm")


def test_the_recommended_drawing(tmp_path: Path) -> None:
    found = told(tmp_path, "design")
    says(f"L2 = {found['l2_um']:.0f} um and α₀ = {found['alpha_0_rad']:.3f} rad, within 1 % of the reconstructed link")
    link_m = float(Stage.load("reconstructed").geometry["link_m"][0])
    assert abs(1e-6 * found["l2_um"] / link_m - 1.0) < 0.01


def test_the_force_at_the_top_and_with_pivots_on_all_chains() -> None:
    stage = Stage.load("reconstructed")
    top = stage.forward_kinematics([25e-6] * 3)
    config = stage.config
    three = Stage(config.model_copy(update={"flexures": config.flexures.model_copy(update={"out_of_plane_chains": 3})}))
    says(f"by the exact energy {1e3 * stage.holding_forces(top)[0]:.2f} mN ({stage.holding_voltages(top)[0]:.1f} V)")
    rest = np.zeros(3)
    lifting_n_per_m = stage.stiffness(rest)[2, 2] / (3 * stage.jacobian(rest)[0, 2] ** 2)  # Eq. 24
    says(f"lift by 25 um of stroke takes {25e-3 * lifting_n_per_m:.2f} mN (Eq. 24)")
    volts = np.sqrt(three.holding_forces(top)[0] / stage.force_gain_n_per_v2[0])
    says(f"takes some {volts:.0f} V")


def test_what_the_printed_coefficients_of_the_sextic_give() -> None:
    rows = reproduction_table(entries(), Stage.load("printed"), Stage.load("reconstructed"))
    (row,) = [r for r in rows if r.quantity.startswith("delta at lambda = 0")]
    assert row.reconstructed is not None
    says(f"put δ {row.reconstructed - row.published:.1f} um off")

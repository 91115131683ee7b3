"""``pkxyz export`` asked for what it can't give: one line, exit code 2, nothing written and nothing overwritten."""

import re

import numpy as np
import pytest
from command_line import refused

from hil.runs.scenario import load_scenario
from pkxyz_ctrl.export.calls import CALL
from pkxyz_ctrl.export.folder import Exported, require_exportable, write
from pkxyz_ctrl.export.kernels import ExportError
from pkxyz_ctrl.loop.cycle import LAW
from pkxyz_ctrl.loop.exchange import EXCHANGE
from pkxyz_ctrl.loop.reference import REFERENCE


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--target", "z80"), "--target: 'z80' is none; choose host, linux, cortex-m7"),
        (("nowhere",), "nowhere"),
        (("--controller", "mpc"), "the longest tick takes 5034 us; give a bus of 6293 us or more, fewer rounds of its"),
        (("--controller", "nope"), "nope"),
        (("--ticks", "10"), "ticks"),
        (("--target", "cortex-m4"), "a period of 200 us is too short for cortex-m4, where the longest tick takes 3750"),
        (("--controller", "robust_20k", "--bus", "local_20k", "--target", "host"), "bus 'local_20k' has no [can]"),
        (("--controller", "robust_20k", "--bus", "local_20k"), "give a bus of 93 us or more, or another target"),
    ],
)
def test_what_does_not_go_is_said_in_a_line(tmp_path, capsys, monkeypatch, words, says):
    out = tmp_path / "out"
    assert says in refused(capsys, monkeypatch, "export", *words, "--out", out)
    assert not out.exists()


@pytest.mark.parametrize("target", ["cortex-m7", "cortex-m4"])
def test_the_shortest_period_that_it_asks_for_goes(target):
    law = np.zeros(1, LAW)
    with pytest.raises(ExportError, match="is too short") as refused:
        require_exportable(law, target)
    law["period_us"] = int(re.search(r"a bus of (\d+) us or more", str(refused.value))[1])
    require_exportable(law, target)
    law["period_us"] -= 1
    with pytest.raises(ExportError, match="is too short"):
        require_exportable(law, target)


@pytest.mark.parametrize("horizon", [10, 20])
def test_fewer_rounds_of_a_solver_take_less(horizon):
    """It may take all the rounds that it is allowed, whatever it took so far."""
    law = load_scenario("raster", controller="mpc").setup().law.copy()
    law["period_us"], law["tick"]["predictive"]["horizon"] = 2_000, horizon
    for rounds, goes in ((8, horizon == 10), (9, False)):
        law["tick"]["predictive"]["iterations_max"] = rounds
        if goes:
            require_exportable(law, "cortex-m7")
        else:
            with pytest.raises(ExportError, match=r"mpc\.iterations_max"):
                require_exportable(law, "cortex-m7")
    require_exportable(law, "host")


def test_nothing_of_the_users_is_overwritten(tmp_path, capsys, monkeypatch):
    (tmp_path / "thesis.tex").write_text("years")
    assert "is not empty, and nothing is overwritten" in refused(capsys, monkeypatch, "export", "--out", tmp_path)
    assert "is not empty" in refused(capsys, monkeypatch, "export", "--out", tmp_path / "thesis.tex")
    assert [item.name for item in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_path_that_no_board_holds_is_refused_with_what_it_takes(tmp_path):
    config = np.zeros(1, EXCHANGE)
    config["law"][0] = load_scenario("raster").setup().law
    exported = Exported(config, np.zeros(20_000, REFERENCE), np.zeros(100, CALL), "raster", "youla", "")
    with pytest.raises(ExportError, match=r"takes 2\.6 MiB.*give --ticks 15420 or less"):
        write(tmp_path / "out", "cortex-m7", exported)
    assert not (tmp_path / "out").exists()

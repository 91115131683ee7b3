"""The public interface of ``hil``: what it promises, without a name that begins with an underscore."""

import ast
import builtins
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import control
import numpy as np
import pytest

import hil
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.loop.row import ROW

ROOT = Path(__file__).parents[2]
BRIEF = {
    "name": "brief", "duration_s": 0.4, "seed": 1, "stage": "reconstructed", "plant": "nominal", "controller": "lqg",
    "bus": "fd_5k", "reference": [{"kind": "hold", "duration_s": 0.1}],
}  # fmt: skip


@pytest.fixture(scope="module")
def run() -> hil.Run:
    return hil.run(hil.build_scenario(BRIEF))


def test_every_public_name_is_there_and_described() -> None:
    for name in hil.__all__:
        assert getattr(hil, name).__doc__, name
    assert set(hil.__all__) <= set(dir(hil))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        hil.nonsense  # noqa: B018


def test_its_first_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """Line by line, as somebody types it."""
    shown = [line.removeprefix(">>> ") for line in (hil.__doc__ or "").splitlines() if line.startswith(">>> ")]
    names: dict[str, object] = {}
    for line in shown:
        exec(compile(line, "<example>", "single"), names)
    said = capsys.readouterr().out
    assert len(shown) >= 4
    assert "'x': " in said
    assert "array([" in said


@pytest.mark.parametrize(("lane", "words"), [("lockstp", "there are: lockstep, fast"), ("wall", "pkxyz run"),
                                             ("emulated", "pkxyz emulate")])  # fmt: skip
def test_a_lane_that_is_not_to_be_had_here_is_refused(lane: str, words: str) -> None:
    with pytest.raises(hil.ConfigError, match=words):
        hil.run(hil.build_scenario(BRIEF), lane=lane)


def test_what_is_raised_can_be_caught_by_its_public_name() -> None:
    for function in (hil.run, hil.open_run, hil.design, hil.with_law, hil.tune, hil.identify, hil.montecarlo):
        for name in re.findall(r"``(\w+Error)``", function.__doc__ or ""):
            assert name in hil.__all__ or hasattr(builtins, name), f"{function.__name__}: {name}"


def test_versions_are_one() -> None:
    """Of the package, of what is cited, and of the newest entry of the changelog."""
    package = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    newest = re.search(r"^## ([\d.]+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert cited is not None
    assert newest is not None
    assert [cited[1], newest[1]] == [package, package]


def test_importing_it_loads_nothing_heavy() -> None:
    code = "import sys, hil; print(sorted({'numba', 'scipy', 'pyarrow', 'matplotlib', 'control'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_columns_carry_units_and_are_those_of_the_recording(run: hil.Run) -> None:
    assert len(run.rows) == 2000
    assert np.array_equal(run["position_x_m"], run["position_m"][:, 0])
    assert np.array_equal(run["voltage_2_v"], run.rows["voltage_v"][:, 1])
    arrays = run.arrays()
    assert list(arrays) == list(run)
    assert all(array.shape == (2000,) and array.flags.c_contiguous for array in arrays.values())
    assert sum(array.nbytes for array in arrays.values()) <= run.rows.nbytes
    with pytest.raises(KeyError, match=r"no column 'position_x_um'; there are: t_us, tick"):
        run["position_x_um"]


def test_pandas_and_polars_hold_the_same_numbers(run: hil.Run) -> None:
    pandas, polars = run.to_pandas(), run.to_polars()
    assert list(pandas.columns) == polars.columns == list(run)
    for name in ("t_us", "position_z_m", "drive_3_count"):
        assert np.array_equal(pandas[name].to_numpy(), run[name])
        assert np.array_equal(polars[name].to_numpy(), run[name])


def test_a_folder_holds_the_same_run_in_either_lane(run: hil.Run, tmp_path: Path) -> None:
    scenario = hil.build_scenario(BRIEF)
    kept = hil.run(scenario, lane="lockstep", out=tmp_path / "run")
    opened = hil.open_run(tmp_path / "run")
    for name in ROW.names or ():
        assert np.array_equal(opened.rows[name], run.rows[name]), name
    assert opened.summary == kept.summary
    assert opened.ok is run.ok is True
    assert (tmp_path / "run" / "report.png").stat().st_size > 10_000
    assert run.folder is None
    assert opened.summary["hold_noise_nm"] == run.summary["hold_noise_nm"]


def test_what_cannot_be_built_is_said_in_a_line() -> None:
    with pytest.raises(ConfigError, match=r"duration_s"):
        hil.build_scenario(BRIEF | {"duration_s": -1.0})
    with pytest.raises(ConfigError, match=r"controller|controllers"):
        hil.build_scenario(BRIEF | {"controller": "no_such_law"})


def test_margins_are_those_of_the_command() -> None:
    law = hil.design("robust")
    found = law.margins()
    assert found.stable
    assert 1.5 < found.mimo.peak_s < 2.0
    assert 190.0 < found.mimo.bandwidth_hz < 220.0
    response = law.response([50.0, 200.0])
    assert np.linalg.svd(response.s, compute_uv=False).max(axis=1)[0] < 0.5
    with pytest.raises(ConfigError, match="strokes go from 0 to 25 um"):
        law.margins(at_um=(99.0, 0.0, 0.0))
    assert law.record["period_us"][0] == 200


def test_sampled_plants_go_on_and_run_alone_to_the_bit(tmp_path: Path) -> None:
    scenario = hil.build_scenario(BRIEF)
    first = hil.montecarlo(scenario, plants=2, workers=1, out=tmp_path)
    again = hil.montecarlo(scenario, plants=3, workers=1, out=tmp_path)
    assert again.results[:2] == first.results
    assert again.summary["plants"] == 3
    alone = hil.run(again.scenario_of(3))
    assert max(alone.summary["hold_noise_nm"].values()) == again.results[2].hold_noise_nm


def test_identify_finds_the_resonances() -> None:
    found = hil.identify(periods=3)
    hz = np.sort(found.modes.frequency_hz)
    assert np.abs(hz / np.sort(found.drawn_hz) - 1.0).max() < 0.002
    with pytest.raises(ConfigError, match="only feeds forward"):
        hil.identify(controller="open_loop")


def test_commands_call_what_programs_call() -> None:
    """What ``pkxyz`` does, a program does with the same function: no second way from options to figures."""
    folder = Path(hil.__file__).parent / "commands" / "studies"
    for command, module in {
        "margins": "hil.api.design", "identify": "hil.api.identify", "montecarlo": "hil.api.montecarlo",
        "tune": "hil.api.tune",
    }.items():  # fmt: skip
        tree = ast.parse((folder / f"{command}.py").read_text(encoding="utf-8"))
        used = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        assert module in used, command
        assert "hil.studies.spread.workers" not in used, command


def test_a_program_that_is_interrupted_has_what_was_done(tmp_path: Path) -> None:
    scenario = hil.build_scenario(BRIEF)

    def stop_after(plants: int) -> Callable[[int, int], None]:
        def stop(done: int, total: int) -> None:
            if done == plants:
                raise KeyboardInterrupt

        return stop

    some = hil.montecarlo(scenario, plants=3, workers=1, out=tmp_path, on_progress=stop_after(1))
    assert (some.interrupted, len(some.results)) == (True, 1)
    with pytest.raises(KeyboardInterrupt):
        hil.montecarlo(scenario, plants=3, first_seed=7, workers=1, out=tmp_path, on_progress=stop_after(0))


def test_a_search_of_taps_says_who_finds_them() -> None:
    with pytest.raises(ConfigError, match=r"youla: asks for taps.*hil\.tune_taps"):
        hil.tune("youla")


def test_a_law_of_one_s_own_is_designed_written_and_refused_in_words(tmp_path: Path) -> None:
    """An integrator: its margins by hand-made chains, tests/design/laws; here, that it goes through the front door."""
    mine = hil.with_law("lqg", control.tf([14600.0], [1, 0]))
    law = hil.design(mine)
    assert 2.0 < max(axis.peak_s for axis in law.margins().axes) < 3.0
    law.write(tmp_path / "mine.toml")
    assert np.array_equal(hil.design(tmp_path / "mine.toml").record, law.record)
    with pytest.raises(hil.ConfigError, match="with a tenth of its gain it is stable"):
        hil.design(hil.with_law("lqg", control.tf([146000.0], [1, 0])))
    with pytest.raises(hil.ConfigError, match="this law can't be had"):
        hil.with_law("lqg", control.tf([1, 0, 0], [1, 0]))

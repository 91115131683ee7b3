"""Designed laws, kept on disk: the same bytes as a new design, and never an old or a broken one."""

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.design import law as design
from pkxyz_ctrl.design import law_store
from pkxyz_ctrl.design.law_store import law_of
from pkxyz_ctrl.stage import Stage


@cache
def shipped() -> tuple[StageConfig, ControllerConfig, BusConfig]:
    setup = load_scenario("raster").setup()
    return setup.stage, setup.controller, setup.bus


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return tmp_path / "laws"


@pytest.fixture
def designs(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """One entry for each time that somebody designs."""
    made: list[object] = []
    real = design.design_law
    monkeypatch.setattr(design, "design_law", lambda *args, **kwargs: made.append(args) or real(*args, **kwargs))
    return made


def test_what_is_read_back_is_what_was_designed(folder: Path, designs: list[object]) -> None:
    anew = design.design_law(Stage(shipped()[0]), *shipped()[1:], autostart=True)
    designs.clear()
    first, second = (law_of(*shipped(), autostart=True) for _ in range(2))
    assert len(designs) == 1
    for law in (first, second):
        assert law.tobytes() == anew.tobytes()
        assert law.dtype == anew.dtype
        assert not law.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        second["period_us"] = 0


def test_every_input_counts(folder: Path, designs: list[object]) -> None:
    stage, controller, bus = shipped()
    law_of(*shipped(), autostart=True)
    stiff = stage.model_copy(update={"dynamics": stage.dynamics.model_copy(update={"quality_factor": 19.0})})
    calm = controller.model_copy(update={"homing_s": 0.06})
    slow = bus.model_copy(update={"period_us": 2 * bus.period_us})
    for parts in ((stiff, controller, bus), (stage, calm, bus), (stage, controller, slow)):
        law_of(*parts, autostart=True)
    law_of(*shipped(), autostart=False)
    assert len(designs) == 5
    assert len(list(folder.iterdir())) == 5


def test_where_a_bus_is_does_not_count(folder: Path, designs: list[object]) -> None:
    """Each stage that is served has a channel of its own, and waited for a design at each new name."""
    stage, controller, bus = shipped()
    assert bus.can is not None
    elsewhere = bus.model_copy(update={"can": bus.can.model_copy(update={"channel": "elsewhere"})})
    law, other = law_of(*shipped(), autostart=True), law_of(stage, controller, elsewhere, autostart=True)
    assert len(designs) == 1
    assert (
        other.tobytes()
        == law.tobytes()
        == design.design_law(Stage(stage), controller, elsewhere, autostart=True).tobytes()
    )


def test_a_program_of_other_sources_designs_anew(
    folder: Path, designs: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = tmp_path / "sources"
    (sources / "design").mkdir(parents=True)
    (sources / "a.py").write_text("GAIN = 1.0")
    monkeypatch.setattr(law_store, "__file__", str(sources / "design" / "law_store.py"))
    law_store._program.cache_clear()  # a process looks at its sources once
    law_of(*shipped(), autostart=True)
    law_of(*shipped(), autostart=True)
    assert len(designs) == 1
    (sources / "a.py").write_text("GAIN = 2.0")
    law_store._program.cache_clear()
    law_of(*shipped(), autostart=True)
    assert len(designs) == 2
    law_store._program.cache_clear()


@pytest.mark.parametrize("damage", ["one bit", "cut", "longer", "empty"])
def test_a_file_that_is_not_whole_is_no_file(folder: Path, designs: list[object], damage: str) -> None:
    law = law_of(*shipped(), autostart=True)
    (path,) = folder.iterdir()
    content = bytearray(path.read_bytes())
    if damage == "one bit":
        content[len(content) // 2] ^= 1
    path.write_bytes({"cut": content[:-1], "longer": content + b"\0", "empty": b""}.get(damage, content))
    assert law_of(*shipped(), autostart=True).tobytes() == law.tobytes()
    assert len(designs) == 2
    law_of(*shipped(), autostart=True)
    assert len(designs) == 2  # and the file is whole again


def test_a_law_that_is_refused_is_not_kept(folder: Path) -> None:
    stage, controller, bus = shipped()
    beyond = controller.model_copy(update={"limits": controller.limits.model_copy(update={"voltage_max_v": 900.0})})
    for _ in range(2):
        with pytest.raises(ConfigError, match="voltage_max_v"):
            law_of(stage, beyond, bus, autostart=True)
    assert not folder.exists()


def test_without_a_folder_it_is_designed_each_time(
    tmp_path: Path, designs: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "laws").write_text("a file where the folder should be")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    laws = [law_of(*shipped(), autostart=True) for _ in range(2)]
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    laws.append(law_of(*shipped(), autostart=True))
    assert len(designs) == 3
    assert all(np.array_equal(law, laws[0]) for law in laws)


def test_the_second_run_needs_no_design_tools() -> None:
    """Their import is half of the time that a first run spends before it starts."""
    program = (
        "import sys; from hil.runs.scenario import load_scenario; import hil.lanes.in_process;"
        "load_scenario('raster').setup().law;"
        "print([m for m in ('control', 'filterpy', 'scipy.stats', 'scipy.integrate', 'osqp') if m in sys.modules])"
    )
    said = [subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout for _ in range(2)]
    assert said[1] == "[]\n", said

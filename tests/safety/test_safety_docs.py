"""docs/understand/safety.md shows the tables that run, and every default that it explains."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from loop_rig import monitor_limits

from pkxyz_ctrl.safety.gate import PERMITTED, FrameKind
from pkxyz_ctrl.safety.modes import TRANSITIONS, Mode

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def figures() -> ModuleType:
    spec = importlib.util.spec_from_file_location("docs_figures_modes", DOCS / "tables" / "modes.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_page_holds_the_current_tables(figures: ModuleType) -> None:
    page = (DOCS / "understand" / "safety.md").read_text(encoding="utf-8")
    assert all(f"<!-- generated: {part} -->" in page for part in figures.PARTS)
    assert figures.filled_in(page) == page, "run: python docs/tables/modes.py"


def test_diagram_has_every_transition(figures: ModuleType) -> None:
    arrows = set()
    for line in figures.diagram().splitlines():
        if "-->" in line and "[*]" not in line:
            ends, events = line.split(": ")
            source, target = ends.split(" --> ")
            arrows |= {(source.strip(), event, target) for event in events.split(", ")}
    assert arrows == {(mode.name, event.name, target.name) for (mode, event), target in TRANSITIONS.items()}


def test_gate_table_reads_back(figures: ModuleType) -> None:
    header, _, *rows = ([cell.strip() for cell in line.split("|")[1:-1]] for line in figures.gate().splitlines())
    for row in rows:
        kinds = {FrameKind[name] for name, cell in zip(header[1:], row[1:], strict=True) if cell == "yes"}
        assert kinds == set(PERMITTED[Mode[row[0]]])
    assert len(rows) == len(Mode)


@pytest.mark.parametrize(
    ("limit", "fields"),
    [
        ("| stale | 5 ticks |", {"stale_count": 5}),
        (
            "| sequence, CRC, length | 8, 5, 5, leak 200 ticks |",
            {"sequence_count": 8, "crc_count": 5, "length_count": 5, "frame_leak_ticks": 200},
        ),
        ("| range | 3 ticks |", {"range_count": 3}),
        ("| stroke | -2 to 27 um |", {"stroke_min_m": -2e-6, "stroke_max_m": 27e-6}),
        ("| frozen | 50 equal counts |", {"frozen_count": 50}),
        ("| innovation | 500 nm, 5 ticks |", {"innovation_max_m": 500e-9, "innovation_count": 5}),
        ("| unexplained force at a comb | 0.8 mN, 5 ticks |", {"unexplained_force_max_n": 0.8e-3}),
        (
            "| its change, about a mean over 30 ms | 40 uN + 40 % of what was commanded, 5 ticks |",
            {"force_change_max_n": 40e-6, "force_change_share": 0.4, "unexplained_force_count": 5},
        ),
        ("| saturation | 250 ticks |", {"saturation_count": 250}),
        ("| slew | 20 V a tick, at once |", {"voltage_step_max_v": 20.0, "slew_count": 1}),
        ("| overrun | 10 missed ticks, leak 500 |", {"overrun_count": 10, "overrun_leak_ticks": 500}),
        ("| solver | 5 ticks |", {"solver_count": 5}),
    ],
)
def test_limits_are_as_explained(limit: str, fields: dict[str, float]) -> None:
    assert limit in (DOCS / "understand" / "safety.md").read_text(encoding="utf-8")
    for name, value in fields.items():
        np.testing.assert_allclose(monitor_limits()[name], value, rtol=1e-3)  # voltages are whole counts

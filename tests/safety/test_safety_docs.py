"""docs/understand/safety.md shows the tables that run: those that are made when the site is built, read back."""

import limit_table
import mode_tables
import numpy as np
import pytest
from loop_rig import monitor_limits

from pkxyz_ctrl.safety.gate_rules import PERMITTED, FrameKind
from pkxyz_ctrl.safety.modes import TRANSITIONS, Mode


def test_diagram_has_every_transition() -> None:
    arrows = set()
    for line in mode_tables.diagram().splitlines():
        if "-->" in line and "[*]" not in line:
            ends, events = line.split(": ")
            source, target = ends.split(" --> ")
            arrows |= {(source.strip(), event, target) for event in events.split(", ")}
    assert arrows == {(mode.name, event.name, target.name) for (mode, event), target in TRANSITIONS.items()}


def test_gate_table_reads_back() -> None:
    header, _, *rows = ([cell.strip() for cell in line.split("|")[1:-1]] for line in mode_tables.gate().splitlines())
    for row in rows:
        kinds = {FrameKind[name] for name, cell in zip(header[1:], row[1:], strict=True) if cell == "yes"}
        assert kinds == set(PERMITTED[Mode[row[0]]])
    assert len(rows) == len(Mode)


EXPLAINED = [
    ("| stale | 5 ticks |", {"stale_count": 5}),
    ("| sequence | 8, leak 200 ticks |", {"sequence_count": 8}),
    ("| CRC, length | 5, 5, leak 200 ticks |", {"crc_count": 5, "length_count": 5, "frame_leak_ticks": 200}),
    ("| range | 3 ticks |", {"range_count": 3}),
    ("| stroke | -2 to 27 um |", {"stroke_min_m": -2e-6, "stroke_max_m": 27e-6}),
    ("| frozen | 50 equal counts |", {"frozen_count": 50}),
    ("| innovation | 500 nm, 5 ticks |", {"innovation_max_m": 500e-9, "innovation_count": 5}),
    ("| residual of a stroke | 700 nm, 3 in all, leak 200 |", {"residual_max_m": 700e-9, "residual_count": 3}),
    ("| unexplained force at a comb | 0.8 mN, 5 ticks |", {"unexplained_force_max_n": 0.8e-3}),
    (
        "| its change, about a mean over 30 ms | 32 uN + 47 % of what was commanded, 5 ticks |",
        {"force_change_max_n": 32e-6, "force_change_share": 0.47, "unexplained_force_count": 5},
    ),
    ("| saturation | 250 ticks |", {"saturation_count": 250}),
    ("| slew | 20 V a tick, at once |", {"voltage_step_max_v": 20.0, "slew_count": 1}),
    ("| overrun | 10 missed ticks, leak 500 |", {"overrun_count": 10, "overrun_leak_ticks": 500}),
    ("| solver | 5 ticks |", {"solver_count": 5}),
]
"""What was written by hand once: a limit that changes asks whether its reason still holds."""


@pytest.mark.parametrize(("limit", "fields"), EXPLAINED)
def test_limits_are_as_explained(limit: str, fields: dict[str, float]) -> None:
    assert limit in limit_table.limits()
    for name, value in fields.items():
        np.testing.assert_allclose(monitor_limits()[name], value, rtol=1e-3)  # voltages are whole counts


def test_every_monitor_s_limit_is_explained() -> None:
    assert len(limit_table.limits().splitlines()) == 2 + len(EXPLAINED)

"""What makes a run not ok though its scenario says nothing of it: an unasked-for fault, and rows that were lost."""

import json
import signal

import pytest
import typer

from hil.commands import run as run_cli
from hil.commands.run import _show
from hil.lanes.lane import Lane
from hil.runs.at_rate import RanAtRate
from hil.runs.metrics import RowFigures
from hil.runs.scenario import load_scenario
from hil.runs.summary import LoopFigures, summarise

ROWS = RowFigures(1000, 0, None, None, None, None, None, None)
TEXT = """
name = "plain"
duration_s = 0.1
seed = 1
stage = "reconstructed"
plant = "nominal"
controller = "lqg"
bus = "fd_5k"
reference = [{{ kind = "hold", duration_s = 0.1 }}]
{more}
"""


def summary(tmp_path, loop, more="", *, interrupted=False):
    path = tmp_path / "plain.toml"
    path.write_text(TEXT.format(more=more), encoding="utf-8")
    return summarise(load_scenario(path), Lane.WALL, "digest", ROWS, loop, interrupted=interrupted)


FAULT = LoopFigures(faults=("at 0.1 s: the amplifier no longer says that it is alive",), lost_rows=0)


@pytest.mark.parametrize(
    ("loop", "more", "failing"),
    [
        (LoopFigures(), "", []),
        (LoopFigures(lost_rows=0, dropped_frames=3, refused_frames=2, blocked_frames=0), "", []),
        (FAULT, "", ["faults"]),
        (FAULT, "checks = { ticks = { min = 1 } }", ["faults"]),
        (FAULT, "checks = { faults = { min = 1, max = 1 } }", []),
        (LoopFigures(faults=2 * FAULT.faults), "checks = { faults = { min = 1, max = 1 } }", ["faults"]),
        (FAULT, '[[faults]]\ntarget = "sense.2"\nkind = "stuck"\nat_s = 0.05', []),
        (LoopFigures(lost_rows=1), "", ["lost_rows"]),
        (LoopFigures(dropped_frames=3), "checks = { dropped_frames = { max = 2 } }", ["dropped_frames"]),
        (LoopFigures(blocked_frames=1), "checks = { blocked_frames = { max = 0 } }", ["blocked_frames"]),
        (LoopFigures(refused_frames=1), "checks = { refused_frames = { max = 0 } }", ["refused_frames"]),
    ],
)
def test_checks_that_fail(tmp_path, loop, more, failing):
    found = summary(tmp_path, loop, more)
    assert [check.name for check in found.checks if check.ok is False] == failing
    assert found.ok == (not failing)


@pytest.mark.parametrize(
    ("loop", "ended_by", "code"),
    [
        (LoopFigures(), 0, 0),
        (FAULT, 0, 1),
        (LoopFigures(lost_rows=1), 0, 1),
        (LoopFigures(), signal.SIGTERM, 128 + signal.SIGTERM),
        (FAULT, signal.SIGTERM, 128 + signal.SIGTERM),
    ],
)
@pytest.mark.parametrize("as_json", [False, True])
def test_the_exit_code_of_a_run_at_rate_is_its_verdict(tmp_path, monkeypatch, capsys, loop, ended_by, code, as_json):
    """The scenario has no checks; what it ran into is handed in."""
    ran = RanAtRate(summary(tmp_path, loop, interrupted=bool(ended_by)), ended_by, [], [])
    monkeypatch.setattr("hil.runs.at_rate.run_into", lambda *_: ran)
    monkeypatch.setattr("hil.pictures.run.draw", lambda *_: None)
    with pytest.raises(typer.Exit) as ended:
        run_cli.run(f"{tmp_path}/plain.toml", bus="unix_1k", out=tmp_path / "out", as_json=as_json)
    assert ended.value.exit_code == code
    out = capsys.readouterr().out
    if as_json:
        assert json.loads(out)["ok"] == (code == 0)
        assert json.loads(out)["faults"] == list(loop.faults)
    else:
        assert ("fault: at 0.1 s: the amplifier no longer says that it is alive" in out) == (loop is FAULT)
        assert ("check fails: faults = 1" in out) == (loop is FAULT)


def test_what_was_lost_is_said_on_the_screen(tmp_path, capsys):
    _show(summary(tmp_path, LoopFigures(lost_rows=5, dropped_frames=4, refused_frames=3, blocked_frames=2)), tmp_path)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("lost: ")]
    assert lines == [
        "lost: 3 frames that the interface did not take",
        "lost: 4 frames that a bus among processes lost",
        "lost: 2 frames that our own gate held back",
        "lost: 5 rows that the recording's writer was too slow for",
    ]
    _show(summary(tmp_path, LoopFigures(lost_rows=0, dropped_frames=0, refused_frames=0, blocked_frames=0)), tmp_path)
    assert "lost: " not in capsys.readouterr().out


def test_what_was_lost_is_in_the_json(tmp_path):
    told = summary(tmp_path, LoopFigures(lost_rows=5, dropped_frames=4, refused_frames=3, blocked_frames=2)).as_json()
    assert [told[f"{name}"] for name in ("lost_rows", "dropped_frames", "refused_frames", "blocked_frames")] == [
        5,
        4,
        3,
        2,
    ]

"""``pkxyz replay``: is this recording what the program would do again?"""

import dataclasses
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.screen.options import AsJson
from hil.screen.progress import progress_bar
from hil.screen.terminal import plain_table, say, screen

if TYPE_CHECKING:
    from hil.runs.replay import Replay
    from pkxyz_ctrl.config.controller import ControllerConfig

_SHOWN = 8


def replay(
    folder: Annotated[Path, typer.Argument(metavar="RUN_FOLDER", help="What a run left, of any lane.")],
    controller: Annotated[
        str | None, typer.Option(help="Name or file, instead of the recorded one: where would it act differently?")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Put a recording through the tick again; exit code 0 if it agrees in every bit, is whole, and its files are as the
    run left them, 1 if not, 2 for what can't be read.
    """
    from hil.recording.recording import RecordingError
    from hil.runs.run_folder import RECORDING
    from pkxyz_ctrl.config.controller import ControllerConfig
    from pkxyz_ctrl.config.files import load
    from pkxyz_ctrl.design.model.design_error import DesignError

    other = None if controller is None else load("controllers", controller, ControllerConfig)
    try:
        result = _with_progress(folder / RECORDING, other, quiet=as_json)
    except (RecordingError, DesignError, OSError) as error:
        print(f"pkxyz: {error}", file=sys.stderr)
        raise typer.Exit(2) from None
    if as_json:
        print(json.dumps(_as_json(result, folder), allow_nan=False))
    else:
        _show(result)
    raise typer.Exit(0 if result.sound else 1)


def _with_progress(path: Path, controller: "ControllerConfig | None", *, quiet: bool) -> "Replay":
    from hil.runs.replay import replay as played

    with progress_bar(f"replaying {path.parent.name}", quiet=quiet) as tell:
        return played(path, controller, tell)


def _as_json(result: "Replay", folder: Path) -> dict[str, object]:
    def number(value: float) -> float | str:
        return value if math.isfinite(value) else str(value)

    found = [
        {**dataclasses.asdict(d), "recorded": number(d.recorded), "replayed": number(d.replayed)}
        for d in result.differences
    ]
    return {
        "folder": str(folder),
        "ticks": result.ticks,
        "identical": result.identical,
        "sound": result.sound,
        "kept": result.kept,
        "damages": result.damages,
        "first_difference": found[0] if found else None,
        "differences": found,
        "notes": result.notes,
    }


def _show(result: "Replay") -> None:
    if result.identical:
        say(f"{result.ticks} ticks replayed, identical in every bit")
        if result.kept:
            say(f"as the run left them: {', '.join(result.kept)}")
    else:
        first = result.differences[0]
        say(
            f"first difference: tick {first.tick}, at {first.t_us * 1e-6:.6f} s, {first.signal}: recorded "
            f"{first.recorded!r}, replayed {first.replayed!r}",
        )
        table = plain_table("signal", "from tick", "ticks", "recorded", "replayed")
        for d in result.differences[:_SHOWN]:
            table.add_row(d.signal, str(d.tick), str(d.ticks), f"{d.recorded:.9g}", f"{d.replayed:.9g}")
        screen().print(table)
        left = len(result.differences) - _SHOWN
        say(f"{f'and {left} signals more; ' if left > 0 else ''}{result.ticks} ticks replayed")
    for line in result.damages:
        say(f"but {line}")
    for note in result.notes:
        say(f"note: {note}")

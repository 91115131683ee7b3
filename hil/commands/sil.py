"""``pkxyz sil``: the loop closed on a scenario, in one process."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.commands.run import learning_of
from hil.lanes.lane import Lane
from hil.pictures.drawing_process import DrawingProcess
from hil.screen.choices import InProcessLane, require_simulated
from hil.screen.figures import error_lines, lacking_lines, where_to_read
from hil.screen.first_run import say_if_compiling
from hil.screen.options import (
    Adapted,
    Apply,
    ChosenLane,
    Faults,
    FileInstead,
    Learn,
    Refresh,
    ReplaceEarlier,
    ScenarioName,
    SeedInstead,
    SummaryAsJson,
)
from hil.screen.progress import progress_bar
from hil.screen.terminal import bad, faint, good, plain_table, say, screen
from pkxyz_ctrl.config.files import ConfigError, find

if TYPE_CHECKING:
    from hil.runs.scenario import Scenario
    from hil.runs.summary import Summary


def sil(
    scenario: ScenarioName = "raster",
    in_process: ChosenLane = InProcessLane.LOCKSTEP,
    seed: SeedInstead = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write; default: runs/<scenario>-<lane>-<n>.")] = None,
    stage: FileInstead = None,
    plant: FileInstead = None,
    controller: FileInstead = None,
    bus: FileInstead = None,
    fault: Faults = None,
    learn: Learn = False,
    apply: Apply = None,
    refresh: Refresh = None,
    adapted: Adapted = None,
    replace_earlier: ReplaceEarlier = False,
    as_json: SummaryAsJson = False,
) -> None:
    """Close the loop on a scenario; exit code 0 if its checks hold, 1 if not,
    2 for bad input or a full disk, 130 if interrupted.
    """
    lane = Lane(in_process.value)
    find("scenarios", scenario)  # a typo is said before anything is compiled
    with DrawingProcess() as pictures:
        say_if_compiling(quiet=as_json)
        from hil.faults.fault import parse
        from hil.runs.run_folder import next_free
        from hil.runs.scenario import load_scenario

        faults = [parse(text) for text in fault or ()]
        learning = learning_of(learn, apply, refresh)
        loaded = load_scenario(
            scenario, seed=seed, stage=stage, plant=plant, controller=controller, bus=bus, faults=faults,
            learning=learning, adapted=adapted,
        )  # fmt: skip
        require_simulated(loaded.bus, "sil")
        path = out if out is not None else next_free(Path("runs"), loaded.config.name, lane)
        summary = _ran(loaded, lane, path, replace_earlier, pictures, quiet=as_json)
    if as_json:
        print(json.dumps(summary.as_json() | {"folder": str(path)}, allow_nan=False))
    else:
        show(summary, path)
    raise typer.Exit(130 if summary.interrupted else 0 if summary.ok else 1)


def _ran(
    loaded: "Scenario", lane: Lane, path: Path, replace_earlier: bool, pictures: DrawingProcess, *, quiet: bool
) -> "Summary":
    """The run into its folder, with its picture."""
    from hil.api.run import run
    from hil.recording.recording import RecordingError
    from pkxyz_ctrl.design.model.design_error import DesignError
    from pkxyz_ctrl.loop.controller import StartUpError

    try:
        with progress_bar(f"{loaded.config.name}, {lane} lane", quiet=quiet) as tell:
            done = run(loaded, lane=lane, out=path, replace=replace_earlier, draw=pictures.draw, on_progress=tell)
    except RecordingError as error:
        raise ConfigError(str(error)) from None
    except (StartUpError, DesignError) as error:
        print(f"pkxyz: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    assert done.figures is not None, "it was run here"
    return done.figures


def show(summary: "Summary", folder: Path) -> None:
    """What came of a run, and where it is."""
    from hil.runs.metrics import bound_words

    table = plain_table("check", "value", "bound", "", left=("",))
    for check in summary.checks:
        value = "none" if check.value is None else f"{check.value:.4g}"
        verdict = {True: good("holds"), False: bad("fails"), None: faint("no bus")}[check.ok]
        table.add_row(check.name, value, bound_words(check), verdict)
    speed = summary.loop.realtime_factor
    rate = f", {speed:.1f} times real time" if speed is not None else ""
    say(f"{summary.scenario}, {summary.lane} lane, seed {summary.seed}: {summary.rows.ticks} ticks{rate}")
    screen().print(table)
    loop = summary.loop
    for line in (*error_lines(summary.rows, loop.errors_are_of), *lacking_lines(loop.protections_lacking)):
        say(line)
    for fault in summary.loop.faults:
        say(bad("fault"), f": {fault}")
    if (where := where_to_read(summary.loop.faults)) is not None:
        say(faint(where))
    if summary.interrupted:
        say("interrupted: what was recorded until then is kept")
    say(f"recording, frame log, config, summary and picture are in {folder}/")

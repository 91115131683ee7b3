"""``pkxyz run`` and ``pkxyz plant``: controller and plant at the machine's pace, each in a process of its own."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.screen.errors import amplifier_errors
from hil.screen.figures import error_lines, lacking_lines, loss_lines, where_to_read
from hil.screen.first_run import say_if_compiling
from hil.screen.options import (
    Adapted,
    Apply,
    AsJson,
    FileInstead,
    Learn,
    Refresh,
    ReplaceEarlier,
    Report,
    ScenarioName,
    SeedInstead,
)
from hil.screen.terminal import note
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.config.refused import reason
from pkxyz_ctrl.io.quick_can import load_can_quickly

if TYPE_CHECKING:
    from hil.runs.summary import Summary
    from pkxyz_ctrl.config.bus import CanConfig

Bus = Annotated[
    str | None,
    typer.Option(
        help="Name or file of the bus to meet on, instead of the scenario's. Where that is simulated: unix_2k, in "
        "a time that waits for the computer."
    ),
]
Native = Annotated[
    bool, typer.Option("--native", help="By the loop in C, compiled here the first time, instead of Python's.")
]
_MEETING_BUS = "unix_2k"


def run(
    scenario: ScenarioName = "raster",
    bus: Bus = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write; default: runs/<scenario>-wall-<n>.")] = None,
    stage: FileInstead = None,
    controller: FileInstead = None,
    duration_s: Annotated[float | None, typer.Option("--seconds", help="Instead of the scenario's.")] = None,
    learn: Learn = False,
    apply: Apply = None,
    refresh: Refresh = None,
    adapted: Adapted = None,
    replace_earlier: ReplaceEarlier = False,
    wait_s: Annotated[
        float, typer.Option("--wait", min=0, max=3600, help="Seconds until somebody else has to be on the bus.")
    ] = 30.0,
    report: Report = None,
    native: Native = False,
    as_json: AsJson = False,
) -> None:
    """Control an amplifier at rate; exit code 0 if the checks hold, 1 if not, 2 for bad input or a full disk, 128 +
    signal if ended.

    Ctrl-C, SIGTERM and errors leave the combs at 0 V. Errors of position are those of the estimate.
    """
    load_can_quickly()
    from hil.lanes.lane import Lane
    from hil.lanes.wall import require_real_bus
    from hil.pictures.run import draw
    from hil.recording.recording import RecordingError
    from hil.runs.at_rate import run_into
    from hil.runs.run_folder import RunFolder, next_free
    from hil.screen.live_status import LiveStatus
    from pkxyz_ctrl.design.model.design_error import DesignError

    learning = learning_of(learn, apply, refresh)
    require_seconds(duration_s)
    say_if_compiling(quiet=as_json)
    loaded = _met(scenario, stage=stage, controller=controller, bus=bus, learning=learning, adapted=adapted)
    loaded = _lasting(loaded, duration_s)
    can_config = require_real_bus(loaded.bus)
    if report is not None:
        from hil.conformance.proven import with_report

        loaded = dataclasses.replace(loaded, bus=with_report(loaded.bus, report))
    program = native_loop(loaded, can_config) if native else None
    live = LiveStatus(round(loaded.config.duration_s / loaded.bus.period_s), loaded.bus.period_s)
    path = out if out is not None else next_free(Path("runs"), loaded.config.name, Lane.WALL)
    folder = RunFolder(path, replace=replace_earlier)
    try:
        with amplifier_errors(loaded.bus, bus):
            ran = run_into(folder, loaded, note, _quiet if as_json else live, wait_s, program)
        draw(folder, ran.summary, ran.lateness_us)
    except RecordingError as error:
        raise ConfigError(str(error)) from None
    except DesignError as error:
        print(f"pkxyz: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    if as_json:
        print(json.dumps(ran.summary.as_json() | {"folder": str(folder.path)}, allow_nan=False))
    else:
        _show(ran.summary, folder.path)
    raise typer.Exit(128 + ran.ended_by if ran.ended_by else 0 if ran.summary.ok else 1)


def plant(
    scenario: Annotated[str, typer.Argument(help="The scenario whose stage, plant and seed to serve.")] = "raster",
    bus: Bus = None,
    plant: FileInstead = None,
    stage: FileInstead = None,
    seed: SeedInstead = None,
    truth: Annotated[
        Path | None, typer.Option(help="File for the truth at each sample, as rows of hil.lanes.wall_plant.TRUTH.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print each change as a line of JSON.")] = False,
) -> None:
    """Serve amplifier node and plant on a bus until Ctrl-C or SIGTERM."""
    from pkxyz_ctrl.compiled.quick_load import load_quickly

    load_quickly()
    load_can_quickly()
    from hil.lanes.ending import Ended, Ending
    from hil.lanes.wall import require_real_bus
    from hil.lanes.wall_plant import WallPlant, WitnessedPlant
    from pkxyz_ctrl.io.can_port import open_bus
    from pkxyz_ctrl.io.realtime import go_real_time, settle_memory

    loaded = _met(scenario, seed=seed, stage=stage, plant=plant, bus=bus)
    can_config = require_real_bus(loaded.bus)

    def show(t_s: float, state: str, driven: bool) -> None:
        if as_json:
            print(json.dumps({"t_s": t_s, "state": state, "driven": driven}), flush=True)
        else:
            print(f"{t_s:12.6f} s  {state}{', combs driven' if driven else ', 0 V'}", flush=True)

    try:
        with Ending() as ending, open_bus(can_config, loaded.bus.name) as opened:
            served = WallPlant(loaded.setup(), can_config, opened, show, truth)
            note(go_real_time())
            settle_memory()
            try:
                served.serve(ending.check)
            finally:
                if isinstance(served.plant, WitnessedPlant):
                    served.plant.close()
    except Ended:
        pass
    except OSError as error:
        if truth is None:
            raise
        raise ConfigError(f"--truth: {truth}: {reason(error)}") from None


def native_loop(loaded: Any, can_config: "CanConfig") -> Path:
    """The program, compiled if it isn't yet. Raises ``ConfigError`` for what it does not take, and without compiler."""
    from hil.native.program import compiled, kept
    from hil.native.settings import require_native
    from pkxyz_ctrl.export.kernels import ExportError

    require_native(loaded.setup(), can_config)
    try:
        if kept() is None:
            note(
                "the native loop is being compiled, once: some seconds, or some minutes if nothing was exported before"
            )
        return compiled()
    except ExportError as error:
        raise ConfigError(str(error)) from None


def learning_of(learn: bool, apply: str | None, refresh: str | None) -> dict[str, str] | None:
    """What the options say in place of a scenario's [learning]; None if none is given."""
    asked: list[dict[str, str]] = [{"mode": "learn"}] if learn else []
    asked += [{"mode": mode, "file": f} for mode, f in (("apply", apply), ("refresh", refresh)) if f is not None]
    if len(asked) > 1:
        raise ConfigError("--learn, --apply and --refresh: give one of them")
    return asked[0] if asked else None


def _met(scenario: str, **instead: Any) -> Any:
    """The scenario on the bus that was given, else on its own, unless that is simulated and ends with its process: then
    on one between processes, in a time that waits for the computer.
    """
    from hil.lanes.standstill import waiting
    from hil.runs.scenario import load_scenario

    loaded = load_scenario(scenario, **instead)
    can_config = loaded.bus.can
    if instead["bus"] is not None or (can_config is not None and can_config.interface != "pkxyz-sim"):
        return loaded
    note(
        f"the scenario's bus, {loaded.bus.name}, is simulated; meeting on {_MEETING_BUS}, in a time that waits for "
        f"this computer: both with --bus {_MEETING_BUS}, or another, for real time"
    )
    met = load_scenario(scenario, **instead | {"bus": _MEETING_BUS})
    return dataclasses.replace(met, bus=waiting(met.bus))


def require_seconds(duration_s: float | None) -> None:
    """Raise ``ConfigError`` for what is no duration of a run."""
    if duration_s is not None and not 0 < duration_s <= 36_000:
        raise ConfigError(f"--seconds: {duration_s:g} is not in 0..36000")


def _lasting(loaded: Any, duration_s: float | None) -> Any:
    if duration_s is None:
        return loaded
    return dataclasses.replace(loaded, config=loaded.config.model_copy(update={"duration_s": duration_s}))


def _quiet(row: object) -> None:
    """Say nothing of a row."""


def _show(summary: "Summary", folder: Path) -> None:
    rows, loop = summary.rows, summary.loop
    late, answer = (of or {"p50": 0, "p99_9": 0, "max": 0} for of in (loop.lateness_us, loop.answer_us))
    print(
        f"{summary.scenario} on {summary.bus}: {rows.ticks} ticks, {loop.missed_ticks} missed, woken "
        f"{late['p50']} us late in the middle, {late['p99_9']} us at p99.9, {late['max']} us at most"
    )
    print(f"sense frames answered in {answer['p50']} us, {answer['p99_9']} us at p99.9, {answer['max']} us at most")
    if loop.stood_still_s:
        print(f"time stood still for {loop.stood_still_s:.3g} s, as a simulated stage waits for the computer")
    said = (*error_lines(rows, loop.errors_are_of), *lacking_lines(loop.protections_lacking), *loss_lines(loop))
    for line in said:
        print(line)
    for check in summary.checks:
        if check.ok is False:
            print(f"check fails: {check.name} = {check.value}")
    for fault in loop.faults:
        print(f"fault: {fault}")
    if (where := where_to_read(loop.faults)) is not None:
        print(where)
    if summary.interrupted:
        print("ended from outside: what was recorded until then is kept")
    print(f"recording, frame log, config, summary and picture are in {folder}/")

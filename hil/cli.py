"""The command ``pkxyz``. Everything heavy is imported by the command that needs it."""

import itertools
import json
import os
import signal
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.table import Table

from hil.commands import bench as bench_cli
from hil.commands import check_amplifier as check_amplifier_cli
from hil.commands import compare as compare_cli
from hil.commands import dbc as dbc_cli
from hil.commands import faults as faults_cli
from hil.commands import identify as identify_cli
from hil.commands import latency as latency_cli
from hil.commands import margins as margins_cli
from hil.commands import mechanics as mechanics_cli
from hil.commands import montecarlo as montecarlo_cli
from hil.commands import new as new_cli
from hil.commands import replay as replay_cli
from hil.commands import run as run_cli
from hil.commands import soak as soak_cli
from hil.commands import tune as tune_cli
from hil.lanes.lane import Lane
from hil.screen.choices import InProcessLane
from hil.screen.first_run import say_if_compiling
from hil.screen.outputs import what_to_do
from hil.screen.tables import error_lines, print_whole
from pkxyz_ctrl.compiled.kernel_cache import forget_damaged
from pkxyz_ctrl.config.files import CONFIG_DIR, ConfigError, find, names

if TYPE_CHECKING:
    from hil.runs.summary import Summary

app = typer.Typer(
    help="Real-time controller of a parallel-kinematics XYZ MEMS stage, and the harness that proves it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_screen = Console(highlight=False)
_notes = Console(stderr=True, highlight=False)

KINDS = ("scenarios", "stages", "plants", "controllers", "buses", "tolerances", "searches")
"""Folders of configs/, as ``pkxyz configs`` lists them."""


def main() -> NoReturn:
    """Entry point: runs the command line and turns what can go wrong into one line each and an exit code."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads would only wait for each other
    code = 0
    try:
        command = typer.main.get_command(app)
        with command.make_context("pkxyz", sys.argv[1:] or ["--help"]) as context:
            command.invoke(context)
        sys.stdout.flush()
    except typer.Exit as done:
        code = done.exit_code
    except ConfigError as error:
        _fail(str(error))
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 128 + signal.SIGPIPE
    except BaseException as error:
        if _was_interrupted(error):
            _notes.print("interrupted")
            sys.exit(130)
        if isinstance(error, OSError) and (line := what_to_do(error)) is not None:
            _fail(line)
        if (line := forget_damaged(error)) is not None:
            _fail(line)
        if (message := getattr(error, "format_message", None)) is None:
            raise
        _fail(f"{message().replace('Value error, ', '')} (see --help)")  # wrong usage, in the words of the parser
    sys.exit(code)


def _was_interrupted(error: BaseException | None) -> bool:
    """Ctrl-C, also where a library that was being imported made another error of it."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _fail(message: str) -> NoReturn:
    for line in message.splitlines():
        print(f"pkxyz: {line}", file=sys.stderr)
    sys.exit(2)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"pkxyz {version('pkxyz-ctrl')}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def sil(
    scenario: Annotated[str, typer.Argument(help="A shipped scenario's name or a TOML file.")] = "raster",
    in_process: Annotated[
        InProcessLane, typer.Option("--lane", help="lockstep: over the simulated bus; fast: compiled, no frames.")
    ] = InProcessLane.LOCKSTEP,
    seed: Annotated[int | None, typer.Option(help="Instead of the scenario's.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write; default: runs/<scenario>-<lane>-<n>.")] = None,
    stage: Annotated[str | None, typer.Option(help="Name or file, instead of the scenario's.")] = None,
    plant: Annotated[str | None, typer.Option(help="Name or file, instead of the scenario's.")] = None,
    controller: Annotated[str | None, typer.Option(help="Name or file, instead of the scenario's.")] = None,
    bus: Annotated[str | None, typer.Option(help="Name or file, instead of the scenario's.")] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="TARGET:KIND@S[+S][,NAME=VALUE]", help="Such as sense.2:stuck@0.3+0.05; may be repeated."),
    ] = None,
    learn: run_cli.Learn = False,
    replay: run_cli.Replay = None,
    refresh: run_cli.Refresh = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON, and nothing else.")] = False,
) -> None:
    """Close the loop on a scenario; exit code 0 if its checks hold, 1 if not, 2 for bad input or a full disk, 130 if
    interrupted.
    """
    lane = Lane(in_process.value)
    find("scenarios", scenario)  # a typo is said before anything is compiled
    say_if_compiling(quiet=as_json)
    from hil.faults.fault import parse
    from hil.runs.scenario import load_scenario

    faults = [parse(text) for text in fault or ()]
    learning = run_cli.learning_of(learn, replay, refresh)
    loaded = load_scenario(
        scenario, seed=seed, stage=stage, plant=plant, controller=controller, bus=bus, faults=faults, learning=learning
    )
    from hil.pictures.run import draw
    from hil.recording.recording import RecordingError
    from hil.runs.run import require_bus
    from hil.runs.run_folder import RunFolder, next_free
    from pkxyz_ctrl.design.model.design_error import DesignError
    from pkxyz_ctrl.loop.controller import StartUpError

    require_bus(loaded, lane)
    folder = RunFolder(out if out is not None else next_free(Path("runs"), loaded.config.name, lane))
    try:
        summary = _run_with_progress(folder, loaded, lane, quiet=as_json)
        draw(folder, summary)
    except RecordingError as error:
        raise ConfigError(str(error)) from None
    except (StartUpError, DesignError) as error:
        print(f"pkxyz: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    if as_json:
        print(json.dumps(summary.as_json() | {"folder": str(folder.path)}, allow_nan=False))
    else:
        _show(summary, folder.path)
    raise typer.Exit(130 if summary.interrupted else 0 if summary.ok else 1)


def configs(as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """List the shipped configurations, with the folder of each kind: NAME is the file NAME.toml in it."""
    found = {kind: {name: _description(CONFIG_DIR / kind / f"{name}.toml") for name in names(kind)} for kind in KINDS}
    if as_json:
        print(json.dumps(found))
        return
    table = Table(box=None, pad_edge=False, show_header=False)
    for kind, entries in found.items():
        table.add_row(f"[bold]{kind}[/]", f"[dim]{CONFIG_DIR / kind}/[/]")
        for name, words in entries.items():
            table.add_row(f"  {name}", words)
    print_whole(_screen, table)


_COMMANDS: tuple[tuple[str, Callable[..., None], str], ...] = (
    ("sil", sil, "Close the loop on a scenario, in one process."),
    ("compare", compare_cli.compare, "All laws on one scenario and plant."),
    ("margins", margins_cli.margins, "How far a law is from instability."),
    ("identify", identify_cli.identify, "Measure the stage in its running loop."),
    ("tune", tune_cli.tune, "Better numbers for a controller file."),
    ("montecarlo", montecarlo_cli.montecarlo, "A law against many drawn plants."),
    ("faults", faults_cli.faults, "Break everything once, under each law."),
    ("soak", soak_cli.soak, "Half an hour under random faults."),
    ("replay", replay_cli.replay, "A recording once more through the tick."),
    ("run", run_cli.run, "Control an amplifier at rate."),
    ("plant", run_cli.plant, "Serve amplifier and plant for run."),
    ("check-amplifier", check_amplifier_cli.check_amplifier, "May this amplifier be enabled?"),
    ("dbc", dbc_cli.dbc, "The DBC of a bus, for CAN tools."),
    ("latency", latency_cli.latency, "How late this machine wakes up."),
    ("paper", mechanics_cli.paper, "The paper's numbers beside ours."),
    ("workspace", mechanics_cli.workspace, "What the platform reaches and can hold."),
    ("design", mechanics_cli.design, "Dimensions from requirements."),
    ("linearisation", mechanics_cli.linearisation, "What one constant Jacobian costs."),
    ("configs", configs, "What is shipped, and where."),
    ("new", new_cli.new, "A commented file to start from."),
    ("bench", bench_cli.bench, "What is promised, measured."),
)
for _name, _command, _words in _COMMANDS:
    app.command(_name, short_help=_words)(_command)


def _run_with_progress(folder: Any, scenario: Any, lane: Lane, *, quiet: bool) -> "Summary":
    from hil.runs.run import run_into

    if quiet or not _notes.is_terminal:
        return run_into(folder, scenario, lane)
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=_notes, transient=True) as progress:
        task = progress.add_task(f"{scenario.config.name}, {lane} lane", total=None)
        return run_into(folder, scenario, lane, lambda done, total: progress.update(task, completed=done, total=total))


def _show(summary: "Summary", folder: Path) -> None:
    from hil.pictures.report import bound_words

    table = Table(box=None, pad_edge=False, header_style="dim")
    for heading, side in (("check", "left"), ("value", "right"), ("bound", "right"), ("", "left")):
        table.add_column(heading, justify=side)  # type: ignore[arg-type]
    for check in summary.checks:
        value = "none" if check.value is None else f"{check.value:.4g}"
        verdict = {True: "[green]holds[/]", False: "[bold red]fails[/]", None: "[dim]no bus[/]"}[check.ok]
        table.add_row(check.name, value, bound_words(check), verdict)
    speed = summary.loop.realtime_factor
    pace = f", {speed:.1f} times real time" if speed is not None else ""
    _screen.print(f"{summary.scenario}, {summary.lane} lane, seed {summary.seed}: {summary.rows.ticks} ticks{pace}")
    _screen.print(table)
    for line in error_lines(summary.rows, summary.loop.errors_are_of):
        _screen.print(line)
    for fault in summary.loop.faults:
        _screen.print(f"[red]fault[/]: {fault}", markup=True)
    if summary.interrupted:
        _screen.print("interrupted: what was recorded until then is kept")
    _screen.print(f"recording, frame log, config, summary and picture are in {folder}/", soft_wrap=True)


def _description(path: Path) -> str:
    """One line about a configuration: its ``description``, else the first sentence of its opening comment."""
    text = path.read_text(encoding="utf-8")
    described = tomllib.loads(text).get("description")
    if isinstance(described, str):
        return described
    comment = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    words = " ".join(line.lstrip("# ").strip() for line in comment)
    return words.partition(". ")[0].rstrip(".")


if __name__ == "__main__":
    main()

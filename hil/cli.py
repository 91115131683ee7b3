"""The command ``pkxyz``. Everything heavy is imported by the command that needs it."""

import itertools
import json
import os
import sys
import tomllib
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.table import Table

from hil import (
    bench_cli,
    check_amplifier_cli,
    compare_cli,
    faults_cli,
    identify_cli,
    latency_cli,
    margins_cli,
    mechanics_cli,
    montecarlo_cli,
    replay_cli,
    run_cli,
    soak_cli,
    tune_cli,
)
from hil.choices import Lane
from pkxyz_ctrl.config import CONFIG_DIR, ConfigError, names

app = typer.Typer(
    help="Real-time controller of a parallel-kinematics XYZ MEMS stage, and the harness that proves it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
_screen = Console(highlight=False)
_notes = Console(stderr=True, highlight=False)

KINDS = ("scenarios", "stages", "plants", "controllers", "buses", "tolerances", "searches")
"""Folders of configs/, as ``pkxyz configs`` lists them."""


def main() -> NoReturn:
    """Entry point: runs the command line and turns what can go wrong into one line each and an exit code."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads would only wait for each other
    try:
        code = app(standalone_mode=False)  # what typer.Exit said, or the command's None
    except ConfigError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        _notes.print("interrupted")
        sys.exit(130)
    except Exception as error:
        if (message := getattr(error, "format_message", None)) is None:
            raise
        _fail(f"{message().replace('Value error, ', '')} (see --help)")  # wrong usage, in the words of the parser
    sys.exit(code)


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
    lane: Annotated[
        Lane, typer.Option(help="lockstep: over the simulated bus; fast: compiled, no frames.")
    ] = Lane.LOCKSTEP,
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
    _say_if_compiling(quiet=as_json)
    from hil.faults.fault import parse
    from hil.scenario import load_scenario

    faults = [parse(text) for text in fault or ()]
    learning = run_cli.learning_of(learn, replay, refresh)
    loaded = load_scenario(
        scenario, seed=seed, stage=stage, plant=plant, controller=controller, bus=bus, faults=faults, learning=learning
    )
    from hil.recording import RecordingError
    from hil.run_folder import RunFolder, next_free
    from hil.sil import draw, require_bus
    from pkxyz_ctrl.controller import StartUpError
    from pkxyz_ctrl.design.design_error import DesignError

    require_bus(loaded, lane.value)
    folder = RunFolder(out if out is not None else next_free(Path("runs"), loaded.config.name, lane.value))
    try:
        summary = _run_with_progress(folder, loaded, lane.value, quiet=as_json)
        draw(folder, summary)
    except RecordingError as error:
        raise ConfigError(str(error)) from None
    except (StartUpError, DesignError) as error:
        print(f"pkxyz: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    if as_json:
        print(json.dumps(summary | {"folder": str(folder.path)}, allow_nan=False))
    else:
        _show(summary, folder.path)
    raise typer.Exit(130 if summary["interrupted"] else 0 if summary["ok"] else 1)


def configs(as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """List the shipped configurations."""
    found = {kind: {name: _description(CONFIG_DIR / kind / f"{name}.toml") for name in names(kind)} for kind in KINDS}
    if as_json:
        print(json.dumps(found))
        return
    table = Table(box=None, pad_edge=False, show_header=False)
    for kind, entries in found.items():
        table.add_row(f"[bold]{kind}[/]")
        for name, words in entries.items():
            table.add_row(f"  {name}", words)
    _screen.print(table)


app.command("sil")(sil)
app.command("configs")(configs)
app.command("run")(run_cli.run)
app.command("plant")(run_cli.plant)
app.command("replay")(replay_cli.replay)
app.command("latency")(latency_cli.latency)
app.command("margins")(margins_cli.margins)
app.command("montecarlo")(montecarlo_cli.montecarlo)
app.command("tune")(tune_cli.tune)
app.command("compare")(compare_cli.compare)
app.command("identify")(identify_cli.identify)
app.command("paper")(mechanics_cli.paper)
app.command("workspace")(mechanics_cli.workspace)
app.command("design")(mechanics_cli.design)
app.command("linearisation")(mechanics_cli.linearisation)
app.command("check-amplifier")(check_amplifier_cli.check_amplifier)
app.command("bench")(bench_cli.bench)
app.command("faults")(faults_cli.faults)
app.command("soak")(soak_cli.soak)


def _run_with_progress(folder: Any, scenario: Any, lane: str, *, quiet: bool) -> dict[str, Any]:
    from hil.sil import run_into

    if quiet or not _notes.is_terminal:
        return run_into(folder, scenario, lane, lambda done, total: None)
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


def _say_if_compiling(*, quiet: bool) -> None:
    """The first run compiles for a minute or so; nobody should think that it hangs."""
    from pkxyz_ctrl.cycle import cycle

    cache = getattr(cycle, "_cache", None)  # absent when the compiler is switched off
    if not quiet and cache is not None and not any(Path(cache.cache_path).glob("cycle.cycle-*.nbi")):
        _notes.print("First run here: compiling the kernels, which takes a minute or two. The next run starts at once.")


def _show(summary: dict[str, Any], folder: Path) -> None:
    from hil.report import bound_words

    table = Table(box=None, pad_edge=False, header_style="dim")
    for heading, side in (("check", "left"), ("value", "right"), ("bound", "right"), ("", "left")):
        table.add_column(heading, justify=side)  # type: ignore[arg-type]
    for check in summary["checks"]:
        value = "none" if check["value"] is None else f"{check['value']:.4g}"
        verdict = {True: "[green]holds[/]", False: "[bold red]fails[/]", None: "[dim]no bus[/]"}[check["ok"]]
        table.add_row(check["name"], value, bound_words(check), verdict)
    speed = summary.get("realtime_factor")
    pace = f", {speed:.1f} times real time" if speed is not None else ""
    _screen.print(
        f"{summary['scenario']}, {summary['lane']} lane, seed {summary['seed']}: {summary['ticks']} ticks{pace}"
    )
    _screen.print(table)
    for fault in summary.get("faults") or []:
        _screen.print(f"[red]fault[/]: {fault}", markup=True)
    if summary["interrupted"]:
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

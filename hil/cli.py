"""The command ``pkxyz``. Everything heavy is loaded with the command that needs it."""

import gc
import os
import signal
import sys
from typing import Annotated, NoReturn

import typer

from hil.screen.lazy_commands import HELP, group_of

COMMANDS = {
    "sil": ("hil.commands.sil:sil", "Close the loop on a scenario, in one process."),
    "compare": ("hil.commands.studies.compare:compare", "All laws on one scenario and plant."),
    "margins": ("hil.commands.studies.margins:margins", "How far a law is from instability."),
    "identify": ("hil.commands.studies.identify:identify", "Measure the stage in its running loop."),
    "tune": ("hil.commands.studies.tune:tune", "Better numbers for a controller file."),
    "montecarlo": ("hil.commands.studies.montecarlo:montecarlo", "A law against many sampled plants."),
    "yield": ("hil.commands.studies.wafer_yield:wafer_yield", "Which share of a wafer works, and why."),
    "faults": ("hil.commands.studies.faults:faults", "Break everything once, under each law."),
    "soak": ("hil.commands.studies.soak:soak", "Half an hour under random faults."),
    "replay": ("hil.commands.replay:replay", "A recording once more through the tick."),
    "recording": ("hil.commands.recording:recording", "A recording as CSV, MDF, HDF5 or a map."),
    "run": ("hil.commands.run:run", "Control an amplifier at rate."),
    "plant": ("hil.commands.run:plant", "Serve amplifier and plant for run."),
    "serve": ("hil.commands.operation.serve:serve", "Operate a stage: page and clients."),
    "demo": ("hil.commands.operation.demo:demo", "The page with a scan running."),
    "ask": ("hil.commands.operation.ask:ask", "Ask a stage in operation: move, stop, status."),
    "ioc": ("hil.commands.operation.instrument:ioc", "A stage in operation for EPICS."),
    "scpi": ("hil.commands.operation.instrument:scpi", "A stage in operation over TCP, by SCPI."),
    "operate": ("hil.commands.operation.operate:operate", "The loop that serve operates."),
    "check-amplifier": ("hil.commands.check_amplifier:check_amplifier", "May this amplifier be enabled?"),
    "export": ("hil.commands.export:export", "The controller as C for a board."),
    "emulate": ("hil.commands.emulate:emulate", "The loop with the board emulated."),
    "dbc": ("hil.commands.dbc:dbc", "The DBC of a bus, for CAN tools."),
    "latency": ("hil.commands.latency:latency", "How late this machine wakes up."),
    "explain": ("hil.commands.explain:explain", "A fault or emergency code in words."),
    "doctor": ("hil.commands.doctor:doctor", "What this machine has and lacks."),
    "paper": ("hil.commands.mechanics:paper", "The paper's numbers beside ours."),
    "workspace": ("hil.commands.mechanics:workspace", "What the platform reaches and can hold."),
    "design": ("hil.commands.mechanics:design", "Dimensions from requirements."),
    "linearisation": ("hil.commands.mechanics:linearisation", "What one constant Jacobian costs."),
    "configs": ("hil.commands.configs:configs", "What is shipped, and where."),
    "new": ("hil.commands.new:new", "A commented file to start from."),
    "bench": ("hil.commands.bench:bench", "What is promised, measured."),
}
"""By name: where it is, and what it is for."""

app = typer.Typer(
    cls=group_of(COMMANDS),
    help="Real-time controller of a parallel-kinematics XYZ MEMS stage, and the harness that proves it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings=HELP,
)


def main() -> NoReturn:
    """Entry point: runs the command line and turns what can go wrong into one line each and an exit code."""
    gc.set_threshold(
        50_000
    )  # thousands of classes come in, and none of them goes: looking for it is a tenth of a start
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads would only wait for each other
    code = 0
    try:
        command = typer.main.get_command(app)
        with command.make_context("pkxyz", sys.argv[1:] or ["--help"]) as context:
            command.invoke(context)
        sys.stdout.flush()
    except typer.Exit as done:
        code = done.exit_code
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 128 + signal.SIGPIPE
    except BaseException as error:
        from hil.screen.errors import told

        code = told(error)
    sys.exit(code)


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


if __name__ == "__main__":
    main()

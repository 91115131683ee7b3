"""``pkxyz emulate``: the loop closed with the firmware on an emulated board."""

import json
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.commands.sil import show
from hil.lanes.lane import Lane
from hil.pictures.drawing_process import DrawingProcess
from hil.screen.choices import require_simulated
from hil.screen.first_run import say_if_compiling
from hil.screen.options import Faults, FileInstead, ReplaceEarlier, ScenarioName, SeedInstead, SummaryAsJson
from hil.screen.progress import progress_bar
from hil.screen.terminal import say
from pkxyz_ctrl.config.files import ConfigError, find

if TYPE_CHECKING:
    from hil.emulator.rig import Emulation
    from hil.runs.scenario import Scenario
    from hil.runs.summary import Summary

_MHZ = 480


def emulate(
    scenario: ScenarioName = "raster",
    seed: SeedInstead = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write; default: runs/<scenario>-emulated-<n>.")] = None,
    stage: FileInstead = None,
    plant: FileInstead = None,
    controller: FileInstead = None,
    bus: FileInstead = None,
    fault: Faults = None,
    replace_earlier: ReplaceEarlier = False,
    as_json: SummaryAsJson = False,
) -> None:
    """Close the loop with the exported controller on an emulated Cortex-M7; bus, amplifier and plant are those of sil.

    Needs qemu-system-arm and arm-none-eabi-gcc. Exit code 0 if the checks hold, 1 if not, or if the board was ended, 2
    for bad input, a missing program or a full disk, 130 if interrupted.
    """
    from hil.emulator.image import require_programs

    find("scenarios", scenario)
    require_programs()
    with DrawingProcess() as pictures:
        say_if_compiling(quiet=as_json)
        from hil.faults.fault import parse
        from hil.runs.scenario import load_scenario

        faults = [parse(text) for text in fault or ()]
        loaded = load_scenario(
            scenario, seed=seed, stage=stage, plant=plant, controller=controller, bus=bus, faults=faults
        )
        require_simulated(loaded.bus, "emulate")
        summary, folder, emulation = _ran(loaded, out, replace_earlier, pictures, quiet=as_json)
    if as_json:
        print(json.dumps(summary.as_json() | {"folder": str(folder)}, allow_nan=False))
    else:
        show(summary, folder)
        _say_instructions(emulation)
    raise typer.Exit(130 if summary.interrupted else 0 if summary.ok else 1)


def _ran(
    loaded: "Scenario", out: Path | None, replace_earlier: bool, pictures: DrawingProcess, *, quiet: bool
) -> "tuple[Summary, Path, Emulation]":
    """The run into its folder, with its picture."""
    from hil.emulator.rig import Emulation
    from hil.recording.recording import RecordingError
    from hil.runs.run import require_bus, run_into
    from hil.runs.run_folder import RunFolder, next_free
    from pkxyz_ctrl.design.model.design_error import DesignError
    from pkxyz_ctrl.loop.controller import StartUpError

    require_bus(loaded, Lane.EMULATED)
    with tempfile.TemporaryDirectory(prefix="pkxyz-board-") as scratch:
        try:
            emulation = Emulation(loaded.setup(), Path(scratch))  # what can't go is said before anything is written
            path = out if out is not None else next_free(Path("runs"), loaded.config.name, Lane.EMULATED)
            folder = RunFolder(path, replace=replace_earlier)
            with progress_bar(f"{loaded.config.name}, emulated", quiet=quiet) as tell:
                summary = run_into(folder, loaded, Lane.EMULATED, tell, emulation.run)
            pictures.draw(folder, summary)
        except RecordingError as error:
            raise ConfigError(str(error)) from None
        except (StartUpError, DesignError) as error:
            print(f"pkxyz: {error}", file=sys.stderr)
            raise typer.Exit(1) from None
    return summary, folder.path, emulation


def _say_instructions(emulation: "Emulation") -> None:
    """Of the ticks in which the scan was tracked."""
    import numpy as np

    from pkxyz_ctrl.safety.modes import Mode

    taken = emulation.taken[emulation.taken["mode"] == Mode.TRACKING]
    if len(taken):
        middle, most = int(np.median(taken["period"])), int(taken["period"].max())
        say(
            f"instructions a tick while tracking: {middle} in the middle, {most} at most, frames and gate included; at "
            f"{_MHZ} MHz and one a cycle {most / _MHZ:.1f} us"
        )

"""``pkxyz export``: the controller as C for another processor."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.screen.first_run import say_if_compiling
from hil.screen.options import FileInstead, ScenarioName
from hil.screen.terminal import plain_table, say, screen
from pkxyz_ctrl.config.files import ConfigError, find
from pkxyz_ctrl.config.refused import reason

if TYPE_CHECKING:
    from hil.runs.scenario import Scenario
    from pkxyz_ctrl.export.folder import Exported

TEST_TICKS = 1000
"""Of the self-test: home, enable, and some track; a board's flash holds them."""


def export(
    scenario: ScenarioName = "raster",
    target: Annotated[
        str,
        typer.Option(help="host, linux (with a loop at rate), cortex-m7, cortex-m4, aarch64 or riscv32."),
    ] = "cortex-m7",
    out: Annotated[Path | None, typer.Option(help="Folder to write, new or empty; default: export/<target>.")] = None,
    stage: FileInstead = None,
    controller: FileInstead = None,
    bus: FileInstead = None,
    ticks: Annotated[
        int | None, typer.Option(min=TEST_TICKS, help="Rows of the reference that go with it; default: all.")
    ] = None,
) -> None:
    """Write a folder of C that runs this controller, with the same bits, on another processor: header, object, law and
    reference, a self-test, files for make and CMake. It needs nothing of Python. Exit code 2 for what can't go.
    """
    from pkxyz_ctrl.export.folder import require_exportable, target_of, write
    from pkxyz_ctrl.export.kernels import ExportError

    path = out if out is not None else Path("export") / target
    try:
        target_of(target)
        _refuse_foreign(path)
        find("scenarios", scenario)
        say_if_compiling(quiet=False)
        from hil.runs.scenario import load_scenario

        loaded = load_scenario(scenario, stage=stage, controller=controller, bus=bus)
        require_exportable(loaded.setup().law, target)
        beside = run_beside(loaded, ticks) if target_of(target).has_loop else ()
        manifest = write(path, target, exported_of(loaded, ticks)._replace(beside=beside))
    except ExportError as error:
        raise ConfigError(str(error)) from None
    except OSError as error:
        raise ConfigError(f"--out: {path}: {reason(error)}; give another folder") from None
    table = plain_table(target, "bytes", left=("",))
    for name, size in manifest["bytes"].items():
        table.add_row(name, str(size))
    screen().print(table)
    say(f"{path}/ builds with make or CMake, and its self-test says whether the bits are these; see its README.md")


def _refuse_foreign(path: Path) -> None:
    """Raise ``ConfigError`` for a folder in which there is something: it is said before anything is compiled."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ConfigError(f"--out: {path}: is not empty, and nothing is overwritten; give a new folder, or empty it")


def exported_of(loaded: "Scenario", ticks: int | None) -> "Exported":
    """What the controller goes by, so many rows of its path or all, and the calls of its first ticks in lockstep.

    Raises ``ConfigError`` for a bus without CAN.
    """
    from hil.lanes.blocks import PREVIEW_ROWS, Blocks
    from hil.lanes.lockstep import LockstepRig
    from hil.runs.scenario import resolve
    from pkxyz_ctrl.export.calls import RecordedController
    from pkxyz_ctrl.export.folder import Exported
    from pkxyz_ctrl.loop.reference import reference_rows

    setup = loaded.setup()
    if setup.bus.can is None:
        raise ConfigError(f"bus {setup.bus.name!r} has no [can], and all of an exported controller is about frames")
    rows = (setup.ticks if ticks is None else ticks) + PREVIEW_ROWS
    period_us = setup.bus.period_us
    reference = reference_rows(setup.trajectory.sample(0, rows, period_us))
    short = dataclasses.replace(setup, duration_s=TEST_TICKS * setup.bus.period_s, faults=())
    rig = LockstepRig(short, whole_ticks=False, controller=RecordedController)
    rig.run(Blocks(short.trajectory, period_us, short.ticks, lambda _: None, lambda *_: None, short.excitation))
    assert isinstance(rig.controller, RecordedController)
    names = loaded.config.name, loaded.controller.name
    return Exported(rig.controller.record, reference, rig.controller.calls, *names, resolve(loaded)["digest"])


def run_beside(loaded: "Scenario", ticks: int | None) -> tuple[tuple[str, bytes], ...]:
    """What the loop at rate goes by, and the folder that it fills. Raises ``ConfigError`` for what it does not take."""
    import tempfile

    from hil.lanes.lane import Lane
    from hil.lanes.wall import COMPANY_S, require_real_bus
    from hil.native.settings import require_native
    from hil.native.standalone import standalone
    from hil.recording.journal import JournalWriter, journal_of
    from hil.runs.run_folder import RunFolder, metadata_of

    can = require_real_bus(loaded.bus)
    if ticks is not None:
        lasting = min(loaded.config.duration_s, ticks * loaded.bus.period_s)
        loaded = dataclasses.replace(loaded, config=loaded.config.model_copy(update={"duration_s": lasting}))
    setup = loaded.setup()
    require_native(setup, can)
    with tempfile.TemporaryDirectory(prefix="pkxyz-export-") as scratch:
        folder = RunFolder(Path(scratch) / "run")
        resolved = folder.write_config(loaded)
        JournalWriter(journal_of(folder.recording), metadata_of(loaded, Lane.WALL, resolved)).close()
        left = tuple((f"run/{path.name}", path.read_bytes()) for path in sorted(folder.path.iterdir()))
    return (("loop.bin", standalone(setup, can, COMPANY_S)), *left)

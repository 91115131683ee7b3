"""``pkxyz export``: the controller as C for another processor."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.screen.first_run import say_if_compiling
from hil.screen.terminal import plain_table, say, screen
from pkxyz_ctrl.config.files import ConfigError, find
from pkxyz_ctrl.config.refused import reason

if TYPE_CHECKING:
    from hil.runs.scenario import Scenario
    from pkxyz_ctrl.export.folder import Exported

TEST_TICKS = 1000
"""Of the self-test: home, enable, and some track; a board's flash holds them."""


def export(
    scenario: Annotated[str, typer.Argument(help="A shipped scenario's name or a TOML file.")] = "raster",
    target: Annotated[
        str, typer.Option(help="The processor: host, cortex-m7, cortex-m4, aarch64 or riscv32.")
    ] = "cortex-m7",
    out: Annotated[Path | None, typer.Option(help="Folder to write, new or empty; default: export/<target>.")] = None,
    stage: Annotated[str | None, typer.Option(help="Name or file, instead of the scenario's.")] = None,
    controller: Annotated[str | None, typer.Option(help="Name or file, instead of the scenario's.")] = None,
    bus: Annotated[str | None, typer.Option(help="Name or file, instead of the scenario's.")] = None,
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
        require_exportable(loaded.setup().law, loaded.controller.name, target)
        manifest = write(path, target, _exported(loaded, ticks))
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


def _exported(loaded: "Scenario", ticks: int | None) -> "Exported":
    """The law, as many rows of its path, and what a closed loop measured in its first ticks."""
    import dataclasses

    import numpy as np

    from hil.lanes.blocks import PREVIEW_ROWS
    from hil.lanes.in_process import run
    from hil.lanes.lane import Lane
    from hil.runs.scenario import resolve
    from pkxyz_ctrl.can.driver_config import DriverConfig
    from pkxyz_ctrl.export.folder import Exported
    from pkxyz_ctrl.export.wire import wire_record
    from pkxyz_ctrl.loop.cycle import INPUT
    from pkxyz_ctrl.loop.reference import reference_rows

    setup = loaded.setup()
    rows = (setup.ticks if ticks is None else ticks) + PREVIEW_ROWS
    period_us = setup.bus.period_us
    reference = reference_rows(setup.trajectory.sample(0, rows, period_us))
    counts: list[np.ndarray] = []
    short = dataclasses.replace(setup, duration_s=TEST_TICKS * setup.bus.period_s)
    run(short, Lane.FAST, on_block=lambda block: counts.append(block["sense_count"].copy()))
    inputs = np.zeros(TEST_TICKS, INPUT)
    inputs["sense_count"] = np.concatenate(counts)
    names = loaded.config.name, loaded.controller.name
    can = setup.bus.can
    wire = wire_record(setup.gate, DriverConfig() if can is None else can.driver)
    return Exported(setup.law, wire, reference, inputs, *names, resolve(loaded)["digest"])

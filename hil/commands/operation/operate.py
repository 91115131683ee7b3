"""``pkxyz operate``: the loop of a stage in operation, without a server."""

import sys
from typing import TYPE_CHECKING, Literal

import typer

from hil.screen.options import BusFile, ControllerFile, NativeLoop, OnSilence, Report, SilentFor, StageCalled, StageFile
from hil.screen.terminal import note
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.io.quick_can import load_can_quickly

if TYPE_CHECKING:
    from pathlib import Path

    from hil.lanes.setup import Setup


def operate(
    bus: BusFile = "unix_2k",
    stage: StageFile = "reconstructed",
    controller: ControllerFile = "youla",
    name: StageCalled = "stage",
    on_silence: OnSilence = "hold",
    report: Report = None,
    silence_s: SilentFor = 0.06,
    native: NativeLoop = None,
) -> None:
    """Run the loop of a stage that `pkxyz serve` operates, until Ctrl-C or SIGTERM; at its end the combs are at 0 V."""
    from pkxyz_ctrl.compiled.quick_load import load_quickly

    load_quickly()
    load_can_quickly()
    from hil.lanes.setup import bare_setup
    from hil.operate.running.at_rate import operate as run_loop
    from hil.operate.running.native import operate_natively
    from hil.operate.settings import Settings
    from pkxyz_ctrl.config.bus import BusConfig
    from pkxyz_ctrl.config.controller import ControllerConfig
    from pkxyz_ctrl.config.files import load
    from pkxyz_ctrl.loop.controller import StartUpError

    settings = Settings(on_silence=_silence(on_silence), silence_s=silence_s)
    config = load("buses", bus, BusConfig)
    if report is not None:
        from hil.conformance.proven import with_report

        config = with_report(config, report)
    law = load("controllers", controller, ControllerConfig)
    setup = bare_setup(stage, "nominal", law, config, 1, autostart=False)
    files = {"stage": stage, "controller": controller, "bus": bus}
    program = _program(setup, native) if native is not False else None
    try:
        if program is not None:
            note("the loop is the native one, in C")
            raise typer.Exit(operate_natively(program, setup, settings, name, files, note))
        run_loop(setup, settings, name, files, note)
    except StartUpError as error:
        print(f"pkxyz: {error}", file=sys.stderr)
        raise typer.Exit(1) from None


def _program(setup: "Setup", native: bool | None) -> "Path | None":
    """The native loop, if it is there or is asked for, which compiles it; else None, with a line that says why."""
    from hil.lanes.wall import require_real_bus
    from hil.native.program import compiled, kept
    from hil.native.settings import require_native
    from pkxyz_ctrl.export.kernels import ExportError

    try:
        require_native(setup, require_real_bus(setup.bus))
        if kept() is None and not native:
            note("the loop is Python's; `--native` compiles the one in C, which takes some minutes once")
            return None
        if kept() is None:
            note("the native loop is being compiled, once: some seconds, or minutes if nothing was exported before")
        return compiled()
    except (ConfigError, ExportError) as error:
        if native:
            raise ConfigError(str(error)) from None
        note(f"the loop is Python's, as the native one can't be had: {error}")
        return None


def _silence(value: str) -> Literal["hold", "park"]:
    if value == "park":
        return "park"
    if value == "hold":
        return "hold"
    raise ConfigError(f"--on-silence: {value!r} is neither hold nor park")

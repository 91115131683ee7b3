"""``pkxyz operate``: the loop of a stage in operation, without a server."""

import sys
from typing import Literal

import typer

from hil.screen.options import BusFile, ControllerFile, OnSilence, Report, SilentFor, StageCalled, StageFile
from hil.screen.terminal import note
from pkxyz_ctrl.config.files import ConfigError


def operate(
    bus: BusFile = "unix_2k",
    stage: StageFile = "reconstructed",
    controller: ControllerFile = "youla",
    name: StageCalled = "stage",
    on_silence: OnSilence = "hold",
    report: Report = None,
    silence_s: SilentFor = 0.06,
) -> None:
    """Run the loop of a stage that `pkxyz serve` operates, until Ctrl-C or SIGTERM; at its end the combs are at 0 V."""
    from hil.conformance.proven import with_report
    from hil.lanes.setup import bare_setup
    from hil.operate.running.at_rate import operate as run_loop
    from hil.operate.settings import Settings
    from pkxyz_ctrl.config.bus import BusConfig
    from pkxyz_ctrl.config.controller import ControllerConfig
    from pkxyz_ctrl.config.files import load
    from pkxyz_ctrl.loop.controller import StartUpError

    settings = Settings(on_silence=_silence(on_silence), silence_s=silence_s)
    config = load("buses", bus, BusConfig)
    if report is not None:
        config = with_report(config, report)
    law = load("controllers", controller, ControllerConfig)
    setup = bare_setup(stage, "nominal", law, config, 1, autostart=False)
    try:
        run_loop(setup, settings, name, {"stage": stage, "controller": controller, "bus": bus}, note)
    except StartUpError as error:
        print(f"pkxyz: {error}", file=sys.stderr)
        raise typer.Exit(1) from None


def _silence(value: str) -> Literal["hold", "park"]:
    if value == "park":
        return "park"
    if value == "hold":
        return "hold"
    raise ConfigError(f"--on-silence: {value!r} is neither hold nor park")

"""What can go wrong, told in one line: a loop that came to nothing, bad input, a disk that refuses, Ctrl-C."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

from hil.screen.outputs import what_to_do
from pkxyz_ctrl.compiled.kernel_cache import forget_damaged
from pkxyz_ctrl.config.files import ConfigError

if TYPE_CHECKING:
    from pkxyz_ctrl.config.bus import BusConfig


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Raise ``ConfigError`` with the words of a design, a law, a pose, a measurement or a fit that came to nothing."""
    from hil.studies.margins.excited import MeasurementError
    from pkxyz_ctrl.design.identification.modal_fit import FitError
    from pkxyz_ctrl.design.model.design_error import DesignError
    from pkxyz_ctrl.design.model.discrete_law import LawError
    from pkxyz_ctrl.stage import StageDomainError

    try:
        yield
    except (DesignError, FitError, LawError, MeasurementError, StageDomainError) as error:
        raise ConfigError(str(error)) from None


@contextmanager
def amplifier_errors(bus: "BusConfig", named: str | None) -> Iterator[None]:
    """End the command with a line where the amplifier doesn't start (exit code 1, with what to start on this machine,
    for the bus as the user ``named`` it), and with 128 + signal where somebody asked for the end.
    """
    from hil.lanes.ending import Ended
    from pkxyz_ctrl.loop.controller import StartUpError

    try:
        yield
    except StartUpError as error:
        on_this_machine = bus.can is not None and bus.can.interface == "pkxyz-unix"
        hint = f"; here the amplifier is another process: is `pkxyz plant --bus {named or bus.name}` running?"
        print(f"pkxyz: {error}{hint if on_this_machine else ''}", file=sys.stderr)
        raise typer.Exit(1) from None
    except Ended as end:
        raise typer.Exit(128 + end.signal_number) from None


def told(error: BaseException) -> int:
    """Say in a line on stderr how a command ended, and give its exit code. What is none of all this is raised again."""
    if was_interrupted(error):
        print("interrupted", file=sys.stderr)
        return 130
    line = str(error) if isinstance(error, ConfigError) else None
    if isinstance(error, OSError):
        line = what_to_do(error)
    if line is None:
        line = forget_damaged(error)
    if line is None and (message := getattr(error, "format_message", None)) is not None:
        line = f"{message().replace('Value error, ', '')} (see --help)"  # wrong usage, in the words of the parser
    if line is None:
        raise error
    for part in line.splitlines():
        print(f"pkxyz: {part}", file=sys.stderr)
    return 2


def was_interrupted(error: BaseException | None) -> bool:
    """Ctrl-C, also where a library that was being imported made another error of it."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None

"""What can go wrong, told in one line: a loop that came to nothing, bad input, a disk that refuses, Ctrl-C."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from hil.screen.outputs import what_to_do
from pkxyz_ctrl.compiled.kernel_cache import forget_damaged
from pkxyz_ctrl.config.files import ConfigError


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Raise ``ConfigError`` with the words of a design, a law, a pose, a measurement or a fit that came to nothing."""
    from hil.studies.margins.measured import MeasurementError
    from pkxyz_ctrl.design.identification.modal_fit import FitError
    from pkxyz_ctrl.design.model.design_error import DesignError
    from pkxyz_ctrl.design.model.discrete_law import LawError
    from pkxyz_ctrl.stage import StageDomainError

    try:
        yield
    except (DesignError, FitError, LawError, MeasurementError, StageDomainError) as error:
        raise ConfigError(str(error)) from None


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

"""What can go wrong with a loop that somebody asked for, told like bad input: in one line."""

from collections.abc import Iterator
from contextlib import contextmanager

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

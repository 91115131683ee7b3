"""Design a law for a stage and a bus, and ask how far it is from instability."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from hil.studies.margins.loop import ChangedPlants, Loop, over_changed_plants
from hil.studies.operating_point import operating_strokes
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, load, plain, write_toml
from pkxyz_ctrl.design.law_store import law_of
from pkxyz_ctrl.design.margins.margins import LoopResponse, Margins
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.design.model.discrete_law import LawError
from pkxyz_ctrl.stage import Stage

if TYPE_CHECKING:
    import control

Point = tuple[float, float, float]


@dataclass(frozen=True)
class DesignedLaw:
    """A law as the loop runs it, with the stage and the bus that it was designed for."""

    stage: Stage
    controller: ControllerConfig
    bus: BusConfig
    loop: Loop

    @property
    def record(self) -> NDArray[np.void]:
        """(1,) of ``pkxyz_ctrl.loop.cycle.LAW``: all numbers that the compiled cycle works on; read-only."""
        return self.loop.law

    def margins(self, at_um: Point | None = None) -> Margins:
        """Gain, phase, delay and disk margins, Ms and the -3 dB bandwidth of rejection, per axis and MIMO.

        ``at_um``: strokes of the three combs; by default mid-workspace. Raises ``ConfigError`` for a point that the
        combs can't hold.
        """
        return self.loop.margins(operating_strokes(self.stage, at_um))

    def response(self, frequency_hz: Sequence[float], at_um: Point | None = None) -> LoopResponse:
        """Loop L, sensitivity S and complementary sensitivity T, (m, 3, 3) complex each, at frequencies in Hz below
        half the sampling rate.
        """
        return self.loop.response(operating_strokes(self.stage, at_um), np.asarray(frequency_hz, np.float64))

    def write(self, path: str | Path) -> None:
        """Write the controller as a file, which runs in every command that takes ``--controller``."""
        write_toml(plain(self.controller), path)

    def over_changed_plants(
        self, tolerances: str = "wide", on_progress: Callable[[int, int], None] = lambda done, total: None
    ) -> ChangedPlants:
        """Ms on each of the changed plants that a tolerances file names; infinite where the loop is unstable."""
        return over_changed_plants(self.loop, load("tolerances", tolerances, Tolerances).cases(), on_progress)


def with_law(
    controller: ControllerConfig | str | Path, system: "control.lti.LTI", method: Literal["tustin", "zoh"] = "tustin"
) -> ControllerConfig:
    """A controller with a linear law of your own in place of its law; limits, monitors and all else stay.

    ``system``: of python-control, from error (m) to force (N), one axis for all three or 3 by 3; where it is continuous
    it is sampled by ``method``. Raises ``ConfigError`` for what is no such law; whether its loop is stable, ``design``
    finds out.
    """
    from pkxyz_ctrl.design.laws.chosen_law import with_law as with_law_of  # with python-control, a second

    try:
        return with_law_of(_controller_of(controller), system, method)
    except LawError as error:
        raise ConfigError(f"this law can't be had: {error}") from error


def _controller_of(controller: ControllerConfig | str | Path) -> ControllerConfig:
    if isinstance(controller, ControllerConfig):
        return controller
    return load("controllers", controller, ControllerConfig)


def design(
    controller: ControllerConfig | str | Path = "lqg",
    *,
    stage: Stage | str | Path = "reconstructed",
    bus: BusConfig | str | Path = "fd_5k",
) -> DesignedLaw:
    """Design and check the law of a controller file for a stage and a bus; each by name, by file, or itself.

    A law designed before for the same is not designed again. Raises ``ConfigError`` for files that can't be used, and
    for a linear law whose loop is not stable; ``DesignError`` for weights that lead to no stable loop.
    """
    law = _controller_of(controller)
    device = stage if isinstance(stage, Stage) else Stage.load(str(stage))
    on_bus = bus if isinstance(bus, BusConfig) else load("buses", bus, BusConfig)
    record = law_of(device.config, law, on_bus, autostart=True)
    return DesignedLaw(device, law, on_bus, Loop(device, on_bus, record))

"""Design a law for a stage and a bus, and ask how far it is from instability."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.studies.margins.loop import ChangedPlants, Loop, over_changed_plants
from hil.studies.operating_point import operating_strokes
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.law_store import law_of
from pkxyz_ctrl.design.margins.margins import LoopResponse, Margins
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.stage import Stage

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

    def over_changed_plants(
        self, tolerances: str = "wide", on_progress: Callable[[int, int], None] = lambda done, total: None
    ) -> ChangedPlants:
        """Ms on each of the changed plants that a tolerances file names; infinite where the loop is unstable."""
        return over_changed_plants(self.loop, load("tolerances", tolerances, Tolerances).cases(), on_progress)


def design(
    controller: ControllerConfig | str | Path = "lqg",
    *,
    stage: Stage | str | Path = "reconstructed",
    bus: BusConfig | str | Path = "fd_5k",
) -> DesignedLaw:
    """Design and check the law of a controller file for a stage and a bus; each by name, by file, or itself.

    A law designed before for the same is not designed again. Raises ``ConfigError`` for files that can't be used and
    ``DesignError`` for weights that lead to no stable loop.
    """
    law = controller if isinstance(controller, ControllerConfig) else load("controllers", controller, ControllerConfig)
    device = stage if isinstance(stage, Stage) else Stage.load(str(stage))
    on_bus = bus if isinstance(bus, BusConfig) else load("buses", bus, BusConfig)
    record = law_of(device.config, law, on_bus, autostart=True)
    return DesignedLaw(device, law, on_bus, Loop(device, on_bus, record))

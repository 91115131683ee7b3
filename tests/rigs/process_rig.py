"""A process without any spread, to which a test adds what it is about; and devices of given sizes."""

from typing import Any

import numpy as np

from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.fabrication.devices import Devices, made
from pkxyz_ctrl.fabrication.process import SOURCES, Process, SiliconConfig, Spread

SHIPPED = load("processes", "oreo_drie", Process)
STAGE = load("stages", "reconstructed", StageConfig)


def process(silicon: str = "drawn", **changes: Any) -> Process:
    """The shipped one with all spreads 0, at an atmosphere, save for the changes."""
    still = {name: Spread() for name in SOURCES} | {"pressure_pa": Spread(mean=101325.0)}
    return SHIPPED.model_copy(update={**still, "silicon": SiliconConfig(plane=silicon), **changes})


def devices(stage: StageConfig = STAGE, of: Process | None = None, **sizes: Any) -> Devices:
    """Devices with these sizes, (n, 3) each or what broadcasts to it; all others are as drawn."""
    n = max([len(np.atleast_2d(v)) for v in sizes.values()], default=1)
    size = {name: np.zeros((n, 3)) for name in SOURCES} | {"pressure_pa": np.full((n, 3), 101325.0)}
    size |= {name: np.broadcast_to(np.asarray(v, dtype=np.float64), (n, 3)) for name, v in sizes.items()}
    return made(stage, of or process(), size)

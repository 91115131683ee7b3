"""Writes docs/figures/identification.png: the harsh plant, identified with the defaults of the command."""

from pathlib import Path

import numpy as np

from hil.identification import identify
from hil.identify_figures import draw_response
from hil.setup import bare_setup
from pkxyz_ctrl.bus_config import BusConfig
from pkxyz_ctrl.config import load
from pkxyz_ctrl.controller_config import ControllerConfig


def main() -> None:
    """Identify and draw."""
    bus, controller = load("buses", "fd_5k", BusConfig), load("controllers", "lqg", ControllerConfig)
    found = identify(bare_setup("reconstructed", "harsh", controller, bus, 1), np.full(3, 12.5e-6), "fast")
    draw_response(found, Path(__file__).with_suffix(".png"))


if __name__ == "__main__":
    main()

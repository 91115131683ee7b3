"""Writes docs/figures/identification.png: the harsh plant, identified with the defaults of the command."""

from pathlib import Path

import numpy as np

from hil.lanes.lane import Lane
from hil.lanes.setup import bare_setup
from hil.pictures.identify import draw_response
from hil.studies.identify.identification import identify
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load


def main() -> None:
    """Identify and draw."""
    bus, controller = load("buses", "fd_5k", BusConfig), load("controllers", "lqg", ControllerConfig)
    found = identify(bare_setup("reconstructed", "harsh", controller, bus, 1), np.full(3, 12.5e-6), Lane.FAST)
    draw_response(found, Path(__file__).with_suffix(".png"))


if __name__ == "__main__":
    main()

"""Laws for a stage in operation, designed in a process of their own: it takes seconds of a processor."""

import multiprocessing
import tomllib
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from hil.operate.law_change import NAME_BYTES, OFFER
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, load, parse
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.design.law_store import law_of


def offer_of(stage: str, bus: str, name: str, text: str | None, number: int) -> bytes:
    """A record of ``OFFER``: the law of a shipped controller, or of the text of a controller file, for a stage and bus
    by name or file. Raises ``ConfigError``.
    """
    if text is None and not name.replace("_", "").isalnum():
        raise ConfigError(f"{name!r}: the name of a shipped controller is wanted; a file of yours is sent as text")
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_designed, stage, bus, name, text, number).result()


def _designed(stage: str, bus: str, name: str, text: str | None, number: int) -> bytes:
    if text is None:
        controller = load("controllers", name, ControllerConfig)
    else:
        try:
            controller = parse(tomllib.loads(text), ControllerConfig, name)
        except (tomllib.TOMLDecodeError, RecursionError) as error:
            raise ConfigError(f"{name}: not valid TOML: {error}") from None
    law = law_of(load("stages", stage, StageConfig), controller, load("buses", bus, BusConfig), autostart=False)
    offer = np.zeros(1, OFFER)
    offer["number"], offer["name"], offer["law"] = number, controller.name.encode()[:NAME_BYTES], law
    return offer.tobytes()

"""Laws for a stage in operation, designed in a process of their own: it takes seconds of a processor."""

import asyncio
import multiprocessing
import os
import tomllib
from collections.abc import Awaitable, Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.operate.law_change import NAME_BYTES, OFFER
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, load, parse
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.design.law_store import law_of
from pkxyz_ctrl.design.model.design_error import DesignError

CHOICE: Final = ("youla", "lqg", "robust", "irc", "irc_robust", "pi_notch")
"""Shipped laws that the page offers."""
_NICE = 5


class Choice:
    """Which laws of ``CHOICE`` a stage and a bus can have: looked for once, when somebody asks first."""

    def __init__(self, stage: str, bus: str, plan: Callable[..., Awaitable[Any]]) -> None:
        """``plan`` runs a function where it doesn't hold up the others."""
        self._files, self._plan = (stage, bus), plan
        self._found: asyncio.Task[dict[str, str]] | None = None

    def tell(self, told: Callable[[dict[str, Any]], object]) -> None:
        """Call ``told`` as soon as it is known, with ``{"laws": why not, by law}``; of what is given up nothing."""
        if self._found is None:
            self._found = asyncio.create_task(self._look())
        self._found.add_done_callback(lambda found: found.cancelled() or told({"laws": found.result()}))

    async def _look(self) -> dict[str, str]:
        try:
            found: dict[str, str] = await self._plan(refusals, *self._files)
        except BrokenProcessPool:
            self._found = None  # whoever asks next has it tried again
            return {}
        return found


def refusals(stage: str, bus: str) -> dict[str, str]:
    """Of each law of ``CHOICE`` why it can't be had for a stage and a bus by name or file; "" where it can."""
    with _elsewhere() as pool:
        return pool.submit(_refusals, stage, bus).result()


def offer_of(stage: str, bus: str, name: str, text: str | None, number: int) -> bytes:
    """A record of ``OFFER``: the law of a shipped controller, or of the text of a controller file, for a stage and bus
    by name or file. Raises ``ConfigError``.
    """
    if text is None and not name.replace("_", "").isalnum():
        raise ConfigError(f"{name!r}: the name of a shipped controller is wanted; a file of yours is sent as text")
    with _elsewhere() as pool:
        return pool.submit(_designed, stage, bus, name, text, number).result()


def give_up() -> None:
    """End what is being designed: the server ends, and nobody waits for it."""
    for process in multiprocessing.active_children():
        process.kill()


def _elsewhere() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))


def _refusals(stage: str, bus: str) -> dict[str, str]:
    os.nice(_NICE)  # the loop and whoever draws come first
    found = dict.fromkeys(CHOICE, "")
    for name in CHOICE:
        try:
            _law(stage, bus, load("controllers", name, ControllerConfig))
        except ConfigError as error:
            found[name] = str(error)
    return found


def _designed(stage: str, bus: str, name: str, text: str | None, number: int) -> bytes:
    if text is None:
        controller = load("controllers", name, ControllerConfig)
    else:
        try:
            controller = parse(tomllib.loads(text), ControllerConfig, name)
        except (tomllib.TOMLDecodeError, RecursionError) as error:
            raise ConfigError(f"{name}: not valid TOML: {error}") from None
    offer = np.zeros(1, OFFER)
    offer["number"], offer["name"] = number, controller.name.encode()[:NAME_BYTES]
    offer["law"] = _law(stage, bus, controller)
    return offer.tobytes()


def _law(stage: str, bus: str, controller: ControllerConfig) -> NDArray[np.void]:
    on_stage, on_bus = load("stages", stage, StageConfig), load("buses", bus, BusConfig)
    try:
        return law_of(on_stage, controller, on_bus, autostart=False)
    except DesignError as error:
        raise ConfigError(f"controller {controller.name!r}: {error}") from None

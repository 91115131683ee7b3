"""Faults put into one lockstep run, and the person who clears what they cause. Without them nothing of this exists."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from hil.bus.clock import Lockstep
from hil.bus.wire import Wire
from hil.faults.clock import FaultyClock
from hil.faults.fault import Fault
from hil.faults.plant import FAMILIES, FaultyPlant
from hil.faults.wire import WireFaults
from hil.node.amplifier import AmplifierNode
from hil.plant.on_bus import PlantOnBus
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.safety.modes import Mode
from sim.plant import Plant

_LOOK_US = 1_000  # how often the combs are looked at while nobody controls them


class Afterwards(NamedTuple):
    """The combs at a time after the first tick, when the controller was gone."""

    t_us: int
    comb_voltage_v: tuple[float, float, float]


def plant_of(plant: Plant, faults: Sequence[Fault], bus: BusConfig, seed: int) -> PlantOnBus:
    """The plant on its bus, with those of the faults that live there."""
    its_own = [f for f in faults if f.family in FAMILIES]
    return FaultyPlant(plant, its_own, bus, seed) if its_own else PlantOnBus(plant)


class Clearing:
    """Clears ``patience`` ticks after a fault decision, and again if that didn't help."""

    def __init__(self, controller: Controller, patience: int, begin_anew: Callable[[int], object]) -> None:
        self._controller, self._patience, self._begin_anew = controller, patience, begin_anew
        self._waited = 0

    def look(self, tick: int) -> None:
        """A tick is recorded."""
        if self._controller.mode == Mode.ENABLED:
            self._begin_anew(tick)
        self.skip(1)
        if self._waited % self._patience == self._patience - 1:
            self._controller.clear()

    @property
    def room(self) -> int:
        """How many ticks in a mode that it waits in may pass without a look."""
        return (self._patience - 2 - self._waited) % self._patience

    def skip(self, ticks: int) -> None:
        """So many have passed, all in the present mode."""
        self._waited = self._waited + ticks if self._controller.mode in (Mode.FAULT, Mode.BOOT) else 0


class Injection:
    """The faults of bus, node and controller of one run, and whoever clears ``clear_s`` after a fault decision."""

    def __init__(
        self, faults: Sequence[Fault], clear_s: float | None, period_us: int, seed: int,
        clock: Lockstep, wire: Wire, node: AmplifierNode, plant: PlantOnBus, controller: Controller,
    ) -> None:  # fmt: skip
        self.faults = faults
        self._clear_ticks = None if clear_s is None else max(1, round(clear_s * 1e6 / period_us))
        self._period_us = period_us
        self._clock = clock
        self._plant = plant
        self.clearing: Clearing | None = None
        """who clears in this run, if somebody does"""
        self._controller = controller
        self.afterwards: list[Afterwards] = []
        self.watched: list[tuple[float, float, float]] | None = None
        """If it is a list: the comb voltages at the end of each tick, true even while the node does not sample."""
        self.wire_faults = WireFaults(faults, clock, wire, node, controller.can.driver, seed + 1)
        self.origin_us = 0
        """when the first tick begins, from which faults count"""

    def before_power_on(self) -> None:
        """What is wrong before the node is switched on."""
        self.wire_faults.before_power_on()

    def arm(self) -> FaultyClock:
        """The next instant of the loop is its first tick: make all appointments. Returns the loop's clock."""
        self.origin_us = self._clock.now_us + self._period_us
        self.wire_faults.arm(self.origin_us)
        self._faulty = FaultyClock(self._clock, self.faults, self.origin_us, self._period_us)
        return self._faulty

    def quiet_until_us(self, t_us: int) -> int | None:
        """``FaultyClock.quiet_until_us``."""
        return self._faulty.quiet_until_us(t_us)

    def late_us(self, t_us: int) -> int:
        """``FaultyClock.late_us``."""
        return self._faulty.late_us(t_us)

    def taking(self, record: Callable[[int], object], begin_anew: Callable[[int], object]) -> Callable[[int], object]:
        """``record``; behind it a look at the combs, if they are watched, and so many ticks after a fault decision a
        clear. ``begin_anew`` is told the tick after which the trajectory starts over.
        """
        watched, patience = self.watched, self._clear_ticks
        clearing = self.clearing = None if patience is None else Clearing(self._controller, patience, begin_anew)

        def take(tick: int) -> None:
            record(tick)
            if watched is not None:
                watched.append(self._look())
            if clearing is not None:
                clearing.look(tick)

        return record if watched is None and clearing is None else take

    def _look(self) -> tuple[float, float, float]:
        """Voltages at the combs now."""
        self._plant.look(self._clock.now_us)
        a, b, c = self._plant.plant.voltage_v.tolist()
        return a, b, c

    def outlive(self, ticks: int) -> None:
        """The controller is gone: time goes on to the end of the run, and the combs are watched."""
        clock, end_us = self._clock, self.origin_us + ticks * self._period_us
        while clock.now_us < end_us:
            clock.run_until(min(end_us, clock.now_us + _LOOK_US))
            self.afterwards.append(Afterwards(clock.now_us - self.origin_us, self._look()))

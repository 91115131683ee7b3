"""Faults put into one lockstep run, and the person who clears what they cause. Without them nothing of this exists."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from hil.faults.clock import FaultyClock
from hil.faults.fault import Fault
from hil.faults.plant import FAMILIES, FaultyPlant
from hil.faults.wire import WireFaults
from hil.plant.on_bus import PlantOnBus
from pkxyz_ctrl.safety.modes import Mode

if TYPE_CHECKING:
    from hil.lanes.lockstep import LockstepRig
    from hil.lanes.setup import Setup

_LOOK_US = 1_000  # how often the combs are looked at while nobody controls them


class Afterwards(NamedTuple):
    """The combs at a time after the first tick, when the controller was gone."""

    t_us: int
    comb_voltage_v: tuple[float, float, float]


def plant_of(setup: "Setup") -> PlantOnBus:
    """The plant on the bus of a setup, with the faults that live there."""
    faults = [f for f in setup.faults if f.family in FAMILIES]
    if not faults:
        return PlantOnBus(setup.new_plant())
    return FaultyPlant(setup.new_plant(), faults, setup.bus, setup.seed)


class Injection:
    """The faults of bus, node and controller of one rig, and whoever clears."""

    def __init__(self, rig: "LockstepRig") -> None:
        self._rig = rig
        setup = rig.setup
        self.faults: Sequence[Fault] = setup.faults
        self.afterwards: list[Afterwards] = []
        self.watched: list[tuple[float, float, float]] | None = None
        """If it is a list: the comb voltages at the end of each tick, true even while the node does not sample."""
        self._wire = WireFaults(setup.faults, rig.clock, rig.wire, rig.node, rig.controller.can.driver, setup.seed + 1)
        self._origin_us = 0

    def before_power_on(self) -> None:
        """What is wrong before the node is switched on."""
        self._wire.before_power_on()

    def arm(self) -> FaultyClock:
        """The next instant of the loop is its first tick: make all appointments. Returns the loop's clock."""
        rig = self._rig
        self._origin_us = rig.clock.now_us + rig.setup.bus.period_us
        self._wire.arm(self._origin_us)
        return FaultyClock(rig.clock, self.faults, self._origin_us, rig.setup.bus.period_us)

    def clearing(self, record: Callable[[int], object], begin_anew: Callable[[int], object]) -> Callable[[int], object]:
        """``record`` and, so many ticks after a fault decision, a clear; a look at the combs, if one is wanted.
        ``begin_anew`` is told the tick after which the trajectory starts over.
        """
        clear_s, controller, watched = self._rig.setup.clear_s, self._rig.controller, self.watched
        if watched is not None:
            record = self._watching(record, watched)
        if clear_s is None:
            return record
        patience = max(1, round(clear_s / self._rig.setup.bus.period_s))
        waited = 0

        def record_and_clear(tick: int) -> None:
            nonlocal waited
            record(tick)
            if controller.mode == Mode.ENABLED:
                begin_anew(tick)
            waited = waited + 1 if controller.mode in (Mode.FAULT, Mode.BOOT) else 0
            if waited % patience == patience - 1:
                controller.clear()

        return record_and_clear

    def _watching(
        self, record: Callable[[int], object], watched: list[tuple[float, float, float]]
    ) -> Callable[[int], object]:
        def record_and_look(tick: int) -> None:
            record(tick)
            watched.append(self._look())

        return record_and_look

    def _look(self) -> tuple[float, float, float]:
        """Voltages at the combs now."""
        rig = self._rig
        rig.plant.advance_to(rig.clock.now_us)
        rig.plant.settle()
        a, b, c = rig.plant.plant.voltage_v.tolist()
        return a, b, c

    def outlive(self, ticks: int) -> None:
        """The controller is gone: time goes on to the end of the run, and the combs are watched."""
        rig = self._rig
        end_us = self._origin_us + ticks * rig.setup.bus.period_us
        while rig.clock.now_us < end_us:
            rig.clock.run_until(min(end_us, rig.clock.now_us + _LOOK_US))
            self.afterwards.append(Afterwards(rig.clock.now_us - self._origin_us, self._look()))

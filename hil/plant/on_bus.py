"""The plant as the amplifier node sees it: driven and sampled in bus time, one compiled call a tick."""

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hil.plant.truth import observe
from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.loop.row import TRUTH_FIELDS
from sim import kernels
from sim.plant import Plant

EXCHANGE = np.dtype(
    [
        *TRUTH_FIELDS,
        ("drive_count", "i4", (3,)),
        ("sense_count", "i4", (3,)),
    ],
    align=True,
)


@njit(cache=True)
def _exchange(
    params: NDArray[np.void],
    state: NDArray[np.void],
    exchange: NDArray[np.void],
    advance_us: int,
    is_driven: bool,
    count_1: int,
    count_2: int,
    count_3: int,
) -> tuple[int, int, int]:
    """What a SYNC means to the plant: move on to now, take new voltages if there are any, be sampled."""
    x = exchange[0]
    kernels.advance(params, state, advance_us)
    observe(params[0], state[0], x)
    if is_driven:
        drive = x["drive_count"]
        drive[0], drive[1], drive[2] = count_1, count_2, count_3
        kernels.drive(params, state, drive)
    sense = x["sense_count"]
    kernels.sample(params, state, sense)
    return sense[0], sense[1], sense[2]


class PlantOnBus:
    """A plant whose time 0 is the first sample: until then it stands in equilibrium
    at 0 V, however long the start-up takes.

    ``advance_to`` and ``drive`` wait for what follows, so that the SYNC's three steps are one compiled call; whatever
    ends otherwise (a fault that discharges the combs between two samples) is carried out as it comes.
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self._params, self._state = plant.params, plant.state
        self.exchange = np.zeros(1, EXCHANGE)
        self._counts: Sequence[int] = (0, 0, 0)
        self._is_driven = False  # the counts wait to be applied, and the time to pass
        self.was_sampled = False  # since somebody last set it to False
        self._origin_us: int | None = None
        self._plant_us = plant.t_us
        self._now_us = 0
        self._exchange = direct(_exchange, plant.params, plant.state, self.exchange, 0, False, 0, 0, 0)
        # Loaded now, not in the first tick:
        self._exchange(plant.params, plant.state.copy(), self.exchange.copy(), 0, False, 0, 0, 0)

    def advance_to(self, t_us: int) -> None:
        """It is ``t_us`` on the bus."""
        if self._is_driven:
            self.settle()
        self._now_us = t_us

    def drive(self, counts: Sequence[int]) -> None:
        """The converters take new counts (3,) now."""
        if self._is_driven:
            self.settle()
        self._counts = counts
        self._is_driven = True

    def sample(self) -> tuple[int, int, int]:
        """Sample the sense combs now."""
        if self._origin_us is None:
            self._origin_us = self._now_us
        target_us = self._now_us - self._origin_us
        a, b, c = self._counts
        counts: tuple[int, int, int] = self._exchange(
            self._params, self._state, self.exchange, target_us - self._plant_us, self._is_driven, a, b, c
        )
        self._plant_us = target_us
        self._is_driven = False
        self.was_sampled = True
        return counts

    def look(self, t_us: int) -> None:
        """It is ``t_us``, and no sample brings the truth in ``exchange`` to it: bring it there."""
        self.advance_to(t_us)
        self.settle()
        observe(self._params[0], self._state[0], self.exchange[0])

    def settle(self) -> None:
        """Carry out what waits: move the plant to now, and apply the counts that came without a sample after them."""
        if self._origin_us is not None:
            target_us = self._now_us - self._origin_us
            self.plant.advance_to(target_us)
            self._plant_us = target_us
        if self._is_driven:
            self.plant.drive(self._counts)
            self._is_driven = False

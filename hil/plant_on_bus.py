"""The plant as the amplifier node sees it: driven and sampled in bus time, one compiled call a tick."""

import struct
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hil.truth import observe
from pkxyz_ctrl.direct_call import direct
from pkxyz_ctrl.row import TRUTH_FIELDS
from sim import kernels
from sim.plant import Plant

EXCHANGE = np.dtype(
    [
        *TRUTH_FIELDS,
        ("advance_us", "i8"),
        ("is_driven", "i4"),
        ("drive_count", "i4", (3,)),
        ("sense_count", "i4", (3,)),
    ],
    align=True,
)
_AT = {name: offset for name, (_, offset, *_) in dict(EXCHANGE.fields or {}).items()}
_ASK = struct.Struct("=qi3i")  # advance_us, is_driven, drive_count: numpy takes five times as long to set them
_ANSWER = struct.Struct("=3i")  # sense_count


@njit(cache=True)
def _exchange(params: NDArray[np.void], state: NDArray[np.void], exchange: NDArray[np.void]) -> None:
    """What a SYNC means to the plant: move on to now, take new voltages if there are any, be sampled."""
    x = exchange[0]
    kernels.advance(params, state, x["advance_us"])
    observe(params[0], state[0], x)
    if x["is_driven"] != 0:
        kernels.drive(params, state, x["drive_count"])
    kernels.sample(params, state, x["sense_count"])


class PlantOnBus:
    """A plant whose time 0 is the first sample: until then it stands in equilibrium at 0 V, however long the start-up
    takes.

    ``advance_to`` and ``drive`` wait for what follows, so that the SYNC's three steps are one compiled call; whatever
    ends otherwise (a fault that discharges the combs between two samples) is carried out as it comes.
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self._params, self._state = plant.params, plant.state
        self.exchange = np.zeros(1, EXCHANGE)
        self._bytes = self.exchange.view(np.uint8).data
        self._counts: Sequence[int] = (0, 0, 0)
        self._is_driven = False  # the counts wait to be applied
        self._origin_us: int | None = None
        self._plant_us = plant.t_us
        self._now_us = 0
        self._waiting = False
        self._exchange = direct(_exchange, plant.params, plant.state, self.exchange)
        self._exchange(plant.params, plant.state.copy(), self.exchange.copy())  # loaded now, not in the first tick

    def advance_to(self, t_us: int) -> None:
        """It is ``t_us`` on the bus."""
        if self._waiting:
            self.settle()
        self._now_us = t_us

    def drive(self, counts: Sequence[int]) -> None:
        """The converters take new counts (3,) now."""
        if self._waiting:
            self.settle()
        self._counts = counts
        self._is_driven = True
        self._waiting = True

    def sample(self) -> tuple[int, int, int]:
        """Sample the sense combs now."""
        if self._origin_us is None:
            self._origin_us = self._now_us
        target_us = self._now_us - self._origin_us
        _ASK.pack_into(self._bytes, _AT["advance_us"], target_us - self._plant_us, self._is_driven, *self._counts)
        self._exchange(self._params, self._state, self.exchange)
        self._plant_us = target_us
        self._is_driven = self._waiting = False
        a, b, c = _ANSWER.unpack_from(self._bytes, _AT["sense_count"])
        return a, b, c

    def settle(self) -> None:
        """Carry out what waits: move the plant to now, and apply the counts that came without a sample after them."""
        if self._origin_us is not None:
            target_us = self._now_us - self._origin_us
            self.plant.advance_to(target_us)
            self._plant_us = target_us
        if self._is_driven:
            self.plant.drive(self._counts)
            self._is_driven = False
        self._waiting = False

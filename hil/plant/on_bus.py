"""The plant as the amplifier node sees it: driven and sampled in bus time, one compiled call a tick."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hil.plant.truth import observe
from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.loop.row import TRUTH_FIELDS
from sim import kernels
from sim.plant import Plant

RECORD = np.dtype(
    [
        *TRUTH_FIELDS,
        ("drive_count", "i4", (3,)),
        ("sense_count", "i4", (3,)),
    ],
    align=True,
)


@kernel
def at_sync(
    params: NDArray[np.void],
    state: NDArray[np.void],
    record: NDArray[np.void],
    advance_us: int,
    is_driven: bool,
    count_1: int,
    count_2: int,
    count_3: int,
) -> tuple[int, int, int]:
    """What a SYNC means to the plant: move on to now, take new voltages if there are any, be sampled."""
    x = record[0]
    kernels.advance(params, state, advance_us)
    observe(params[0], state[0], x)
    if is_driven:
        drive = x["drive_count"]
        drive[0], drive[1], drive[2] = count_1, count_2, count_3
        kernels.drive(params, state, drive)
    sense = x["sense_count"]
    kernels.sample(params, state, sense)
    return sense[0], sense[1], sense[2]


@njit(cache=True)
def at_look(
    params: NDArray[np.void],
    state: NDArray[np.void],
    record: NDArray[np.void],
    advance_us: int,
    is_driven: bool,
    count_1: int,
    count_2: int,
    count_3: int,
) -> None:
    """What time alone means to the plant: move on to now, take voltages if there are any; the truth is seen behind it.

    ``record`` keeps its counts, which are those of the last SYNC.
    """
    kernels.advance(params, state, advance_us)
    if is_driven:
        drive = np.empty(3, np.int32)
        drive[0], drive[1], drive[2] = count_1, count_2, count_3
        kernels.drive(params, state, drive)
    observe(params[0], state[0], record[0])


class PlantOnBus:
    """A plant whose time 0 is the first sample: until then it stands in equilibrium
    at 0 V, however long the start-up takes.
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self._params, self._state = plant.params, plant.state
        self.record = np.zeros(1, RECORD)
        """what is true at the last sample, and what was sampled"""
        self.was_sampled = False  # since somebody last set it to False
        self.sensed: tuple[int, int, int] = (0, 0, 0)
        self.origin_us: int | None = None
        self.plant_us = plant.t_us
        self.commanded: tuple[int, int, int] = (0, 0, 0)
        """what the node last put out, where somebody has to know"""
        self._exchange = direct(at_sync, plant.params, plant.state, self.record, 0, False, 0, 0, 0)
        # Loaded now, not in the first tick:
        self._exchange(plant.params, plant.state.copy(), self.record.copy(), 0, False, 0, 0, 0)
        kernels.drive(plant.params, plant.state.copy(), np.zeros(3, np.int32))
        self._look = direct(at_look, plant.params, plant.state, self.record, 0, False, 0, 0, 0)
        self._look(plant.params, plant.state.copy(), self.record.copy(), 0, False, 0, 0, 0)

    def exchange(self, t_us: int, counts: tuple[int, int, int] | None, *, sample: bool) -> tuple[int, int, int]:
        """As ``hil.node.sense.Plant`` says; with a sample one compiled call."""
        if self.origin_us is None:
            if not sample:
                if counts is not None:
                    self.plant.drive(counts)
                return self.sensed
            self.origin_us = t_us
        target_us = t_us - self.origin_us
        if sample:
            a, b, c = counts or (0, 0, 0)
            self.sensed = self._exchange(
                self._params, self._state, self.record, target_us - self.plant_us, counts is not None, a, b, c
            )
            self.was_sampled = True
        else:
            self.plant.advance_to(target_us)
            if counts is not None:
                self.plant.drive(counts)
        self.plant_us = target_us
        return self.sensed

    def switch(self, bits: int, t_us: int) -> None:
        """The node's digital outputs put out ``bits`` from ``t_us`` on, which at a SYNC is when it samples."""
        self.record["terminal_output"] = bits

    @property
    def quiet_until_us(self) -> int | None:
        """Until when what acts on it and on its channels stays as it is; None: for ever."""
        return None

    @property
    def is_disturbed(self) -> bool:
        """Whether something acts on it besides the node's voltages."""
        return False

    def take_over(self, plant_us: int, commanded: tuple[int, int, int]) -> None:
        """Others have gone on with what ``params``, ``state`` and ``record`` hold, to ``plant_us`` by its time."""
        a, b, c = self.record["sense_count"][0].tolist()
        self.plant_us, self.commanded, self.sensed, self.was_sampled = plant_us, commanded, (a, b, c), False

    def look(self, t_us: int) -> None:
        """It is ``t_us``, and no sample brings the truth in ``record`` to it: bring it there."""
        self._see(t_us, None)

    def _see(self, t_us: int, counts: tuple[int, int, int] | None) -> None:
        """Likewise; the converters take ``counts`` first, if there are any."""
        if self.origin_us is None:
            self.exchange(t_us, counts, sample=False)
            observe(self._params[0], self._state[0], self.record[0])
            return
        target_us = t_us - self.origin_us
        a, b, c = counts or (0, 0, 0)
        self._look(self._params, self._state, self.record, target_us - self.plant_us, counts is not None, a, b, c)
        self.plant_us = target_us

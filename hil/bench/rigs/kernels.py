"""Compiled loops, which measure kernels without the cost of calling them, and empty kernels, which measure it."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.loop.cycle import cycle
from sim import kernels


@njit(cache=True)
def no_argument() -> None:
    """Nothing."""


@njit(cache=True)
def one_array(a: NDArray[np.void]) -> None:
    """Nothing, with one array."""


@njit(cache=True)
def two_arrays(a: NDArray[np.void], b: NDArray[np.void]) -> None:
    """Nothing, with two arrays."""


@njit(cache=True)
def three_arrays(a: NDArray[np.void], b: NDArray[np.void], c: NDArray[np.float64]) -> None:
    """Nothing, with three arrays, as ``cycle`` takes them."""


@njit(cache=True)
def replay_cycle(
    law: NDArray[np.void], memory: NDArray[np.void], reference: NDArray[np.float64], sense_count: NDArray[np.int32]
) -> None:
    """The whole cycle on recorded samples, ``sense_count`` (n, 3)."""
    seen = memory[0]["input"]
    for k in range(len(sense_count)):
        for i in range(3):
            seen["sense_count"][i] = sense_count[k, i]
        cycle(law, memory, reference)


@njit(cache=True)
def replay_plant(
    params: NDArray[np.void],
    state: NDArray[np.void],
    drive_count: NDArray[np.int32],
    sense_count: NDArray[np.int32],
    period_us: int,
) -> None:
    """The plant on recorded voltages, ``drive_count`` (n, 3), each for a period, after which it is sampled."""
    for k in range(len(drive_count)):
        kernels.drive(params, state, drive_count[k])
        kernels.advance(params, state, period_us)
        kernels.sample(params, state, sense_count[k])

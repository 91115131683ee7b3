"""What a faulty channel makes of counts, compiled: the same arithmetic event by event and in whole ticks.

A fault of a sense or amplifier channel that is on is a record; what it remembers begins with it.
"""

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hil.plant.on_bus import at_look, at_sync
from pkxyz_ctrl.compiled.kernel import kernel
from sim.motion.noise import next_u64, normal, stream

Records = NDArray[np.void]

REMEMBERED: Final = 101  # samples: the longest delay, and the present one

CHANNEL = np.dtype(
    [
        ("kind", "i4"),  # 0: none
        ("place", "i4"),  # 0, 1 or 2
        ("first", "f8"),  # numbers of the kind, as below
        ("second", "f8"),
        ("count", "f8"),  # what it remembers
        ("t_us", "i8"),
        ("samples", "i8"),  # since it began
        ("held", "f8", (REMEMBERED,)),
    ],
    align=True,
)

DICE = np.dtype([("words", "u8", (4,)), ("spare", "f8", (2,))], align=True)
"""A generator of ``sim.motion.noise``."""

# kinds: of amplifier channels ...
HELD, HIGHEST, SLEWING = 1, 2, 3  # first: the count; the highest; counts a microsecond
FIRST_OF_SENSE: Final = 10
# ... and of sense channels
LOW, STUCK, GARBAGE, SCALED, ADDED, LAGGING, DELAYED, LOOSE, NOISY = range(FIRST_OF_SENSE, FIRST_OF_SENSE + 9)
# first: -; -; -; gain, about second; count added; share of the way; samples; probability; sigma in counts

LOWEST, UPPERMOST = -32768, 32767


def dice_of(seed: int, source: int) -> Records:
    """(1,) of ``DICE``."""
    dice = np.zeros(1, DICE)
    dice["words"] = stream(seed, source, 0)
    return dice


@kernel
def chance(words: NDArray[np.uint64]) -> float:
    """Uniform on [0, 1), 53 bits."""
    return float(np.int64(next_u64(words) >> np.uint64(11)) * 2.0**-53)


@kernel
def below(words: NDArray[np.uint64], limit: int) -> int:
    """A whole number from 0 to ``limit`` - 1, for limits far below 2^63."""
    return int(np.int64(next_u64(words) >> np.uint64(1)) % limit)


@kernel
def amplified(channels: Records, t_us: int, first: int, second: int, third: int) -> tuple[int, int, int]:
    """What the converters get of counts that the node puts out at ``t_us``, after the first sample."""
    a, b, c = float(first), float(second), float(third)
    for n in range(len(channels)):
        channel = channels[n]
        if 0 < channel["kind"] < FIRST_OF_SENSE:
            place = channel["place"]
            count = _driven(channel, a if place == 0 else b if place == 1 else c, t_us)
            a, b, c = count if place == 0 else a, count if place == 1 else b, count if place == 2 else c
    return int(np.rint(a)), int(np.rint(b)), int(np.rint(c))


@kernel
def _driven(channel: np.void, count: float, t_us: int) -> float:
    kind = channel["kind"]
    if kind == HELD:
        return float(channel["first"])
    if kind == HIGHEST:
        return float(min(count, channel["first"]))
    reach = channel["first"] * (t_us - channel["t_us"])  # SLEWING
    channel["t_us"] = t_us
    channel["count"] += max(-reach, min(reach, count - channel["count"]))
    return float(channel["count"])


@kernel
def sensed(channels: Records, dice: Records, first: int, second: int, third: int) -> tuple[int, int, int]:
    """What the node reads of counts of the converters."""
    a, b, c = float(first), float(second), float(third)
    for n in range(len(channels)):
        channel = channels[n]
        if channel["kind"] >= FIRST_OF_SENSE:
            place = channel["place"]
            count = _read(channel, dice[0], a if place == 0 else b if place == 1 else c)
            a, b, c = count if place == 0 else a, count if place == 1 else b, count if place == 2 else c
    return _whole(a), _whole(b), _whole(c)


@kernel
def _whole(count: float) -> int:
    return int(max(LOWEST, min(UPPERMOST, np.rint(count))))


@kernel
def _read(channel: np.void, dice: np.void, count: float) -> float:
    kind, first = channel["kind"], channel["first"]
    channel["samples"] += 1
    if channel["samples"] == 1:
        channel["count"] = count
    if kind == LOW:
        return float(LOWEST)
    if kind == STUCK:
        return float(channel["count"])
    if kind == GARBAGE:
        return float(LOWEST + below(dice["words"], UPPERMOST - LOWEST + 1))
    if kind == SCALED:
        return float(channel["second"] + first * (count - channel["second"]))
    if kind == ADDED:
        return float(count + first)
    if kind == LAGGING:
        channel["count"] += first * (count - channel["count"])
        return float(channel["count"])
    if kind == DELAYED:
        now, ago = channel["samples"] - 1, min(int(first), channel["samples"] - 1)
        channel["held"][now % REMEMBERED] = count
        return float(channel["held"][(now - ago) % REMEMBERED])
    if kind == LOOSE:
        return float(LOWEST) if chance(dice["words"]) < first else count
    return float(count + first * normal(dice["words"], dice["spare"]))  # NOISY


@kernel
def at_faulty_sync(
    params: Records, state: Records, record: Records, channels: Records, dice: Records, t_us: int, advance_us: int,
    first: int, second: int, third: int,
) -> tuple[int, int, int]:  # fmt: skip
    """``at_sync`` with counts of the node's, through channels as they are."""
    a, b, c = amplified(channels, t_us, first, second, third)
    a, b, c = at_sync(params, state, record, advance_us, True, a, b, c)
    return sensed(channels, dice, a, b, c)


@njit(cache=True, error_model="numpy")
def at_faulty_look(
    params: Records, state: Records, record: Records, channels: Records, t_us: int, advance_us: int, is_driven: bool,
    first: int, second: int, third: int,
) -> None:  # fmt: skip
    """``at_look`` likewise; while a fault is on, the converters take again what they were told."""
    a, b, c = amplified(channels, t_us, first, second, third) if is_driven else (first, second, third)
    at_look(params, state, record, advance_us, is_driven, a, b, c)

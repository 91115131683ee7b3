"""Random numbers inside compiled code: one small generator per source, its whole memory in the plant's state.

SFC64 (Doty-Humphrey, PractRand), the same stream as ``numpy.random.SFC64``, and
normal deviates by Marsaglia's polar method."""

import math

import numpy as np

from sim.motion.kernel import kernel

LOW_63 = np.uint64(0x7FFFFFFFFFFFFFFF)
TOP_BIT = np.uint64(0x8000000000000000)
ONE = np.uint64(1)
THREE = np.uint64(3)
ELEVEN = np.uint64(11)
TWENTY_FOUR = np.uint64(24)
FORTY = np.uint64(40)


def stream(seed: int, source: int, offset: int) -> np.ndarray:
    """Starting state (4,) uint64 of one source's own stream."""
    words = np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(source, offset % 2**32))).state["state"]["state"]
    return np.asarray(words, dtype=np.uint64)


@kernel
def _add(a: np.uint64, b: np.uint64) -> np.uint64:
    """a + b modulo 2^64, without a carry out of 64 bits: interpreted NumPy scalars would warn of it."""
    return ((a & LOW_63) + (b & LOW_63)) ^ ((a ^ b) & TOP_BIT)


@kernel
def next_u64(words: np.ndarray) -> np.uint64:
    """Next 64 random bits; ``words`` (4,) uint64 is the generator's memory."""
    a, b, c, counter = words[0], words[1], words[2], words[3]
    out: np.uint64 = _add(_add(a, b), counter)
    words[0] = b ^ (b >> ELEVEN)
    words[1] = _add(c, c << THREE)
    words[2] = _add((c << TWENTY_FOUR) | (c >> FORTY), out)
    words[3] = _add(counter, ONE)
    return out


@kernel
def _uniform(words: np.ndarray) -> float:
    """Uniform on (-1, 1), 53 bits."""
    return float(np.int64(next_u64(words) >> ELEVEN) * 2.0**-52 - 1.0)


@kernel
def normal(words: np.ndarray, spare: np.ndarray) -> float:
    """Standard normal deviate. Each accepted pair yields two: the second waits in
    ``spare`` (2,): [is there one, its value]."""
    if spare[0] != 0.0:
        spare[0] = 0.0
        return float(spare[1])
    u = _uniform(words)
    v = _uniform(words)
    r2 = u * u + v * v
    while r2 >= 1.0 or r2 == 0.0:
        u = _uniform(words)
        v = _uniform(words)
        r2 = u * u + v * v
    scale = math.sqrt(-2.0 * math.log(r2) / r2)
    spare[0] = 1.0
    spare[1] = v * scale
    return float(u * scale)


@kernel
def total(values: np.ndarray) -> float:
    """Sum of (n,). numpy's own would bring its library along wherever this is loaded."""
    value = 0.0
    for k in range(len(values)):
        value += values[k]
    return value

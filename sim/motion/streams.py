"""Streams of a plant's sources, all started at once: what ``noise.stream`` gives for each, at a hundredth of its cost.

numpy's SeedSequence (O'Neill's seed_seq, numpy.random.bit_generator) of a seed and a key of two words, and its seeding
of SFC64. A plant has fourteen sources, and a study makes thousands of plants.
"""

from collections.abc import Mapping

import numpy as np

from sim.motion.kernel import kernel
from sim.motion.noise import next_u64

WORD = 0xFFFFFFFF
POOL = 4
HASH_A, TIMES_A = 0x43B0D7E5, 0x931E8875
HASH_B, TIMES_B = 0x8B51F9DD, 0x58F38DED
MIX_LEFT, MIX_RIGHT = 0xCA01F9DD, 0x4973F715
ROUNDS = 12
"""That a generator runs before its first number."""


@kernel
def _hashed(value: int, by: int, times: int) -> int:
    value = ((value ^ by) * ((by * times) & WORD)) & WORD
    return value ^ (value >> 16)


@kernel
def _mixed(x: int, y: int) -> int:
    value = (MIX_LEFT * x - MIX_RIGHT * y) & WORD
    return value ^ (value >> 16)


@kernel
def _start(seed_words: np.ndarray, sources: np.ndarray, offsets: np.ndarray, pool: np.ndarray, out: np.ndarray) -> None:
    """Into ``out`` (k, 4) uint64 the starting states of sources (k,) with offsets (k,); ``seed_words`` (4,) of the
    seed, least first; ``pool`` (4,) is scratch. All int64, words of 32 bits.
    """
    for k in range(len(sources)):
        by = HASH_A
        for i in range(POOL):
            pool[i] = _hashed(int(seed_words[i]), by, TIMES_A)
            by = (by * TIMES_A) & WORD
        for i in range(POOL):
            for j in range(POOL):
                if i != j:
                    pool[j] = _mixed(int(pool[j]), _hashed(int(pool[i]), by, TIMES_A))
                    by = (by * TIMES_A) & WORD
        for key in (sources[k], offsets[k]):
            for j in range(POOL):
                pool[j] = _mixed(int(pool[j]), _hashed(int(key), by, TIMES_A))
                by = (by * TIMES_A) & WORD
        by = HASH_B
        for i in range(3):
            low = _hashed(int(pool[2 * i % POOL]), by, TIMES_B)
            by = (by * TIMES_B) & WORD
            high = _hashed(int(pool[(2 * i + 1) % POOL]), by, TIMES_B)
            by = (by * TIMES_B) & WORD
            out[k, i] = (np.uint64(high) << np.uint64(32)) | np.uint64(low)
        out[k, 3] = np.uint64(1)
        for _ in range(ROUNDS):
            next_u64(out[k])


def start_streams(random: np.ndarray, seed: int, offsets: Mapping[int, int]) -> None:
    """Into ``random`` (n, 4) the starting states of the sources that ``offsets`` names.

    Raises ``ValueError`` for a seed below 0 or of more than 128 bits.
    """
    if not 0 <= seed < 1 << 32 * POOL:
        raise ValueError(f"a seed has at most {32 * POOL} bits, not {seed}")
    words = np.array([seed >> 32 * i & WORD for i in range(POOL)], dtype=np.int64)
    sources = np.array(list(offsets), dtype=np.int64)
    keys = np.array([offset & WORD for offset in offsets.values()], dtype=np.int64)
    out = np.empty((len(sources), 4), dtype=np.uint64)
    _start(words, sources, keys, np.empty(POOL, dtype=np.int64), out)
    random[sources] = out

"""The dies of a wafer, and the random numbers of each: those of wafer w under a seed are a function of both alone.

Device n lies on wafer n // D as its die n % D, with D dies a wafer. A wafer is always sampled whole, so a device has
the same bits whoever asks for it, alone or among a million.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.fabrication.process import SOURCES, Process, Spread, WaferConfig

Array = NDArray[np.float64]
Rows = slice | NDArray[np.int64]

CHAIN_ANGLES_RAD = tuple(math.radians(d) for d in (90.0, 210.0, 330.0))
"""Directions in which the sliders move inward; a chain's springs lie on the other side of the die."""


@dataclass(frozen=True)
class Deviates:
    """Standard normal numbers of one quantity for n devices."""

    wafer: Array
    """(n,)"""
    tilt: Array
    """(n, 2), along x and y"""
    die: Array
    """(n,), correlated over each wafer"""
    chain: Array
    """(n, 3)"""

    def take(self, rows: Rows) -> "Deviates":
        """Those of some of the devices."""
        return Deviates(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(frozen=True)
class Sampled:
    """n devices as they come from wafers: places and random numbers, nothing of their sizes yet."""

    device: NDArray[np.int64]
    """(n,) numbers"""
    place_m: Array
    """(n, 2) of the die's middle from the wafer's"""
    deviates: Mapping[str, Deviates]
    """by ``SOURCES``"""

    def take(self, rows: Rows) -> "Sampled":
        """Some of the devices."""
        return Sampled(self.device[rows], self.place_m[rows], {k: d.take(rows) for k, d in self.deviates.items()})


@lru_cache(maxsize=8)
def die_places_m(wafer: WaferConfig) -> Array:
    """Middles (D, 2) of the whole dies on a wafer, row by row from below; the pattern is centred."""
    most = math.ceil(wafer.usable_radius_m / wafer.die_m)
    best: list[tuple[float, float]] = []
    for shift in (0.0, 0.5):
        line = (np.arange(-most, most + 1) + shift) * wafer.die_m
        far = np.abs(line) + wafer.die_m / 2.0
        found = [(float(x), float(y)) for y, fy in zip(line, far, strict=True) for x, fx in zip(line, far, strict=True)
                 if math.hypot(fx, fy) <= wafer.usable_radius_m]  # fmt: skip
        best = max(best, found, key=len)
    places = np.array(best)
    places.flags.writeable = False
    return places


def dies_per_wafer(process: Process) -> int:
    """D."""
    return len(die_places_m(process.wafer))


@lru_cache(maxsize=8)
def _field_root(wafer: WaferConfig) -> Array:
    """L (D, D) with L L^T the correlation exp(-distance / correlation_m) of the dies."""
    places = die_places_m(wafer)
    distance = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    return np.asarray(np.linalg.cholesky(np.exp(-distance / wafer.correlation_m)))


def sample_wafers(process: Process, seed: int, wafers: Iterable[int]) -> Sampled:
    """All devices of the wafers, in their order."""
    numbers = np.fromiter(wafers, np.int64)
    places = die_places_m(process.wafer)
    dies = len(places)
    root = _field_root(process.wafer)
    each = [_of_wafer(seed, int(w), root) for w in numbers]
    parts = [np.concatenate(part) for part in zip(*each, strict=True)]  # (wafers D, ..., sources)
    deviates = {
        name: Deviates(*(np.ascontiguousarray(part[..., k]) for part in parts)) for k, name in enumerate(SOURCES)
    }
    device = (numbers[:, None] * dies + np.arange(dies)).ravel()
    return Sampled(device, np.tile(places, (len(numbers), 1)), deviates)


def sample_devices(process: Process, seed: int, first: int, count: int) -> Sampled:
    """Devices ``first`` to ``first + count``."""
    dies = dies_per_wafer(process)
    begin = first // dies
    whole = sample_wafers(process, seed, range(begin, -(-(first + count) // dies)))
    return whole.take(slice(first - begin * dies, first - begin * dies + count))


def sample_numbered(process: Process, seed: int, numbers: NDArray[np.int64]) -> Sampled:
    """Devices of any numbers (n,), in their order."""
    dies = dies_per_wafer(process)
    wafers, at = np.unique(numbers // dies, return_inverse=True)
    return sample_wafers(process, seed, wafers.tolist()).take(at * dies + numbers % dies)


def _of_wafer(seed: int, wafer: int, root: Array) -> tuple[Array, Array, Array, Array]:
    """``Deviates`` of a wafer's dies, sources last."""
    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=(wafer,))))
    dies, n = len(root), len(SOURCES)
    whole = rng.standard_normal((n, 3))
    field = root @ rng.standard_normal((dies, n))
    chain = rng.standard_normal((dies, 3, n))
    return (
        np.broadcast_to(whole[:, 0], (dies, n)),
        np.broadcast_to(whole[:, 1:].T, (dies, 2, n)),
        field,
        chain,
    )


def sizes(process: Process, sampled: Sampled) -> dict[str, Array]:
    """What each device has of each quantity (n, 3), by ``SOURCES``: each chain at its own place on the wafer."""
    wafer = process.wafer
    angles = np.array(CHAIN_ANGLES_RAD)
    outward = -wafer.chain_radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    there = (sampled.place_m[:, None] + outward) / wafer.usable_radius_m
    return {name: _size(getattr(process, name), there, sampled.deviates[name]) for name in SOURCES}


def _size(spread: Spread, there: Array, d: Deviates) -> Array:
    square = np.einsum("nic,nic->ni", there, there)
    slope = np.einsum("nic,nc->ni", there, d.tilt)
    common = spread.mean + spread.wafer * d.wafer + spread.die * d.die
    return np.asarray(common[:, None] + spread.tilt * slope + spread.bowl * (square - 0.5) + spread.chain * d.chain)

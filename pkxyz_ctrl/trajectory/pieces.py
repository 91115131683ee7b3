"""Pieces of constant jerk: the form of every motion that limits on velocity, acceleration and jerk shape."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pkxyz_ctrl.trajectory.motion import Array, at_rest

_MERGE_S = 1e-12  # break points of two axes closer than this are one: at 100 m/s2 it moves a velocity by 0.1 nm/s


class Pieces(NamedTuple):
    """n pieces in sequence; in each one jerk is constant, and the state at its start is stored, not summed up."""

    duration_s: Array
    """(n,), each > 0"""
    state: Array
    """(n, 3, 3): position (m), velocity (m/s), acceleration (m/s2) at the start of the piece, by axis x, y, z"""
    jerk_m_per_s3: Array
    """(n, 3)"""

    @property
    def total_s(self) -> float:
        """Sum of the durations in s."""
        return float(self.duration_s.sum())

    def end(self) -> Array:
        """State (3, 3) at the end of the last piece."""
        return advance(self.state[-1], self.jerk_m_per_s3[-1], float(self.duration_s[-1]))

    def sample(self, t_s: Array) -> Array:
        """(n, 9) at instants (n,): cubic in time inside each piece."""
        start_s = np.concatenate([[0.0], np.cumsum(self.duration_s[:-1])])
        piece = np.maximum(np.searchsorted(start_s, t_s, side="right") - 1, 0)
        t = (t_s - start_s[piece])[:, None]
        p, v, a = np.moveaxis(self.state[piece], 1, 0)
        j = self.jerk_m_per_s3[piece]
        out = np.empty((len(t_s), 9))
        out[:, 0:3] = p + t * (v + t * (a / 2 + t * (j / 6)))
        out[:, 3:6] = v + t * (a + t * (j / 2))
        out[:, 6:9] = a + t * j
        return out


class Phases(NamedTuple):
    """Jerk of one axis: ``jerk_m_per_s3[i]`` for ``duration_s[i]``."""

    duration_s: Sequence[float]
    jerk_m_per_s3: Sequence[float]


def advance(state: Array, jerk_m_per_s3: Array, duration_s: float) -> Array:
    """State (3, 3) after ``duration_s`` of constant jerk (3,)."""
    p, v, a = state
    t, j = duration_s, jerk_m_per_s3
    return np.array([p + t * (v + t * (a / 2 + t * j / 6)), v + t * (a + t * j / 2), a + t * j])


def still(position_m: Array, duration_s: float) -> Pieces:
    """One piece of standing still."""
    return Pieces(np.array([duration_s]), at_rest(position_m)[None], np.zeros((1, 3)))


def from_phases(start: Array, axes: Sequence[Phases], total_s: float) -> Pieces:
    """Pieces that run the jerk phases of three axes at once from the state ``start`` (3, 3), for ``total_s``."""
    ends = [np.cumsum(axis.duration_s) for axis in axes]
    breaks = np.unique(np.concatenate([*ends, [0.0, total_s]]).clip(0.0, total_s))
    breaks = breaks[np.append(np.diff(breaks) > _MERGE_S, True)]  # of near twins the later stays, so total_s does
    breaks[0] = 0.0
    duration = np.diff(breaks)
    middle = breaks[:-1] + duration / 2
    jerk = np.zeros((len(duration), 3))
    for i, (axis, end) in enumerate(zip(axes, ends, strict=True)):
        phase = np.searchsorted(end, middle, side="right")
        jerk[:, i] = np.append(axis.jerk_m_per_s3, 0.0)[np.minimum(phase, len(end))]
    state = np.empty((len(duration), 3, 3))
    now = start
    for n in range(len(duration)):
        state[n] = now
        now = advance(now, jerk[n], duration[n])
    return Pieces(duration, state, jerk)


def joined(parts: Sequence[Pieces]) -> Pieces:
    """The parts one after another."""
    return Pieces(
        np.concatenate([p.duration_s for p in parts]),
        np.concatenate([p.state for p in parts]),
        np.concatenate([p.jerk_m_per_s3 for p in parts]),
    )

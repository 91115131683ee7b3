"""What a trajectory consists of: motions, each of which says where it is at any instant of its own time."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.files import ConfigError

Array = NDArray[np.float64]


class TrajectoryError(ConfigError):
    """A reference that can't be planned or that the device can't follow. The message says where and which limit."""


class Motion(Protocol):
    """A stretch of a trajectory, in s since its own start."""

    @property
    def total_s(self) -> float:
        """How long it lasts."""
        ...

    def end(self) -> Array:
        """State (3, 3) at ``total_s``: rows position (m), velocity (m/s), acceleration (m/s2)."""
        ...

    def sample(self, t_s: Array) -> Array:
        """(n, 9): position (m), velocity (m/s), acceleration (m/s2) at instants (n,) of 0 to ``total_s``, in order.

        Every instant by itself: its bits don't depend on the others.
        """
        ...


def at_rest(position_m: Array | tuple[float, float, float] | list[float]) -> Array:
    """State (3, 3) of standing still at a position (3,)."""
    return np.array([position_m, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)], dtype=np.float64)

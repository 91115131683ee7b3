"""Sums of sinusoids under an envelope: what every periodic segment is made of."""

import math
from dataclasses import dataclass

import numpy as np

from pkxyz_ctrl.trajectory.motion import Array, at_rest


def envelope(t_s: Array, lead_s: float, total_s: float) -> tuple[Array, Array, Array]:
    """Amplitude (n,) with its first and second derivative (1/s, 1/s2): 0 to 1 in ``lead_s``, and back at the end.

    The quintic 10 s^3 - 15 s^4 + 6 s^5 has no slope and no curvature at either end, so whatever it multiplies starts
    and ends at rest and without acceleration, and at full amplitude goes on as if it had always been there.
    """
    falling = t_s > total_s / 2
    s = np.clip(np.where(falling, total_s - t_s, t_s) / lead_s, 0.0, 1.0)
    way = np.where(falling, -1.0, 1.0)
    value = s * s * s * (10 + s * (6 * s - 15))
    slope = way * 30 * s * s * (1 - s) * (1 - s) / lead_s
    curvature = 60 * s * (1 - s) * (1 - 2 * s) / lead_s**2
    return value, slope, curvature


def enveloped(shape: tuple[Array, Array, Array], amplitude: tuple[Array, Array, Array], centre_m: Array) -> Array:
    """(n, 9) of ``centre + amplitude * shape``, from derivatives 0, 1, 2 of shape (n, 3) and amplitude (n,)."""
    (c, c1, c2), (e, e1, e2) = shape, (a[:, None] for a in amplitude)
    return np.concatenate([centre_m + e * c, e1 * c + e * c1, e2 * c + 2 * e1 * c1 + e * c2], axis=1)


def sin_cos(turns: Array) -> tuple[Array, Array]:
    """Sine and cosine of an angle in turns: whole turns are dropped before the angle is rounded to radians."""
    angle = 2 * math.pi * (turns - np.floor(turns))
    return np.sin(angle), np.cos(angle)


@dataclass(frozen=True)
class Tones:
    """Sums of sinusoids about a point, ``sum_i amplitude_i sin(2 pi frequency_i t + phase_i)`` for each axis.

    t counts from the start of the full amplitude.
    """

    centre_m: Array
    """(3,)"""
    amplitude_m: Array
    """(k, 3)"""
    frequency_hz: Array
    """(k, 3)"""
    phase_rad: Array
    """(k, 3)"""
    lead_s: float
    full_s: float
    """how long it lasts at full amplitude"""

    @property
    def total_s(self) -> float:
        """With lead-in and lead-out."""
        return self.full_s + 2 * self.lead_s

    def end(self) -> Array:
        """At rest at the centre."""
        return at_rest(self.centre_m)

    def sample(self, t_s: Array) -> Array:
        """(n, 9) at instants (n,)."""
        t = (t_s - self.lead_s)[:, None]
        position, velocity, acceleration = (np.zeros((len(t_s), 3)) for _ in range(3))
        for a, f, phase in zip(self.amplitude_m, self.frequency_hz, self.phase_rad, strict=True):
            sine, cosine = sin_cos(f * t + phase / (2 * math.pi))
            omega = 2 * math.pi * f
            position += a * sine
            velocity += a * omega * cosine
            acceleration -= a * omega * omega * sine
        return enveloped((position, velocity, acceleration), envelope(t_s, self.lead_s, self.total_s), self.centre_m)

"""Swept sine: one axis to and fro with a frequency that runs from one value to another."""

import math
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from pydantic import model_validator

from pkxyz_ctrl.config.files import FrozenModel
from pkxyz_ctrl.trajectory.motion import Array, TrajectoryError, at_rest
from pkxyz_ctrl.trajectory.periodic import LEAD_S, Axis, Lead, unit
from pkxyz_ctrl.trajectory.segments import Plan, Positive
from pkxyz_ctrl.trajectory.tones import envelope, enveloped, sin_cos

_LEAD_MAX_DECADES = 6


class Sweep(FrozenModel):
    """A sine whose frequency runs from ``from_hz`` to ``to_hz``, up or down, at one amplitude.

    In lead-in and lead-out the frequency runs on by the same law, so that nothing
    bends where the full amplitude begins.
    """

    kind: Literal["sweep"]
    axis: Axis
    amplitude_m: Positive
    from_hz: Positive
    to_hz: Positive
    law: Literal["linear", "logarithmic"] = "logarithmic"
    """linear: equal hertz in equal times; logarithmic: equal octaves in equal times"""
    duration_s: Positive
    """at full amplitude"""
    lead_s: Lead = LEAD_S

    @model_validator(mode="after")
    def _sweeps(self) -> Self:
        if self.from_hz == self.to_hz:
            raise ValueError(f"from_hz and to_hz are both {self.to_hz:g} Hz; use kind = 'sine' for one frequency")
        return self

    def plan(self, start_m: Array) -> Plan:
        """The scan is the full amplitude, exactly from one frequency to the other."""
        decades = abs(math.log10(self.to_hz / self.from_hz)) * self.lead_s / self.duration_s
        if self.law == "logarithmic" and decades > _LEAD_MAX_DECADES:
            raise TrajectoryError(
                f"by its law the frequency runs over {decades:.3g} decades in lead-in and lead-out of {self.lead_s:g} "
                f"s each; at most {_LEAD_MAX_DECADES}: give a shorter lead_s or a longer duration_s"
            )
        motion = Chirp(
            start_m, unit(self.axis) * self.amplitude_m, self.from_hz, self.to_hz, self.law == "logarithmic",
            self.lead_s, self.duration_s,
        )  # fmt: skip
        ends = motion.turns(np.array([0.0, motion.total_s]))[1]
        scan_s = (self.lead_s, self.lead_s + self.duration_s)
        return Plan((motion,), start_m, scan_s=scan_s, highest_hz=float(np.abs(ends).max()))


@dataclass(frozen=True)
class Chirp:
    """The motion of a swept sine about a point."""

    centre_m: Array
    """(3,)"""
    amplitude_m: Array
    """(3,)"""
    from_hz: float
    to_hz: float
    logarithmic: bool
    lead_s: float
    full_s: float

    @property
    def total_s(self) -> float:
        """With lead-in and lead-out."""
        return self.full_s + 2 * self.lead_s

    def end(self) -> Array:
        """At rest at the centre."""
        return at_rest(self.centre_m)

    def turns(self, t_s: Array) -> tuple[Array, Array, Array]:
        """Phase in turns since the full amplitude began, frequency in Hz and its rate in Hz/s, each (n,)."""
        t = t_s - self.lead_s
        if self.logarithmic:
            rate = math.log(self.to_hz / self.from_hz) / self.full_s
            frequency = self.from_hz * np.exp(rate * t)
            return self.from_hz * np.expm1(rate * t) / rate, frequency, rate * frequency
        slope = (self.to_hz - self.from_hz) / self.full_s
        return t * (self.from_hz + slope * t / 2), self.from_hz + slope * t, np.full_like(t, slope)

    def sample(self, t_s: Array) -> Array:
        """(n, 9) at instants (n,)."""
        turns, frequency, rate = self.turns(t_s)
        sine, cosine = sin_cos(turns)
        omega = 2 * math.pi * frequency
        bend = 2 * math.pi * rate * cosine - omega * omega * sine
        a, c, c1, c2 = self.amplitude_m, sine[:, None], (omega * cosine)[:, None], bend[:, None]
        return enveloped((a * c, a * c1, a * c2), envelope(t_s, self.lead_s, self.total_s), self.centre_m)

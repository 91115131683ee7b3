"""Archimedean spiral from the middle outward, at constant linear or at constant angular velocity.

``r = growth * angle`` with growth = pitch / 2 pi. Inside the inner radius the angular velocity rises from rest by a
cubic, then it follows its law up to the outer radius, and a little outside comes to rest by such a cubic again.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, Self

import numpy as np
from pydantic import model_validator

from pkxyz_ctrl.config.files import FrozenModel
from pkxyz_ctrl.trajectory.motion import Array, TrajectoryError
from pkxyz_ctrl.trajectory.segments import Plan, Positive


class Spiral(FrozenModel):
    """A spiral in the plane about where the stage stands, counter-clockwise; it ends outside, not at the centre.

    Give ``speed_m_per_s`` for constant linear velocity: samples are equally dense everywhere, and the angular velocity
    is largest at the inner radius. Give ``frequency_hz`` for constant angular velocity: one frequency for the stage to
    follow, and the outer turns are fast.
    """

    kind: Literal["spiral"]
    radius_m: Positive
    """where the law ends; the lead-out goes on for up to ``lead_out_turns`` pitches more"""
    inner_radius_m: Positive
    """where the law begins"""
    pitch_m: Positive
    """distance between turns"""
    speed_m_per_s: Positive | None = None
    frequency_hz: Positive | None = None
    lead_out_turns: Positive = 1.0

    @model_validator(mode="after")
    def _one_law(self) -> Self:
        if (self.speed_m_per_s is None) == (self.frequency_hz is None):
            raise ValueError(
                "give one of speed_m_per_s (constant linear velocity) and frequency_hz (constant angular velocity)"
            )
        if self.inner_radius_m >= self.radius_m:
            raise ValueError(f"inner_radius_m is {self.inner_radius_m:g}, which is not inside radius_m")
        return self

    def plan(self, start_m: Array) -> Plan:
        """Lead-in, law, lead-out; the scan is the law."""
        growth = self.pitch_m / (2 * math.pi)
        first, last = self.inner_radius_m / growth, self.radius_m / growth
        law: _Law
        if self.speed_m_per_s is not None:
            law = _Linear(first, last, self.speed_m_per_s / growth)
        else:
            assert self.frequency_hz is not None
            law = _Angular(first, last, 2 * math.pi * self.frequency_hz)
        (rate_in, bend_in), (rate_out, bend_out) = (
            (float(v[0]) for v in law.angle(np.array([t]))[1:]) for t in (0.0, law.total_s)
        )
        lead_in = _Ramp.up(first, rate_in, bend_in)
        lead_out = _Ramp(last, rate_out, bend_out, 4 * math.pi * self.lead_out_turns / rate_out, rising=False)
        if -bend_out * lead_out.total_s > 3 * rate_out:  # beyond that the cubic crosses zero
            raise TrajectoryError("the lead-out would turn back; lower lead_out_turns or pitch_m, or raise radius_m")
        motions = tuple(_Stretch(start_m, growth, part) for part in (lead_in, law, lead_out))
        begin = lead_in.total_s
        fastest = max(
            float(part.angle(np.linspace(0, part.total_s, 101))[1].max()) for part in (lead_in, law, lead_out)
        )
        return Plan(
            motions, motions[-1].end()[0], scan_s=(begin, begin + law.total_s), highest_hz=fastest / (2 * math.pi)
        )


class _Law(Protocol):
    """The angle as a function of time."""

    @property
    def total_s(self) -> float: ...
    def angle(self, t_s: Array) -> tuple[Array, Array, Array]:
        """Angle in rad, its rate and the rate's rate, each (n,)."""
        ...


class _Angular(NamedTuple):
    """Constant angular velocity."""

    first_rad: float
    last_rad: float
    rate_rad_per_s: float

    @property
    def total_s(self) -> float:
        return (self.last_rad - self.first_rad) / self.rate_rad_per_s

    def angle(self, t_s: Array) -> tuple[Array, Array, Array]:
        rate = self.rate_rad_per_s
        return self.first_rad + rate * t_s, np.full_like(t_s, rate), np.zeros_like(t_s)


class _Linear(NamedTuple):
    """Constant speed: arc length over growth, s = (a sqrt(1 + a^2) + asinh a) / 2 at the angle a, is linear in time."""

    first_rad: float
    last_rad: float
    speed_per_s: float
    """speed over growth"""

    @property
    def total_s(self) -> float:
        ends = _arc(np.array([self.first_rad, self.last_rad]))
        return float(ends[1] - ends[0]) / self.speed_per_s

    def angle(self, t_s: Array) -> tuple[Array, Array, Array]:
        arc = _arc(np.array([self.first_rad])) + self.speed_per_s * t_s
        angle = arc / np.sqrt(1 + arc / 2)  # right at both ends of the scale; 10 % off between
        for _ in range(5):  # Newton on a convex function; a fixed number, so a tick's bits are its own
            angle = angle - (_arc(angle) - arc) / np.sqrt(1 + angle * angle)
        rate = self.speed_per_s / np.sqrt(1 + angle * angle)
        return angle, rate, -rate * rate * angle / (1 + angle * angle)


def _arc(angle: Array) -> Array:
    return (angle * np.sqrt(1 + angle * angle) + np.arcsinh(angle)) / 2


class _Ramp(NamedTuple):
    """From rest to an angular velocity and its rate, or back to rest; angle, rate and the rate's rate are continuous.

    The angular velocity is the cubic with no slope at rest.
    """

    angle_rad: float
    """where it is at full angular velocity"""
    rate_rad_per_s: float
    bend_rad_per_s2: float
    """rate of the angular velocity there"""
    total_s: float
    rising: bool

    @classmethod
    def up(cls, angle_rad: float, rate_rad_per_s: float, bend_rad_per_s2: float) -> "_Ramp":
        """From angle 0: the time follows from angle = T (rate / 2 - bend T / 12)."""
        k = -bend_rad_per_s2 / rate_rad_per_s**2
        total_s = 2 * angle_rad / (0.5 + math.sqrt(0.25 + k * angle_rad / 3)) / rate_rad_per_s
        return cls(angle_rad, rate_rad_per_s, bend_rad_per_s2, total_s, rising=True)

    def angle(self, t_s: Array) -> tuple[Array, Array, Array]:
        """The falling one is the rising one backwards in time."""
        way = 1.0 if self.rising else -1.0
        s = (t_s if self.rising else self.total_s - t_s) / self.total_s
        rate, bend = self.rate_rad_per_s, way * self.bend_rad_per_s2 * self.total_s
        swept = self.total_s * s * s * s * (rate * (1 - s / 2) + bend * (s / 4 - 1 / 3))
        whole = self.total_s * (rate / 2 - bend / 12)
        return (
            self.angle_rad + way * (swept - whole),
            s * s * (rate * (3 - 2 * s) + bend * (s - 1)),
            way * s * (rate * (6 - 6 * s) + bend * (3 * s - 2)) / self.total_s,
        )


@dataclass(frozen=True)
class _Stretch:
    """The spiral while its angle follows one law."""

    centre_m: Array
    """(3,)"""
    growth_m_per_rad: float
    law: _Law

    @property
    def total_s(self) -> float:
        return self.law.total_s

    def end(self) -> Array:
        """State (3, 3)."""
        return self.sample(np.array([self.total_s])).reshape(3, 3)

    def sample(self, t_s: Array) -> Array:
        """(n, 9) at instants (n,): the chain rule on r = growth * angle."""
        angle, rate, bend = (v[:, None] for v in self.law.angle(t_s))
        turn = angle - 2 * math.pi * np.floor(angle / (2 * math.pi))
        out_, around = _axes(turn)
        a = self.growth_m_per_rad
        first = a * (out_ + angle * around)
        second = a * (2 * around - angle * out_)
        return np.concatenate(
            [self.centre_m + a * angle * out_, first * rate, second * rate * rate + first * bend], axis=1
        )


def _axes(angle: Array) -> tuple[Array, Array]:
    """Unit vectors (n, 3) outward and along the turn at angles (n, 1)."""
    cosine, sine, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return np.concatenate([cosine, sine, zero], axis=1), np.concatenate([-sine, cosine, zero], axis=1)

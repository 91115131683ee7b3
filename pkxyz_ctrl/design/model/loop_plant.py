"""What a law sees of the stage: from the force that it asks for to the position that it samples, all delays included.

Linear about one point of the workspace, and exactly sampled. With w the force asked for at sample k::

    m x'' + C x' + (K - G) x = f,   tau f' = E w(k - d) - f,   tau_s y' = x - y

d periods lie between sample and action, tau is the amplifier's time constant, tau_s the sense chain's lag. G is the
part of the stiffness that the held comb forces take away (they turn with the platform), and E the error of the combs.

A device may differ from that in its numbers, in its delay (d need not be whole then), by a further such pole, and
by parasitic modes r'' + d r' + w^2 r = share w^2 K^-1 f, which are seen beside x and do not act back on it.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.design.model.plant_model import amplifier_time_constant_s, linearise
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]

SenseLag = Literal["filter", "delay", "amplifier"]
"""What the sense chain's lag is taken for: the filter that it mostly is, a delay that weakens nothing, or, for a law
with as many states as its plant, a part of the amplifier's pole.
"""


@dataclass(frozen=True)
class ParasiticMode:
    """One mode beside the rigid motion, alike in x, y and z."""

    frequency_hz: float
    quality_factor: float
    compliance_share: float
    """its static answer to a force over that of the stage"""


@dataclass(frozen=True)
class Perturbation:
    """How a device differs from its drawing. Relative errors; 0.2 is 20 % more."""

    stiffness: float = 0.0
    mass: float = 0.0
    quality_factor: float | None = None
    """None: as in the stage file"""
    comb_gain: tuple[float, float, float] = (0.0, 0.0, 0.0)
    delay_s: float = 0.0
    """more between sample and action than the bus says, or less"""
    amplifier_bandwidth: float = 0.0
    sense_bandwidth_hz: float | None = None
    """corner of the sense chain, beside what the stage file says of it; None: far away"""
    parasitic: tuple[ParasiticMode, ...] = ()

    def __post_init__(self) -> None:
        if min(self.stiffness, self.mass, self.amplifier_bandwidth, *self.comb_gain) <= -1.0:
            raise ValueError(f"a relative error of -1 or less leaves no stage: {self}")
        if self.quality_factor is not None and self.quality_factor <= 0.0:
            raise ValueError(f"quality_factor must be positive, not {self.quality_factor}")


NOMINAL = Perturbation()
_ACROSS = tuple(
    np.array([math.cos(angle), math.sin(angle), 0.0])
    for angle in (math.radians(d + 90.0) for d in (90.0, 210.0, 330.0))
)
"""Across the strokes of the chains."""
_SQUARES = tuple(np.outer(across, across) for across in _ACROSS)


@dataclass(frozen=True)
class LoopPlant:
    """x+ = A x + B w, y = C x at the samples: the force w (3,) in N at the platform that the law asks for at a sample,
    the position y (3,) in m about the operating point that is measured there.
    """

    period_s: float
    a: Array
    b: Array
    c: Array
    strokes_m: Array
    stiffness_n_per_m: Array
    """(3,3) felt under held comb forces: K - G"""

    def axis(self, index: int) -> "LoopPlant":
        """The plant of axis 0, 1 or 2 (x, y, z) alone, without what couples it to the others. Matrices of one input."""
        keep = slice(index, None, 3)
        return LoopPlant(
            self.period_s,
            self.a[keep, keep],
            self.b[keep, keep],
            self.c[keep, keep],
            self.strokes_m,
            self.stiffness_n_per_m[keep, keep],
        )


def loop_plant(
    stage: Stage,
    bus: BusConfig,
    strokes_m: ArrayLike,
    perturbation: Perturbation = NOMINAL,
    sense_lag: SenseLag = "filter",
) -> LoopPlant:
    """The plant of a stage on a bus, about the position of ``strokes_m`` (3,), held there by its combs."""
    lag_s, amplifier_s = stage.sense_delay_s, amplifier_time_constant_s(stage)
    if sense_lag == "delay":
        lag_s, perturbation = 0.0, replace(perturbation, delay_s=perturbation.delay_s + lag_s)
    elif sense_lag == "amplifier":
        lag_s, amplifier_s = 0.0, amplifier_s + lag_s
    strokes = np.asarray(strokes_m, dtype=np.float64)
    model = linearise(stage, strokes)
    mass = model.mass_kg * (1.0 + perturbation.mass)
    # every spring changes alike, and with them the forces that hold the point
    stiffness = (model.stiffness_n_per_m - held_force_softening(stage, model.position_m)) * (
        1.0 + perturbation.stiffness
    )
    damping = model.damping_n_s_per_m * math.sqrt((1.0 + perturbation.mass) * (1.0 + perturbation.stiffness))
    if perturbation.quality_factor is not None:
        damping = damping * stage.quality_factor / perturbation.quality_factor
    rows = stage.pulls(model.position_m).T
    comb_error = rows @ np.diag(1.0 + np.array(perturbation.comb_gain)) @ np.linalg.inv(rows)
    device = _Device(
        stiffness,
        damping,
        mass,
        comb_error,
        amplifier_s / (1.0 + perturbation.amplifier_bandwidth),
    )
    a, b, c = device.continuous(lag_s, perturbation)
    a, b = _sampled(a, b, bus.period_s, bus.delay_periods * bus.period_s + perturbation.delay_s)
    c = np.hstack([c, np.zeros((3, len(a) - c.shape[1]))])
    return LoopPlant(bus.period_s, a, b, c, strokes, stiffness)


def held_force_softening(stage: Stage, position_m: Array, force_n: Array | None = None) -> Array:
    """G (3,3) in N/m: sum of F_i times the second derivative of stroke i, by default
    for the forces that hold the position.

    From q_i = p.e_i - sqrt(L2^2 - z^2) - sqrt(L1^2 - (p.n_i)^2) + const (the paper's Eq. 8 with its signs put right).
    """
    geometry = stage.geometry[0]
    force = stage.holding_forces(position_m) if force_n is None else force_n
    crank, link = float(geometry["crank_m"]), float(geometry["link_m"])
    height = float(geometry["height_rest_m"]) + position_m[2]
    g = np.zeros((3, 3))
    for i, across in enumerate(_ACROSS):
        offset = float(across @ position_m)
        g += force[i] * _SQUARES[i] * crank**2 / (crank**2 - offset**2) ** 1.5
        g[2, 2] += force[i] * link**2 / (link**2 - height**2) ** 1.5
    return g


@dataclass(frozen=True)
class _Device:
    """What stands between a force that is asked for and the motion."""

    stiffness: Array
    damping: Array
    mass: float
    comb_error: Array
    amplifier_s: float

    def continuous(self, sense_filter_s: float, change: Perturbation) -> tuple[Array, Array, Array]:
        """A, B (n,3) and C (3,n) of the states x, v, f, the parasitic modes' r and r', and the sense chain's, each of
        three, for a force asked for as the input.
        """
        eye, modes = np.eye(3), change.parasitic
        poles = [] if sense_filter_s == 0.0 else [1.0 / sense_filter_s]
        if change.sense_bandwidth_hz is not None:
            poles.append(2.0 * math.pi * change.sense_bandwidth_hz)
        n = 9 + 6 * len(modes) + 3 * len(poles)
        a, b, c = np.zeros((n, n)), np.zeros((n, 3)), np.zeros((3, n))
        a[0:3, 3:6] = eye
        a[3:6, 0:3], a[3:6, 3:6], a[3:6, 6:9] = -self.stiffness / self.mass, -self.damping / self.mass, eye / self.mass
        a[6:9, 6:9], b[6:9] = -eye / self.amplifier_s, self.comb_error / self.amplifier_s
        c[:, 0:3] = eye
        for k, mode in enumerate(modes):
            r, v = slice(9 + 6 * k, 12 + 6 * k), slice(12 + 6 * k, 15 + 6 * k)
            w = 2.0 * math.pi * mode.frequency_hz
            a[r, v], a[v, r], a[v, v] = eye, -w * w * eye, -w / mode.quality_factor * eye
            a[v, 6:9] = mode.compliance_share * w * w * np.linalg.inv(self.stiffness)
            c[:, r] = eye
        for k, w in enumerate(poles):
            seen = slice(9 + 6 * len(modes) + 3 * k, 12 + 6 * len(modes) + 3 * k)
            a[seen] = w * c
            a[seen, seen] = -w * eye
            c = np.zeros((3, n))
            c[:, seen] = eye
        return a, b, c


def _sampled(a: Array, b: Array, period_s: float, delay_s: float) -> tuple[Array, Array]:
    """A and B of the sampled plant, a line of the forces that wait for their time behind its states, newest first.

    The force of sample k acts ``delay_s`` after it for a period. Raises ``ValueError`` for a delay below 0.
    """
    if delay_s < 0.0:
        raise ValueError(f"a force can't act {-delay_s * 1e6:g} us before the sample that it answers")
    periods = int(delay_s / period_s + 1e-9)
    rest_s = max(0.0, delay_s - periods * period_s)  # for so long in a period the force before still acts
    n, waiting = len(a), periods + (1 if rest_s > 1e-9 * period_s else 0)
    late, early = _held(a, b, rest_s), _held(a, b, period_s - rest_s)
    phi, last, newer = early[0] @ late[0], early[0] @ late[1], early[1]
    total = n + 3 * waiting
    sampled, enters = np.zeros((total, total)), np.zeros((total, 3))
    sampled[:n, :n] = phi
    if waiting == 0:
        enters[:n] = newer
        return sampled, enters
    enters[n : n + 3] = np.eye(3)
    for i in range(1, waiting):
        sampled[n + 3 * i : n + 3 * i + 3, n + 3 * i - 3 : n + 3 * i] = np.eye(3)
    if waiting == periods:
        sampled[:n, total - 3 :] = newer
    else:
        sampled[:n, total - 3 :] = last
        if waiting > 1:
            sampled[:n, total - 6 : total - 3] = newer
        else:
            enters[:n] = newer
    return sampled, enters


def _held(a: Array, b: Array, time_s: float) -> tuple[Array, Array]:
    """Phi and Gamma over a time for a held input."""
    n = len(a)
    if time_s == 0.0:
        return np.eye(n), np.zeros((n, 3))
    augmented = np.zeros((n + 3, n + 3))
    augmented[:n, :n], augmented[:n, n:] = a, b
    exponential = scipy.linalg.expm(augmented * time_s)
    return exponential[:n, :n], exponential[:n, n:]

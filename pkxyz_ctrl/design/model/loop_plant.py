"""What a law sees of the stage: from the force that it asks for to the position that it samples, all delays included.

Linear about one point of the workspace, and exactly sampled. With w the force asked for at sample k::

    m x'' + C x' + (K - G) x = f,   tau f' = E w(k - d) - f,   y = x - tau_s x'

d periods lie between sample and action, tau is the amplifier's time constant, tau_s the sense chain's delay. G is the
part of the stiffness that the held comb forces take away (they turn with the platform), and E the error of the combs.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.design.model.plant_model import linearise
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Perturbation:
    """How a device differs from its drawing. Relative errors; 0.2 is 20 % more."""

    stiffness: float = 0.0
    mass: float = 0.0
    quality_factor: float | None = None
    """None: as in the stage file"""
    comb_gain: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if min(self.stiffness, self.mass, *self.comb_gain) <= -1.0:
            raise ValueError(f"a relative error of -1 or less leaves no stage: {self}")
        if self.quality_factor is not None and self.quality_factor <= 0.0:
            raise ValueError(f"quality_factor must be positive, not {self.quality_factor}")


NOMINAL = Perturbation()


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


def loop_plant(stage: Stage, bus: BusConfig, strokes_m: ArrayLike, perturbation: Perturbation = NOMINAL) -> LoopPlant:
    """The plant of a stage on a bus, about the position of ``strokes_m`` (3,), held there by its combs."""
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
    phi, gamma = _sampled(stiffness, damping, mass, comb_error, _amplifier_s(stage), bus.period_s)
    a, b = _delayed(phi, gamma, bus.delay_periods)
    c = np.zeros((3, len(a)))
    c[:, 0:3] = np.eye(3)
    c[:, 3:6] = -stage.sense_delay_s * np.eye(3)
    return LoopPlant(bus.period_s, a, b, c, strokes, stiffness)


def held_force_softening(stage: Stage, position_m: Array, force_n: Array | None = None) -> Array:
    """G (3,3) in N/m: sum of F_i times the second derivative of stroke i, by default for the forces that hold the
    position.

    From q_i = p.e_i - sqrt(L2^2 - z^2) - sqrt(L1^2 - (p.n_i)^2) + const (the paper's Eq. 8 with its signs put right).
    """
    geometry = stage.geometry[0]
    force = stage.holding_forces(position_m) if force_n is None else force_n
    crank, link = float(geometry["crank_m"]), float(geometry["link_m"])
    height = float(geometry["height_rest_m"]) + position_m[2]
    g = np.zeros((3, 3))
    for i, degrees in enumerate((90.0, 210.0, 330.0)):
        angle = math.radians(degrees + 90.0)
        across = np.array([math.cos(angle), math.sin(angle), 0.0])
        offset = float(across @ position_m)
        g += force[i] * np.outer(across, across) * crank**2 / (crank**2 - offset**2) ** 1.5
        g[2, 2] += force[i] * link**2 / (link**2 - height**2) ** 1.5
    return g


def _amplifier_s(stage: Stage) -> float:
    return 1.0 / (2.0 * math.pi * stage.config.amplifier.bandwidth_hz)


def _sampled(
    stiffness: Array, damping: Array, mass: float, comb_error: Array, amplifier_s: float, period_s: float
) -> tuple[Array, Array]:
    """Phi (9,9) and Gamma (9,3) over a period, for the states x, v, f and a force asked for that is held."""
    augmented = np.zeros((12, 12))
    augmented[0:3, 3:6] = np.eye(3)
    augmented[3:6, 0:3] = -stiffness / mass
    augmented[3:6, 3:6] = -damping / mass
    augmented[3:6, 6:9] = np.eye(3) / mass
    augmented[6:9, 6:9] = -np.eye(3) / amplifier_s
    augmented[6:9, 9:12] = comb_error / amplifier_s
    exponential = scipy.linalg.expm(augmented * period_s)
    return exponential[:9, :9], exponential[:9, 9:]


def _delayed(phi: Array, gamma: Array, periods: int) -> tuple[Array, Array]:
    """A line of ``periods`` forces in front of the plant; the one at its end acts now."""
    n = len(phi) + 3 * periods
    a, b = np.zeros((n, n)), np.zeros((n, 3))
    a[: len(phi), : len(phi)] = phi
    a[: len(phi), n - 3 :] = gamma
    for i in range(1, periods):
        a[n - 3 * i : n - 3 * i + 3, n - 3 * i - 3 : n - 3 * i] = np.eye(3)
    b[len(phi) : len(phi) + 3] = np.eye(3)
    return a, b

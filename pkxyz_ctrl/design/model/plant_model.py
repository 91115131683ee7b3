"""Linear models of the stage for design: continuous about an operating point, and sampled with the amplifier's pole.

States are [x, v, d]: platform position about the operating point (m), velocity (m/s), disturbance force (N); the
input is a force at the platform (N), the output the position that the sense combs show.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LinearStage:
    """m x'' + C x' + K (x - x_0) = w + d about an operating point x_0. Matrices (3,3), SI."""

    position_m: Array
    mass_kg: float
    damping_n_s_per_m: Array
    stiffness_n_per_m: Array
    jacobian: Array

    @property
    def a(self) -> Array:
        """(9,9) of the continuous model s' = A s + B w with s = [x - x_0, v, d]."""
        a = np.zeros((9, 9))
        a[0:3, 3:6] = np.eye(3)
        a[3:6, 0:3] = -self.stiffness_n_per_m / self.mass_kg
        a[3:6, 3:6] = -self.damping_n_s_per_m / self.mass_kg
        a[3:6, 6:9] = np.eye(3) / self.mass_kg
        return a

    @property
    def b(self) -> Array:
        """(9,3) of the continuous model."""
        b = np.zeros((9, 3))
        b[3:6] = np.eye(3) / self.mass_kg
        return b


def linearise(stage: Stage, strokes_m: Array) -> LinearStage:
    """The stage about the position of given strokes. Damping is modal: every mode
    at rest has the stage's quality factor.

    C = sqrt(m) K(0)^(1/2) / Q, which damps a mode of angular frequency omega by m omega / Q.
    """
    position = stage.forward_kinematics(strokes_m)
    root = scipy.linalg.sqrtm(stage.stiffness(np.zeros(3))).real
    return LinearStage(
        position_m=position,
        mass_kg=stage.mass_kg,
        damping_n_s_per_m=math.sqrt(stage.mass_kg) * root / stage.quality_factor,
        stiffness_n_per_m=stage.stiffness(position),
        jacobian=stage.jacobian(position),
    )


@dataclass(frozen=True)
class SampledStage:
    """s+ = Phi s + Gamma w + Gamma_lag (w_old - w) over a period, w held, approached through the amplifier's pole."""

    period_s: float
    phi: Array  # (9,9)
    gamma: Array  # (9,3)
    gamma_lag: Array  # (9,3)


def amplifier_time_constant_s(stage: Stage) -> float:
    """Time constant of the amplifier's first-order approach to a new voltage."""
    return 1.0 / (2.0 * math.pi * stage.config.amplifier.bandwidth_hz)


def sample(model: LinearStage, period_s: float, amplifier_time_constant_s: float) -> SampledStage:
    """Exact sampling: the matrix exponential of [A B B; 0 0 0; 0 0 -1/tau], whose
    last block is the amplifier's approach.
    """
    augmented = np.zeros((15, 15))
    augmented[:9, :9] = model.a
    augmented[:9, 9:12] = model.b
    augmented[:9, 12:15] = model.b
    augmented[12:15, 12:15] = -np.eye(3) / amplifier_time_constant_s
    exponential = scipy.linalg.expm(augmented * period_s)
    return SampledStage(period_s, exponential[:9, :9], exponential[:9, 9:12], exponential[:9, 12:15])

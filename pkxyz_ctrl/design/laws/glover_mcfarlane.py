"""H-infinity loop shaping: the law that bears the largest error in the coprime factors of a shaped plant.

McFarlane and Glover, IEEE Trans. Automatic Control 37 (1992) 759; formulas with D as in Skogestad and Postlethwaite,
Multivariable Feedback Control, 9.4.1. With R = I + D D^T, S = I + D^T D and A_0 = A - B S^-1 D^T C::

    A_0^T X + X A_0 - X B S^-1 B^T X + C^T R^-1 C = 0
    A_0 Z + Z A_0^T - Z C^T R^-1 C Z + B S^-1 B^T = 0
    gamma_opt = sqrt(1 + lambda_max(X Z)),   1 / gamma_opt: the error that can be borne

For a stage the plant is sampled and delayed, and goes to the continuous domain and back by w = (z - 1) / (z + 1), which
changes no infinity norm: gamma holds for the loop that runs, and nothing is approximated.
"""

import math
from typing import NamedTuple

import control
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from pkxyz_ctrl.config.laws import ShapingWeight
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError, discretise, siso, stack
from pkxyz_ctrl.design.model.loop_plant import LoopPlant

Array = NDArray[np.float64]


class LoopShaping(NamedTuple):
    """A synthesis for a continuous shaped plant."""

    gamma_opt: float
    gamma: float
    """of the controller: somewhat larger, as the optimal one is degenerate"""
    controller: control.StateSpace
    """for negative feedback, u = -K y; the weight is not in it"""


def loop_shaping(shaped: control.StateSpace, factor: float = 1.1) -> LoopShaping:
    """The controller that has ``factor`` times the least gamma for a continuous shaped plant, stabilisable and
    detectable. Raises ``LawError`` for a factor that is not above 1, and where a Riccati equation has no solution.
    """
    if not factor > 1.0:
        raise LawError(f"factor must be above 1, not {factor:g}: at 1 the controller is degenerate")
    a, b, c, d = (np.asarray(m, dtype=np.float64) for m in (shaped.A, shaped.B, shaped.C, shaped.D))
    x, z = _riccati(a, b, c, d)
    gamma_opt = math.sqrt(1.0 + float(np.abs(np.linalg.eigvals(x @ z)).max()))
    gamma = factor * gamma_opt
    s = np.eye(b.shape[1]) + d.T @ d
    f = -np.linalg.solve(s, d.T @ c + b.T @ x)
    l = (1.0 - gamma**2) * np.eye(len(a)) + x @ z  # noqa: E741
    observer = gamma**2 * np.linalg.solve(l.T, z @ c.T)
    controller = control.ss(a + b @ f + observer @ (c + d @ f), observer, -b.T @ x, d.T)
    return LoopShaping(gamma_opt, gamma, controller)


def _riccati(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array]:
    """X and Z of the two equations."""
    r, s = np.eye(len(c)) + d @ d.T, np.eye(b.shape[1]) + d.T @ d
    a0 = a - b @ np.linalg.solve(s, d.T @ c)
    outer = c.T @ np.linalg.solve(r, c)
    inner = b @ np.linalg.solve(s, b.T)
    try:
        x = scipy.linalg.solve_continuous_are(a0, b, (outer + outer.T) / 2, s)
        z = scipy.linalg.solve_continuous_are(a0.T, c.T, (inner + inner.T) / 2, r)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise LawError(f"loop shaping: a Riccati equation has no solution ({error}); change the weights") from error
    return x, z


# All searched on fd_5k: the widest |S| < -3 dB with Ms <= 2, a disk margin of 0.6 and 1.5 nm of hold noise.
WEIGHT_PLANE = ShapingWeight(integral_hz=739.0, zeros_hz=718.0, zeros_damping=0.18, lag_hz=26900.0)
WEIGHT_Z = ShapingWeight(integral_hz=424.0, zeros_hz=701.0, zeros_damping=0.042, lag_hz=7850.0)
"""... and robust where stiffness is 20 %, mass 10 % or a comb 10 % off (Ms 3.4 at worst): the default"""
WIDEST_PLANE = ShapingWeight(integral_hz=749.0, zeros_hz=623.0, zeros_damping=0.123, lag_hz=11800.0)
WIDEST_Z = ShapingWeight(integral_hz=767.0, zeros_hz=773.0, zeros_damping=0.103, lag_hz=13600.0)
"""... for the stage as drawn only"""


class StageShaping(NamedTuple):
    """A law and what it bears on each axis: gamma_opt (3,), and gamma (3,) as reached."""

    law: DiscreteLaw
    gamma_opt: Array
    gamma: Array


def hinf(
    plant: LoopPlant,
    weights: tuple[ShapingWeight, ShapingWeight, ShapingWeight] = (WEIGHT_PLANE, WEIGHT_PLANE, WEIGHT_Z),
    factor: float = 1.1,
) -> StageShaping:
    """Loop shaping of each axis of a sampled, delayed plant. Raises ``LawError`` for weights that can't be used."""
    axes, optimal, reached = [], [], []
    for i in range(3):
        axis = plant.axis(i)
        weight = discretise(_weight(weights[i], float(axis.stiffness_n_per_m[0, 0])), plant.period_s)
        shaped = control.ss(axis.a, axis.b, axis.c, 0.0, plant.period_s) * weight
        synthesis = loop_shaping(_to_continuous(shaped), factor)
        axes.append(weight * _to_discrete(synthesis.controller, plant.period_s))
        optimal.append(synthesis.gamma_opt)
        reached.append(synthesis.gamma)
    return StageShaping(stack(plant.period_s, axes), np.array(optimal), np.array(reached))


def _weight(weight: ShapingWeight, stiffness_n_per_m: float) -> control.StateSpace:
    integral, zeros, lag = (2.0 * math.pi * f for f in (weight.integral_hz, weight.zeros_hz, weight.lag_hz))
    shape = np.array([1.0 / zeros**2, 2.0 * weight.zeros_damping / zeros, 1.0])
    return siso(control.tf(stiffness_n_per_m * integral * shape, [1.0 / lag, 1.0, 0.0]))


def _to_continuous(system: control.StateSpace) -> control.StateSpace:
    """By w = (z - 1) / (z + 1)."""
    inverse = np.linalg.inv(system.A + np.eye(system.nstates))
    a = (system.A - np.eye(system.nstates)) @ inverse
    root = math.sqrt(2.0)
    return control.ss(a, root * inverse @ system.B, root * system.C @ inverse, system.D - system.C @ inverse @ system.B)


def _to_discrete(system: control.StateSpace, period_s: float) -> control.StateSpace:
    """By z = (1 + w) / (1 - w)."""
    inverse = np.linalg.inv(np.eye(system.nstates) - system.A)
    a = (np.eye(system.nstates) + system.A) @ inverse
    root = math.sqrt(2.0)
    d = system.D + system.C @ inverse @ system.B
    return control.ss(a, root * inverse @ system.B, root * system.C @ inverse, d, period_s)

"""``Stage``: one device's kinematics, forces and combs, in SI units and for arrays of any leading shape.

    >>> stage = Stage.load("reconstructed")
    >>> stage.inverse_kinematics([0.0, 0.0, 10e-6])
    array([6.3...e-06, 6.3...e-06, 6.3...e-06])

Positions are (..., 3), relative to the rest pose of the platform, x and y in the wafer plane, z up. Strokes and comb
quantities are (..., 3), one for each chain at 90, 210 and 330 degrees; strokes are relative to rest, positive inward.
"""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from pkxyz_ctrl.config.calibration import AS_DRAWN, Calibration
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.core import elasticity, kinematics
from pkxyz_ctrl.core.linear3 import inverse3
from pkxyz_ctrl.elements.combs import capacitance_gradient_f_per_m, force_gain_n_per_v2
from pkxyz_ctrl.elements.flexures import crank_hinge_stiffness, folded_spring_stiffness, link_hinge_stiffness

Array = NDArray[np.float64]
Records = NDArray[np.void]


class StageDomainError(ValueError):
    """A position, stroke, force or voltage that the device cannot have. The message says which limit was passed."""


class Stage:
    """The user's handle on one device. Immutable; methods are pure functions of their arguments and the stage file."""

    def __init__(self, config: StageConfig) -> None:
        self.config = config
        measured = config.calibration or Calibration()
        self.geometry = kinematics.geometry_record(config.geometry)
        self.geometry["lift"] = measured.lift
        self.elasticity = np.zeros(1, elasticity.ELASTICITY)
        slider, crank = (4 * k(config.flexures) for k in (folded_spring_stiffness, crank_hinge_stiffness))
        self.elasticity["slider_n_per_m"] = slider * np.array(measured.slider_stiffness)
        self.elasticity["crank_n_m_per_rad"] = crank * np.array(measured.crank_stiffness)
        link = 4 * config.flexures.out_of_plane_chains * link_hinge_stiffness(config.flexures)
        self.elasticity["link_n_m_per_rad"] = link * measured.link_stiffness
        self.geometry.flags.writeable = False
        self.elasticity.flags.writeable = False
        self.mass_kg = config.dynamics.mass_kg
        self.quality_factor = measured.quality_factor or config.dynamics.quality_factor
        delay_s = measured.sense_delay_s
        self.sense_delay_s = config.sense.delay_s if delay_s is None else delay_s
        drawn_f_per_m = capacitance_gradient_f_per_m(config.sense_comb)
        self.force_gain_n_per_v2 = force_gain_n_per_v2(config.drive_comb) * np.array(measured.comb_gain)
        self.sense_gradient_f_per_m = drawn_f_per_m * np.array(measured.sense_gain)
        self.sense_rest_f = drawn_f_per_m * config.sense_comb.overlap_rest_m
        self.voltage_max_v = config.limits.voltage_max_v
        self.force_max_n = self.force_gain_n_per_v2 * self.voltage_max_v**2
        for each in (self.force_gain_n_per_v2, self.sense_gradient_f_per_m, self.force_max_n):
            each.flags.writeable = False

    @classmethod
    def load(cls, name_or_path: str | Path) -> "Stage":
        """A shipped stage ("reconstructed", "printed") or a stage file of one's own. Raises ``ConfigError``."""
        return cls(load("stages", name_or_path, StageConfig))

    def __repr__(self) -> str:
        return f"Stage({self.config.name!r})"

    def inverse_kinematics(self, position_m: ArrayLike) -> Array:
        """Strokes (..., 3) in m for positions (..., 3) in m (Eq. 8); raises
        ``StageDomainError`` where a link can't reach.
        """
        return self._at_positions(position_m, _strokes_each, (3,))

    def forward_kinematics(self, strokes_m: ArrayLike) -> Array:
        """Positions (..., 3) in m for strokes (..., 3) in m, on the assembly branch of the
        rest pose (Newton on the exact closure).

        Raises ``StageDomainError`` for strokes at which the links don't close.
        """
        strokes = _triples(strokes_m, "strokes_m")
        flat = strokes.reshape(-1, 3)
        out = np.empty_like(flat)
        bad = _positions_each(self.geometry, flat, out)
        if bad >= 0:
            raise StageDomainError(f"links do not close at strokes {_um(flat[bad])} um: no position belongs to them")
        return out.reshape(strokes.shape)

    def jacobian(self, position_m: ArrayLike) -> Array:
        """dq/dx (..., 3, 3) at positions (..., 3): row i is the gradient of stroke i. Eq. 12 is its value at rest."""
        return self._at_positions(position_m, _jacobian_each, (3, 3))

    def pulls(self, position_m: ArrayLike) -> Array:
        """Force at the platform by the pull of each comb (..., 3, 3) at positions (..., 3): row i is the gradient of
        stroke i, plus what lifts the comb's fingers.
        """
        return self._at_positions(position_m, _pulls_each, (3, 3))

    def stroke_curvature(self, position_m: ArrayLike) -> Array:
        """d2q/dx2 (..., 3, 3, 3) in 1/m, the chain first: what a constant Jacobian leaves out."""
        return self._at_positions(position_m, _curvature_each, (3, 3, 3))

    def potential_energy(self, position_m: ArrayLike) -> Array:
        """Strain energy (...) in J at positions (..., 3), 0 at rest."""
        return self._at_elastic(position_m, _energy_each, ())

    def energy_gradient(self, position_m: ArrayLike) -> Array:
        """dV/dx (..., 3) in N: the force at the platform that holds it there."""
        return self._at_elastic(position_m, _gradient_each, (3,))

    def stiffness(self, position_m: ArrayLike) -> Array:
        """Hessian of the strain energy (..., 3, 3) in N/m; at rest it is Eq. 19."""
        return self._at_elastic(position_m, _stiffness_each, (3, 3))

    def comb_force(self, voltage_v: ArrayLike) -> Array:
        """Pull (..., 3) in N of the combs at voltages (..., 3) in V (Eq. 33): never negative, the sign of the voltage
        is lost. Where all combs are alike, as drawn, any shape will do.

        Raises ``StageDomainError`` beyond the device's voltage limit.
        """
        voltage = _finite(voltage_v, "voltage_v")
        if np.any(np.abs(voltage) > self.voltage_max_v):
            raise StageDomainError(
                f"voltage {np.abs(voltage).max():.6g} V is beyond the limit of {self.voltage_max_v:g} V"
            )
        return np.asarray(self._for_combs(self.force_gain_n_per_v2, voltage, "voltage_v") * voltage * voltage)

    def comb_voltage(self, force_n: ArrayLike) -> Array:
        """Voltages (..., 3) in V, 0 or positive, at which combs pull with ``force_n`` (..., 3) in N: the square-root
        law. Where all combs are alike, as drawn, any shape will do.

        Raises ``StageDomainError`` for a push (a comb can't) and for a force beyond what the voltage limit gives.
        """
        force = _finite(force_n, "force_n")
        if np.any(force < 0):
            raise StageDomainError(f"force {force.min() * 1e6:.6g} uN is a push, and combs only pull")
        gain = self._for_combs(self.force_gain_n_per_v2, force, "force_n")
        most = self._for_combs(self.force_max_n, force, "force_n")
        if np.any(force > most * (1 + 1e-12)):
            worst = np.argmax(force / most)
            asked, gives, a_volt = (float(np.broadcast_to(v, force.shape).flat[worst]) for v in (force, most, gain))
            raise StageDomainError(
                f"force {asked * 1e6:.6g} uN needs {math.sqrt(asked / a_volt):.1f} V, "
                f"beyond the limit of {self.voltage_max_v:g} V ({gives * 1e6:.6g} uN)"
            )
        return np.asarray(np.minimum(np.sqrt(force / gain), self.voltage_max_v))

    def holding_forces(self, position_m: ArrayLike) -> Array:
        """Comb forces (..., 3) in N that hold a position: F = B^-T dV/dx with ``pulls`` B (Eq. 23). Negative where
        combs would have to push.
        """
        return self._at_elastic(position_m, _holding_each, (3,))

    def holding_voltages(self, position_m: ArrayLike) -> Array:
        """Comb voltages (..., 3) in V that hold a position; ``StageDomainError`` where
        that takes a push or more than the limit.
        """
        force = self.holding_forces(position_m)
        return self.comb_voltage(np.where((force < 0) & (force > -1e-15), 0.0, force))

    def sense_capacitance(self, strokes_m: ArrayLike) -> Array:
        """Sense capacitance (..., 3) in F at strokes (..., 3): linear in the overlap, which has to be positive."""
        strokes = _triples(strokes_m, "strokes_m")
        overlap = self.config.sense_comb.overlap_rest_m
        if np.any(strokes <= -overlap):
            raise StageDomainError(
                f"stroke {strokes.min() * 1e6:.6g} um leaves the sense comb's overlap of {overlap * 1e6:g} um"
            )
        return self.sense_rest_f + self.sense_gradient_f_per_m * strokes

    def strokes_from_capacitance(self, capacitance_f: ArrayLike) -> Array:
        """Strokes (..., 3) in m from sense capacitances (..., 3) in F: the inverse of ``sense_capacitance``."""
        capacitance = _triples(capacitance_f, "capacitance_f")
        if np.any(capacitance <= 0):
            raise StageDomainError(
                f"capacitance {capacitance.min() * 1e15:.6g} fF is not positive: the sense comb has no overlap there"
            )
        return (capacitance - self.sense_rest_f) / self.sense_gradient_f_per_m

    def _for_combs(self, each: Array, values: Array, name: str) -> Array:
        """What belongs to each comb (3,), for values (..., 3); that of all for other shapes, if there is one."""
        if values.ndim and values.shape[-1] == 3:
            return each
        if (self.config.calibration or Calibration()).comb_gain != AS_DRAWN:
            raise StageDomainError(f"{name} must have shape (..., 3), as the combs differ; got {values.shape}")
        return np.asarray(each[0])

    def _at_positions(self, position_m: ArrayLike, kernel: Callable[..., None], shape: tuple[int, ...]) -> Array:
        flat, leading = self._checked(position_m)
        out = np.empty((len(flat), *shape))
        kernel(self.geometry, flat, out)
        return out.reshape((*leading, *shape))

    def _at_elastic(self, position_m: ArrayLike, kernel: Callable[..., None], shape: tuple[int, ...]) -> Array:
        flat, leading = self._checked(position_m)
        out = np.empty((len(flat), *shape))
        kernel(self.geometry, self.elasticity, flat, out)
        return out.reshape((*leading, *shape))

    def _checked(self, position_m: ArrayLike) -> tuple[Array, tuple[int, ...]]:
        position = _triples(position_m, "position_m")
        flat = position.reshape(-1, 3)
        at, limit = _first_outside(self.geometry, flat)
        if limit == 4:
            reach, rest = float(self.geometry["link_m"][0]), float(self.geometry["height_rest_m"][0])
            raise StageDomainError(
                f"position {_um(flat[at])} um: z must stay between {-(reach + rest) * 1e6:.6g} and "
                f"{(reach - rest) * 1e6:.6g} um, the reach of the out-of-plane links"
            )
        if limit:
            reach = float(self.geometry["crank_m"][0])
            raise StageDomainError(
                f"position {_um(flat[at])} um: crank {limit} would have to be longer than {reach * 1e6:g} um"
            )
        return flat, position.shape[:-1]


def _finite(values: ArrayLike, name: str) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if not np.isfinite(array).all():
        raise StageDomainError(f"{name} must be finite, got {array[~np.isfinite(array)].flat[0]}")
    return array


def _triples(values: ArrayLike, name: str) -> Array:
    array = _finite(values, name)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise StageDomainError(f"{name} must have shape (..., 3), got {array.shape}")
    return np.ascontiguousarray(array)


def _um(triple: Array) -> str:
    return "(" + ", ".join(f"{v * 1e6:.6g}" for v in triple) + ")"


@njit(cache=True)
def _first_outside(geometry: Records, positions: Array) -> tuple[int, int]:
    for i in range(len(positions)):
        limit = kinematics.in_domain(geometry[0], positions[i])
        if limit != 0:
            return i, limit
    return -1, 0


@njit(cache=True)
def _strokes_each(geometry: Records, positions: Array, out: Array) -> None:
    for i in range(len(positions)):
        kinematics.strokes(geometry[0], positions[i], out[i])


@njit(cache=True)
def _positions_each(geometry: Records, strokes: Array, out: Array) -> int:
    for i in range(len(strokes)):
        out[i] = 0.0
        if kinematics.position_from_strokes(geometry[0], strokes[i], out[i]) < 0:
            return i
    return -1


@njit(cache=True)
def _jacobian_each(geometry: Records, positions: Array, out: Array) -> None:
    for i in range(len(positions)):
        kinematics.jacobian(geometry[0], positions[i], out[i])


@njit(cache=True)
def _pulls_each(geometry: Records, positions: Array, out: Array) -> None:
    for i in range(len(positions)):
        kinematics.pulls(geometry[0], positions[i], out[i])


@njit(cache=True)
def _curvature_each(geometry: Records, positions: Array, out: Array) -> None:
    for i in range(len(positions)):
        kinematics.curvature(geometry[0], positions[i], out[i])


@njit(cache=True)
def _energy_each(geometry: Records, elastic: Records, positions: Array, out: Array) -> None:
    for i in range(len(positions)):
        out[i] = elasticity.energy(geometry[0], elastic[0], positions[i])


@njit(cache=True)
def _gradient_each(geometry: Records, elastic: Records, positions: Array, out: Array) -> None:
    for i in range(len(positions)):
        elasticity.energy_gradient(geometry[0], elastic[0], positions[i], out[i])


@njit(cache=True)
def _stiffness_each(geometry: Records, elastic: Records, positions: Array, out: Array) -> None:
    for i in range(len(positions)):
        elasticity.stiffness(geometry[0], elastic[0], positions[i], out[i])


@njit(cache=True)
def _holding_each(geometry: Records, elastic: Records, positions: Array, out: Array) -> None:
    gradient, j, inverse = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(positions)):
        elasticity.energy_gradient(geometry[0], elastic[0], positions[i], gradient)
        kinematics.pulls(geometry[0], positions[i], j)
        inverse3(j, inverse)
        for k in range(3):
            out[i, k] = inverse[0, k] * gradient[0] + inverse[1, k] * gradient[1] + inverse[2, k] * gradient[2]

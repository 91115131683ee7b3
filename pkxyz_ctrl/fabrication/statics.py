"""Kinematics and strain energy of n devices at once, each at a position of its own, with links of its own.

The formulas are those of ``core.kinematics`` and ``core.elasticity``, written for arrays; links may differ between the
chains of a device, which those don't know. Positions and strokes are (n, 3).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.fabrication.devices import Devices

Array = NDArray[np.float64]

_HALF_ROOT3 = 0.5 * np.sqrt(3.0)
E = np.array([[0.0, 1.0], [-_HALF_ROOT3, -0.5], [_HALF_ROOT3, -0.5]])
N = np.stack([-E[:, 1], E[:, 0]], axis=1)


@dataclass(frozen=True)
class Pose:
    """n devices at positions: all that energy and forces are made of, (n, 3) by chain."""

    devices: Devices
    sine_m: Array
    """s_i = L1 sin(theta_i)"""
    cosine_m: Array
    z_m: Array
    """height of the links (n, 1)"""
    projection_m: Array
    stroke_m: Array
    turn_rad: Array
    """theta_i"""
    lift_rad: Array
    """alpha_i - alpha_0i"""

    @property
    def jacobian(self) -> Array:
        """dq/dx (n, 3, 3)."""
        rows = np.empty((*self.stroke_m.shape, 3))
        rows[..., :2] = E + N * (self.sine_m / self.cosine_m)[..., None]
        rows[..., 2] = self.z_m / self.projection_m
        return rows

    @property
    def energy_j(self) -> Array:
        """Strain energy (n,), 0 at rest."""
        d = self.devices
        chains = d.slider_n_per_m * self.stroke_m**2 + d.crank_n_m_per_rad * self.turn_rad**2
        return np.asarray(0.5 * (chains.sum(axis=1) + d.link_n_m_per_rad * (self.lift_rad**2).mean(axis=1)))

    @property
    def gradient_n(self) -> Array:
        """dV/dx (n, 3): what holds the platform there."""
        d = self.devices
        pull = d.slider_n_per_m * self.stroke_m
        across = (pull * self.sine_m + d.crank_n_m_per_rad * self.turn_rad) / self.cosine_m
        hinge = d.link_n_m_per_rad[:, None] / 3.0 * self.lift_rad
        out = np.empty(self.stroke_m.shape)
        out[:, :2] = pull @ E + across @ N
        out[:, 2] = ((pull * self.z_m + hinge) / self.projection_m).sum(axis=1)
        return out

    @property
    def bends(self) -> tuple[Array, Array]:
        """Curvature of the strokes in 1/m, across their way and along z (n, 3)."""
        length, z, delta = self.devices.crank_m, self.z_m, self.projection_m
        return length**2 / self.cosine_m**3, (z * z + delta * delta) / delta**3

    @property
    def stiffness_n_per_m(self) -> Array:
        """Hessian of the strain energy (n, 3, 3)."""
        d, j, c = self.devices, self.jacobian, self.cosine_m
        pull = d.slider_n_per_m * self.stroke_m
        across, along = self.bends
        crank = d.crank_n_m_per_rad * (1.0 / c**2 + self.turn_rad * self.sine_m / c**3)
        out = np.einsum("ni,nia,nib->nab", d.slider_n_per_m, j, j)
        out[:, :2, :2] += np.einsum("ni,ia,ib->nab", pull * across + crank, N, N)
        hinge = d.link_n_m_per_rad[:, None] / 3.0
        lift = hinge * (1.0 / self.projection_m**2 + self.lift_rad * self.z_m / self.projection_m**3)
        out[:, 2, 2] += (pull * along + lift).sum(axis=1)
        return out

    @property
    def holding_n(self) -> Array:
        """Pulls of the combs (n, 3) that hold the platform there; negative where they would have to push."""
        return np.asarray(np.linalg.solve(self.jacobian.transpose(0, 2, 1), self.gradient_n[..., None])[..., 0])

    @property
    def held_stiffness_n_per_m(self) -> Array:
        """... less what pulls take away that turn with the platform (n, 3, 3)."""
        force = self.holding_n
        across, along = self.bends
        out = self.stiffness_n_per_m
        out[:, :2, :2] -= np.einsum("ni,ia,ib->nab", force * across, N, N)
        out[:, 2, 2] -= (force * along).sum(axis=1)
        return out


def pose(devices: Devices, position_m: Array) -> Pose:
    """Devices at positions (n, 3) from rest, within the reach of cranks and links (else NaN)."""
    p = np.broadcast_to(np.asarray(position_m, dtype=np.float64), (len(devices), 3))
    l1, z0, delta0 = devices.crank_m, devices.height_m[:, None], devices.projection_m
    s = p[:, :2] @ N.T
    with np.errstate(invalid="ignore"):
        c = np.sqrt((l1 - s) * (l1 + s))
        dz = p[:, 2:]
        z, reach2 = z0 + dz, z0 * z0 + delta0 * delta0
        delta = np.sqrt(reach2 - z * z)
        stroke = p[:, :2] @ E.T + dz * (z + z0) / (delta + delta0) + s * s / (l1 + c)
        lift = np.arcsin(dz * (delta0 + z0 * (dz + 2.0 * z0) / (delta + delta0)) / reach2)
        return Pose(devices, s, c, z, delta, stroke, np.arcsin(s / l1), lift)


def pose_of_strokes(devices: Devices, strokes_m: Array) -> tuple[Pose, Array]:
    """Devices at strokes (n, 3) and their positions (n, 3): Newton's method from rest, on the exact closure. Each takes
    the steps that it needs, whoever is beside it.
    """
    wanted = np.broadcast_to(np.asarray(strokes_m, dtype=np.float64), (len(devices), 3))
    position, moves = np.zeros((len(devices), 3)), np.ones((len(devices), 1))
    for _ in range(8):
        there = pose(devices, position)
        step = moves * np.linalg.solve(there.jacobian, (wanted - there.stroke_m)[..., None])[..., 0]
        position = position + step
        moves = np.where(np.abs(step).max(axis=1, keepdims=True) < 1e-17, 0.0, moves)
        if not moves.any():
            break
    return pose(devices, position), position

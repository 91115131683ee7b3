"""Can the device follow this reference? Asked before anything moves."""

import numpy as np

from pkxyz_ctrl.stage import Stage, StageDomainError
from pkxyz_ctrl.trajectory import Trajectory, TrajectoryError
from pkxyz_ctrl.trajectory.pieces import Array

_CHUNK = 4096
_ROUNDING_M = 1e-12  # far below anything measurable; a reference that goes to a limit exactly is allowed
_ROUNDING_N = 1e-12


def check_against(stage: Stage, trajectory: Trajectory, step_us: int = 100) -> None:
    """Raise ``TrajectoryError`` at the first sampled instant that the stage can't follow, naming the limit.

    Checked every ``step_us`` and at the very end: links close, strokes in range, and the comb forces that
    hold and accelerate the platform, J^-T (grad V + m a), are pulls within the voltage limit.
    """
    for first in range(0, trajectory.duration_us // step_us + 2, _CHUNK):
        _check_samples(stage, trajectory, first, step_us)


def _check_samples(stage: Stage, trajectory: Trajectory, first: int, step_us: int) -> None:
    samples = trajectory.sample(first, _CHUNK, step_us)
    try:
        stage.inverse_kinematics(samples[:, 0:3])
    except StageDomainError:
        n, why = _first_outside(stage, samples[:, 0:3])
        _check_forces(stage, trajectory, samples[:n], first, step_us)
        raise _refusal(trajectory, (first + n) * step_us, samples[n, 0:3], why) from None
    _check_forces(stage, trajectory, samples, first, step_us)


def _first_outside(stage: Stage, position_m: Array) -> tuple[int, str]:
    """Index of the first position that the links can't reach, and why."""
    for n, position in enumerate(position_m):
        try:
            stage.inverse_kinematics(position)
        except StageDomainError as error:
            return n, str(error).partition(": ")[2]
    raise AssertionError("called for positions of which none is outside")


def _check_forces(stage: Stage, trajectory: Trajectory, samples: Array, first: int, step_us: int) -> None:
    position, acceleration = samples[:, 0:3], samples[:, 6:9]
    strokes = stage.inverse_kinematics(position)
    limits = stage.config.limits
    demand = stage.energy_gradient(position) + stage.config.dynamics.mass_kg * acceleration
    force = np.linalg.solve(np.swapaxes(stage.jacobian(position), -1, -2), demand[..., None])[..., 0]
    low, high = limits.stroke_min_m - _ROUNDING_M, limits.stroke_max_m + _ROUNDING_M
    broken = (strokes < low) | (strokes > high) | (force < -_ROUNDING_N) | (force > stage.force_max_n)
    if not broken.any():
        return
    n, comb = (int(i) for i in np.argwhere(broken)[0])
    stroke_um, pull_n = strokes[n, comb] * 1e6, force[n, comb]
    if not low <= strokes[n, comb] <= high:
        why = (
            f"stroke {comb + 1} would be {stroke_um:.4g} um, outside {limits.stroke_min_m * 1e6:g} to "
            f"{limits.stroke_max_m * 1e6:g} um"
        )
    elif pull_n < 0:
        why = f"comb {comb + 1} would have to push with {-pull_n * 1e6:.4g} uN, and combs only pull"
    else:
        voltage_v = float(np.sqrt(pull_n / stage.force_gain_n_per_v2))
        why = f"comb {comb + 1} would need {voltage_v:.1f} V, beyond the limit of {stage.voltage_max_v:g} V"
    raise _refusal(trajectory, (first + n) * step_us, position[n], why)


def _refusal(trajectory: Trajectory, t_us: int, position_m: Array, why: str) -> TrajectoryError:
    inside = [n for n, s in enumerate(trajectory.segments) if s.t_start_us <= t_us]
    n = inside[-1] if inside else 0
    where = ", ".join(f"{v * 1e6:.4g}" for v in position_m)
    return TrajectoryError(
        f"reference.{n} ({trajectory.segments[n].kind}): {t_us * 1e-6:.4f} s after its start the reference reaches "
        f"({where}) um, where {why}"
    )

"""Can the device follow this reference? Asked before anything moves."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.stage import Stage, StageDomainError
from pkxyz_ctrl.trajectory import TimedSegment, Trajectory, TrajectoryError
from pkxyz_ctrl.trajectory.motion import Array

_CHUNK = 4096
_STEP_MAX_US = 100
_SAMPLES_A_PERIOD = 40  # of a periodic motion: between two samples an extreme hides 0.3 % of the amplitude
_ROUNDING_M = 1e-12  # far below anything measurable; a reference that goes to a limit exactly is allowed
_ROUNDING_N = 1e-12


class DriveLimits(NamedTuple):
    """What the controller allows itself at the combs."""

    voltage_max_v: float
    slew_max_v_per_s: float
    """most that a commanded voltage may change, as a rate; a period gets its share"""
    period_us: int


def check_against(stage: Stage, trajectory: Trajectory, drive: DriveLimits | None = None) -> None:
    """Raise ``TrajectoryError`` at the first sampled instant that the stage can't follow, naming the limit.

    Links close, strokes are in range, and the comb forces that hold, brake and accelerate the platform,
    B^-T (grad V + C v + m a), are pulls within the voltage limit. With ``drive`` they are also within the controller's,
    and voltages change by no more than its slew limit from any instant to a period later; announced jumps are left out
    of that. Looked at every 100 us or closer, 40 times in a period of the highest frequency, and at the very end.
    """
    for segment in trajectory.segments:
        step_us = _step_us(segment, drive)
        first, last = segment.t_start_us // step_us, -(-segment.t_end_us // step_us)
        for begin in range(first, last + 1, _CHUNK):
            _check_samples(stage, trajectory, drive, begin, min(_CHUNK, last + 1 - begin), step_us)


def _step_us(segment: TimedSegment, drive: DriveLimits | None) -> int:
    """A divisor of the period, so that samples a period apart exist."""
    closest = max(1, min(_STEP_MAX_US, math.floor(1e6 / (_SAMPLES_A_PERIOD * max(segment.highest_hz, 1.0)))))
    if drive is None:
        return closest
    return max(n for n in range(1, closest + 1) if drive.period_us % n == 0)


def _check_samples(
    stage: Stage, trajectory: Trajectory, drive: DriveLimits | None, first: int, count: int, step_us: int
) -> None:
    lag = drive.period_us // step_us if drive else 0
    rows = trajectory.sample(first - lag, count + lag, step_us)
    t_us = (first - lag + np.arange(len(rows))) * step_us
    new = np.append(True, (rows[1:] != rows[:-1]).any(axis=1))  # holds cost nothing
    which = np.cumsum(new) - 1
    distinct, distinct_us = rows[new], t_us[new]
    outside = _first_outside(stage, distinct[:, 0:3])
    inside = distinct if outside is None else distinct[: outside[0]]
    force = comb_forces(stage, inside)
    limit_v = min(stage.voltage_max_v, drive.voltage_max_v) if drive else stage.voltage_max_v
    refusals = [
        _first_beyond(stage, inside, distinct_us, force, limit_v),
        None if outside is None else (int(distinct_us[outside[0]]), distinct[outside[0], 0:3], outside[1]),
        None if drive is None else _first_too_fast(stage, trajectory, drive, rows, t_us, force, which, lag),
    ]
    found = [refusal for refusal in refusals if refusal is not None]
    if found:
        t_first_us, position_m, why = min(found, key=lambda refusal: refusal[0])
        raise _refusal(trajectory, t_first_us, position_m, why)


def comb_forces(stage: Stage, rows: Array) -> Array:
    """Comb forces (n, 3) in N that let the platform follow rows (n, 9) of a trajectory; negative where that is a push.

    Damping is that of the stage file, modal about rest: C = sqrt(m) K(0)^(1/2) / Q.
    """
    eigenvalue, mode = np.linalg.eigh(stage.stiffness(np.zeros(3)))
    damping = math.sqrt(stage.mass_kg) / stage.quality_factor * (mode * np.sqrt(eigenvalue)) @ mode.T
    position, velocity, acceleration = rows[:, 0:3], rows[:, 3:6], rows[:, 6:9]
    demand = stage.energy_gradient(position) + velocity @ damping + stage.mass_kg * acceleration
    return np.linalg.solve(np.swapaxes(stage.pulls(position), -1, -2), demand[..., None])[..., 0]


def within_limits(stage: Stage, rows: Array, drive: DriveLimits) -> bool:
    """Whether rows (n, 9), a period of the drive apart, keep strokes, pulls, voltages and slew within the limits."""
    if _first_outside(stage, rows[:, 0:3]) is not None:
        return False
    force = comb_forces(stage, rows)
    limit_v = min(stage.voltage_max_v, drive.voltage_max_v)
    if _first_beyond(stage, rows, np.zeros(len(rows), np.int64), force, limit_v) is not None:
        return False
    change_v = np.abs(np.diff(np.sqrt(np.maximum(force, 0.0) / stage.force_gain_n_per_v2), axis=0))
    return bool((change_v <= drive.slew_max_v_per_s * drive.period_us * 1e-6).all())


_Refusal = tuple[int, Array, str]


def _first_outside(stage: Stage, position_m: Array) -> tuple[int, str] | None:
    """Index of the first position that the links can't reach, and why."""
    try:
        stage.inverse_kinematics(position_m)
    except StageDomainError:
        for n, position in enumerate(position_m):
            try:
                stage.inverse_kinematics(position)
            except StageDomainError as error:
                return n, str(error).partition(": ")[2]
    return None


def _first_beyond(
    stage: Stage, rows: Array, t_us: NDArray[np.integer], force: Array, limit_v: float
) -> _Refusal | None:
    """The first instant at which a stroke or a comb force passes a limit."""
    limits = stage.config.limits
    strokes = stage.inverse_kinematics(rows[:, 0:3])
    force_max_n = stage.force_gain_n_per_v2 * limit_v**2
    low, high = limits.stroke_min_m - _ROUNDING_M, limits.stroke_max_m + _ROUNDING_M
    broken = (strokes < low) | (strokes > high) | (force < -_ROUNDING_N) | (force > force_max_n)
    if not broken.any():
        return None
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
        voltage_v = float(np.sqrt(pull_n / stage.force_gain_n_per_v2[comb]))
        why = f"comb {comb + 1} would need {voltage_v:.1f} V, beyond the limit of {limit_v:g} V"
    return int(t_us[n]), rows[n, 0:3], why


def _first_too_fast(
    stage: Stage,
    trajectory: Trajectory,
    drive: DriveLimits,
    rows: Array,
    t_us: NDArray[np.integer],
    force: Array,
    which: NDArray[np.integer],
    lag: int,
) -> _Refusal | None:
    """The first instant by which a voltage has changed more in a period than the slew limit allows."""
    known = which < len(force)
    voltage = np.sqrt(np.maximum(force[which[known]], 0.0) / stage.force_gain_n_per_v2)
    change = np.abs(voltage[lag:] - voltage[:-lag])
    share_v = drive.slew_max_v_per_s * drive.period_us * 1e-6
    now_us, before_us = t_us[known][lag:], t_us[known][:-lag]
    jumps_us = np.array([t for segment in trajectory.segments for t in segment.jumps_us], np.int64)
    passed = np.searchsorted(jumps_us, now_us, side="right") > np.searchsorted(jumps_us, before_us, side="right")
    change[passed] = 0.0
    broken = np.argwhere(change > share_v)
    if not len(broken):
        return None
    n, comb = (int(i) for i in broken[0])
    why = (
        f"the voltage of comb {comb + 1} would have to change by {change[n, comb]:.4g} V within a period of "
        f"{drive.period_us} us, beyond the slew limit of {share_v:.4g} V ({drive.slew_max_v_per_s:g} V/s)"
    )
    return int(now_us[n]), rows[known][lag:][n, 0:3], why


def _refusal(trajectory: Trajectory, t_us: int, position_m: Array, why: str) -> TrajectoryError:
    inside = [n for n, s in enumerate(trajectory.segments) if s.t_start_us <= t_us]
    n = inside[-1] if inside else 0
    where = ", ".join(f"{v * 1e6:.4g}" for v in position_m)
    return TrajectoryError(
        f"reference.{n} ({trajectory.segments[n].kind}): {t_us * 1e-6:.4f} s after its start the reference reaches "
        f"({where}) um, where {why}"
    )

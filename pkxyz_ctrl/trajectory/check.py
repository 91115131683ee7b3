"""Can the device follow this reference? Asked before anything moves."""

import math
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.stage import Stage, StageDomainError
from pkxyz_ctrl.trajectory import TimedSegment, Trajectory, TrajectoryError
from pkxyz_ctrl.trajectory.comb_forces import ROUNDING_M, ROUNDING_N, comb_forces
from pkxyz_ctrl.trajectory.motion import Array

_CHUNK = 4096
_STEP_MAX_US = 100
_SAMPLES_A_PERIOD = 40  # of a periodic motion: between two samples an extreme hides 0.3 % of the amplitude
_NEAREST_M = 1e-12

_MOTION = "velocity_max_m_per_s, acceleration_max_m_per_s2 or jerk_max_m_per_s3"
KEYS: Final[dict[str, tuple[str, str]]] = {
    "hold": ("", ""),
    "move": ("to_m", _MOTION),
    "raster": ("centre_m, line_length_m, line_pitch_m or layer_pitch_m", f"line_rate_hz, {_MOTION}"),
    "circle": ("radius_m", "radius_m or frequency_hz"),
    "lissajous": ("amplitude_m", "amplitude_m or frequency_hz"),
    "rosette": ("radius_m", "radius_m, petal_hz or rotation_hz"),
    "sine": ("amplitude_m", "amplitude_m or frequency_hz"),
    "spiral": ("radius_m", "radius_m, speed_m_per_s or frequency_hz"),
    "steps": ("by_m or count", "by_m or count"),
    "staircase": ("step_m or steps", _MOTION),
    "sweep": ("amplitude_m", "amplitude_m, from_hz or to_hz"),
    "csv": ("the file", _MOTION),
    "waypoints": ("points_m", f"points_m, {_MOTION}"),
}
"""Keys of each kind of segment that mend what could not even be held there, and what is too fast."""


MOTION_SHARE: Final = 0.9
"""Of the slew limit, for planned motions. The rest is the feedback's: a loop whose reference takes all of it lags in
every answer, and from 1 kHz on swings up to a fault where the device is not quite as drawn.
"""


class DriveLimits(NamedTuple):
    """What a planned motion may ask of the combs."""

    voltage_max_v: float
    slew_max_v_per_s: float
    """most that a voltage may change, as a rate; a period gets its share"""
    period_us: int

    @classmethod
    def of(cls, controller: ControllerConfig, bus: BusConfig) -> Self:
        """Those of a controller file, on a bus: of its slew limit, ``MOTION_SHARE``."""
        limits = controller.limits
        return cls(limits.voltage_max_v, MOTION_SHARE * limits.slew_max_v_per_s, bus.period_us)


def check_against(stage: Stage, trajectory: Trajectory, drive: DriveLimits | None = None) -> None:
    """Raise ``TrajectoryError`` at the first segment that the stage can't follow, naming what is worst in it.

    Links close, strokes are in range, and the comb forces that hold, brake and accelerate the platform,
    B^-T (grad V + C v + m a), are pulls within the voltage limit. With ``drive`` they are also within its own, and
    voltages change by no more than its slew from any instant to a period later; announced jumps are left out of that.
    Looked at where each segment comes to rest, every 100 us or closer, 40 times in a period of the highest
    frequency, and at the very end.
    """
    for n, segment in enumerate(trajectory.segments):
        place, motion = KEYS[segment.kind]
        target = np.concatenate([trajectory.sample(segment.t_end_us - 1, 1, 1)[0, 0:3], np.zeros(6)])
        if (found := _worst_of(stage, target[None], _limit_v(stage, drive))) is not None:
            raise _refusal(trajectory, n, f"at its target {_um(target[0:3])} {found.why}", place)
        step_us = _step_us(segment, drive)
        first, last = segment.t_start_us // step_us, (segment.t_end_us - 1) // step_us
        if n == len(trajectory.segments) - 1:
            last += 1
        chunks = (
            _worst_sampled(stage, trajectory, drive, begin, min(_CHUNK, last + 1 - begin), step_us)
            for begin in range(first, last + 1, _CHUNK)
        )
        if beyond := [found for found in chunks if found is not None]:
            worst = max(beyond, key=lambda found: (found.kind, found.excess))
            still = np.concatenate([worst.position_m, np.zeros(6)])
            stands = _worst_of(stage, still[None], _limit_v(stage, drive)) is None
            raise _refusal(
                trajectory, n, f"on its way, at {_um(worst.position_m)}, {worst.why}", motion if stands else place
            )


def _step_us(segment: TimedSegment, drive: DriveLimits | None) -> int:
    """A divisor of the period, so that samples a period apart exist."""
    closest = max(1, min(_STEP_MAX_US, math.floor(1e6 / (_SAMPLES_A_PERIOD * max(segment.highest_hz, 1.0)))))
    if drive is None:
        return closest
    return max(n for n in range(1, closest + 1) if drive.period_us % n == 0)


def _limit_v(stage: Stage, drive: DriveLimits | None) -> float:
    return min(stage.voltage_max_v, drive.voltage_max_v) if drive else stage.voltage_max_v


def _worst_sampled(
    stage: Stage, trajectory: Trajectory, drive: DriveLimits | None, first: int, count: int, step_us: int
) -> "_Beyond | None":
    """What is worst at so many instants from ``first`` on, and in the periods that end there."""
    lag = drive.period_us // step_us if drive else 0
    rows = trajectory.sample(first - lag, count + lag, step_us)
    new = np.append(True, (rows[1:] != rows[:-1]).any(axis=1))  # holds cost nothing
    found = _worst_of(stage, rows[new], _limit_v(stage, drive))
    if found is not None or drive is None:
        return found
    t_us = (first - lag + np.arange(len(rows))) * step_us
    return _too_fast(stage, trajectory, drive, rows, t_us, comb_forces(stage, rows[new])[np.cumsum(new) - 1], lag)


def within_limits(stage: Stage, rows: Array, drive: DriveLimits) -> bool:
    """Whether rows (n, 9), a period of the drive apart, keep strokes, pulls, voltages and slew within the limits."""
    if _worst_of(stage, rows, _limit_v(stage, drive)) is not None:
        return False
    force = comb_forces(stage, rows)
    change_v = np.abs(np.diff(np.sqrt(np.maximum(force, 0.0) / stage.force_gain_n_per_v2), axis=0))
    return bool((change_v <= drive.slew_max_v_per_s * drive.period_us * 1e-6).all())


_SLEW, _FORCE, _STROKE, _LINKS = range(4)  # what is named first is last


class _Beyond(NamedTuple):
    """What passes a limit, and where. ``excess`` is comparable within a kind."""

    kind: int
    excess: float
    position_m: Array
    why: str


def _worst_of(stage: Stage, rows: Array, limit_v: float) -> _Beyond | None:
    """What is worst in rows (n, 9) by themselves: links, then strokes, then comb forces."""
    position = rows[:, 0:3]
    if (outside := _first_outside(stage, position)) is not None:
        return _Beyond(_LINKS, 0.0, position[outside[0]], outside[1])
    limits, strokes = stage.config.limits, stage.inverse_kinematics(position)
    over = np.maximum(limits.stroke_min_m - strokes, strokes - limits.stroke_max_m)
    n, comb = _place_of_most(over)
    if over[n, comb] > ROUNDING_M:
        low, high = limits.stroke_min_m * 1e6, limits.stroke_max_m * 1e6
        why = f"stroke {comb + 1} would be {strokes[n, comb] * 1e6:.4g} um, outside {low:g} to {high:g} um"
        return _Beyond(_STROKE, float(over[n, comb]), position[n], why)
    force = comb_forces(stage, rows)
    over = np.maximum(-force - ROUNDING_N, force - stage.force_gain_n_per_v2 * limit_v**2)
    n, comb = _place_of_most(over)
    if not over[n, comb] > 0.0:
        return None
    pull_n = force[n, comb]
    why = f"comb {comb + 1} would have to push with {-pull_n * 1e6:.4g} uN, and combs only pull"
    if pull_n > 0.0:
        voltage_v = float(np.sqrt(pull_n / stage.force_gain_n_per_v2[comb]))
        why = f"comb {comb + 1} would need {voltage_v:.1f} V, beyond the limit of {limit_v:g} V"
    return _Beyond(_FORCE, float(over[n, comb]), position[n], why)


def _place_of_most(values: Array) -> tuple[int, int]:
    n, comb = np.unravel_index(int(np.argmax(values)), values.shape)
    return int(n), int(comb)


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


def _too_fast(
    stage: Stage,
    trajectory: Trajectory,
    drive: DriveLimits,
    rows: Array,
    t_us: NDArray[np.integer],
    force: Array,
    lag: int,
) -> _Beyond | None:
    """The largest change of a voltage in a period, if it is beyond the slew limit."""
    voltage = np.sqrt(np.maximum(force, 0.0) / stage.force_gain_n_per_v2)
    change = np.abs(voltage[lag:] - voltage[:-lag])
    share_v = drive.slew_max_v_per_s * drive.period_us * 1e-6
    jumps_us = np.array([t for segment in trajectory.segments for t in segment.jumps_us], np.int64)
    now, before = (np.searchsorted(jumps_us, t, side="right") for t in (t_us[lag:], t_us[:-lag]))
    change[now > before] = 0.0
    n, comb = _place_of_most(change)
    if not change[n, comb] > share_v:
        return None
    why = (
        f"the voltage of comb {comb + 1} would have to change by {change[n, comb]:.4g} V within a period of "
        f"{drive.period_us} us, beyond the slew limit of {share_v:.4g} V ({drive.slew_max_v_per_s:g} V/s) for a motion"
    )
    return _Beyond(_SLEW, float(change[n, comb]), rows[lag:][n, 0:3], why)


def _refusal(trajectory: Trajectory, n: int, why: str, keys: str) -> TrajectoryError:
    segment = trajectory.segments[n]
    ends = (segment.t_start_us - 1, segment.t_end_us - 1)
    begin, end = (trajectory.sample(max(t_us, 0), 1, 1)[0, 0:3] for t_us in ends)
    way = f"at {_um(begin)}" if np.abs(end - begin).max() < _NEAREST_M else f"from {_um(begin)} to {_um(end)}"
    file = f" {segment.source}" if segment.source is not None else ""
    advice = f"; change {keys}" if keys else ""
    return TrajectoryError(f"reference.{n} ({segment.kind}{file} {way}): {why}{advice}")


def _um(position_m: Array) -> str:
    return f"({', '.join(f'{round(v * 1e6, 5) + 0.0:.4g}' for v in position_m)}) um"

"""Every kind of segment: its derivatives, its joints, its bits, and the law that it promises."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from pkxyz_ctrl.trajectory import (
    Circle,
    Hold,
    Lissajous,
    Move,
    Rosette,
    Sine,
    Spiral,
    Staircase,
    Steps,
    Sweep,
    Trajectory,
    TrajectoryError,
    Waypoints,
)

MOVE = Move(
    kind="move", to_m=(2e-6, -1e-6, 15e-6), velocity_max_m_per_s=1e-3, acceleration_max_m_per_s2=0.1,
    jerk_max_m_per_s3=20.0,
)  # fmt: skip
CENTRE = np.array(MOVE.to_m)

amplitude = st.floats(10e-9, 5e-6)
frequency = st.floats(5.0, 1200.0)
lead = st.floats(0.002, 0.05)
axis = st.sampled_from("xyz")
limits = {"velocity_max_m_per_s": 1e-3, "acceleration_max_m_per_s2": 0.5, "jerk_max_m_per_s3": 300.0}
sines = st.builds(
    Sine, kind=st.just("sine"), axis=axis, amplitude_m=amplitude, frequency_hz=frequency, cycles=st.floats(0.5, 6.0),
    lead_s=lead,
)  # fmt: skip
circles = st.builds(
    Circle, kind=st.just("circle"), radius_m=amplitude, frequency_hz=frequency, turns=st.floats(0.5, 6.0), lead_s=lead
)  # fmt: skip
lissajous = st.builds(
    Lissajous, kind=st.just("lissajous"), amplitude_m=st.tuples(amplitude, amplitude, amplitude),
    frequency_hz=st.tuples(frequency, frequency, frequency), phase_rad=st.tuples(*[st.floats(-7, 7)] * 3),
    duration_s=st.floats(0.01, 0.2), lead_s=lead,
)  # fmt: skip
rosettes = st.builds(
    Rosette, kind=st.just("rosette"), radius_m=amplitude, petal_hz=frequency, rotation_hz=st.floats(0.1, 100.0),
    duration_s=st.floats(0.01, 0.2), lead_s=lead,
)  # fmt: skip
sweeps = st.builds(
    Sweep, kind=st.just("sweep"), axis=axis, amplitude_m=amplitude, from_hz=frequency, to_hz=st.floats(1201.0, 2000.0),
    law=st.sampled_from(["linear", "logarithmic"]), duration_s=st.floats(0.05, 0.5), lead_s=lead,
)  # fmt: skip
shape = {
    "kind": st.just("spiral"),
    "radius_m": st.floats(2e-6, 5e-6),
    "inner_radius_m": st.floats(0.05e-6, 1.9e-6),
    "pitch_m": st.floats(0.05e-6, 0.4e-6),
    "lead_out_turns": st.floats(0.3, 1.0),
}
linear_spirals = st.builds(Spiral, speed_m_per_s=st.floats(1e-5, 1e-3), **shape)
angular_spirals = st.builds(Spiral, frequency_hz=st.floats(5.0, 200.0), **shape)
staircases = st.builds(
    Staircase, kind=st.just("staircase"), step_m=st.tuples(amplitude, amplitude, amplitude), steps=st.integers(1, 4),
    dwell_s=st.floats(0.001, 0.02), there_and_back=st.booleans(), **{k: st.just(v) for k, v in limits.items()},
)  # fmt: skip
points = st.tuples(*[st.floats(-9e-6, 9e-6)] * 3)
waypoints = st.builds(
    Waypoints, kind=st.just("waypoints"), points_m=st.lists(points, min_size=1, max_size=5).map(tuple),
    deviation_m=st.just(0.0) | st.floats(1e-9, 1e-6), velocity_max_m_per_s=st.floats(1e-4, 5e-3),
    acceleration_max_m_per_s2=st.floats(0.02, 5.0), jerk_max_m_per_s3=st.floats(5.0, 5000.0),
)  # fmt: skip
smooth = (
    sines | circles | lissajous | rosettes | sweeps | linear_spirals | angular_spirals | staircases | waypoints
)  # fmt: skip


def motions_of(segment):
    """The motions of a segment that starts at CENTRE, and its trajectory between a move and a hold."""
    try:
        trajectory = Trajectory([MOVE, segment, Hold(kind="hold", duration_s=0.01)])
    except TrajectoryError as error:
        assume("where the path already is" not in str(error) and "turn back" not in str(error))
        raise
    return trajectory._motions, trajectory


@settings(max_examples=100)
@given(smooth)
def test_position_velocity_and_acceleration_go_on_over_every_joint_and_end_at_rest(segment):
    motions, trajectory = motions_of(segment)
    for before, after in pairwise(motions):
        end, begin = before.end(), after.sample(np.zeros(1)).reshape(3, 3)
        scale = np.abs([end, begin]).max(axis=(0, 2)) + np.array([1e-6, 1e-3, 1.0])
        assert np.all(np.abs(end - begin).max(axis=1) < 1e-8 * scale)
        assert before.sample(np.array([before.total_s])).reshape(3, 3) == pytest.approx(
            end, rel=1e-9, abs=1e-9 * scale[2]
        )
    middle = trajectory.segments[1]
    rows = np.concatenate([trajectory.sample(t, 1, 1) for t in (middle.t_start_us, middle.t_end_us)])
    assert np.abs(rows[:, 3:6]).max() < 1e-9
    assert np.abs(rows[:, 6:9]).max() < 1e-5


@settings(max_examples=80)
@given(smooth, st.data())
def test_velocity_and_acceleration_are_the_derivatives_of_the_position(segment, data):
    motions, _ = motions_of(segment)
    step_s = 2e-6
    for motion in motions[1:-2]:
        if motion.total_s < 20 * step_s:
            continue
        t_s = data.draw(st.floats(4 * step_s, motion.total_s - 4 * step_s))
        if hasattr(motion, "lead_s"):  # the jerk of the envelope jumps where the full amplitude begins and ends
            assume(min(abs(t_s - motion.lead_s), abs(motion.total_s - motion.lead_s - t_s)) > 4 * step_s)
        at = motion.sample(t_s + step_s * np.array([-3, -2, -1, 0, 1, 2, 3]))
        weights = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60 / step_s  # sixth order
        # a jerk that changes inside the seven samples bends velocity by jerk step^2, acceleration by jerk step;
        # rounding of 20 um and of some mm/s costs what is left where nothing moves
        kinks = jerk_of(segment) * np.array([step_s**2, step_s]) + (1e-14, 1e-12)
        for of, to, kink in ((slice(0, 3), slice(3, 6), kinks[0]), (slice(3, 6), slice(6, 9), kinks[1])):
            scale = np.abs(at[:, to]).max()
            assert np.abs(weights @ at[:, of] - at[3, to]).max() <= 1e-7 * scale + kink


def jerk_of(segment):
    """Jumps of jerk: of limited kinds up to three times the limit; spirals have none inside a motion."""
    return 3 * getattr(segment, "jerk_max_m_per_s3", 0.0)


@settings(max_examples=60)
@given(smooth, st.integers(0, 500), st.integers(1, 300), st.integers(1, 40), st.sampled_from([50, 200, 500]))
def test_a_tick_has_the_same_bits_however_it_is_asked_for(segment, offset, count, chunk, period_us):
    _, trajectory = motions_of(segment)
    first = trajectory.segments[1].t_start_us // period_us + offset
    whole = trajectory.sample(first, count, period_us)
    starts = range(first, first + count, chunk)
    parts = [trajectory.sample(n, min(chunk, first + count - n), period_us) for n in starts]
    assert np.concatenate(parts).tobytes() == whole.tobytes()
    assert trajectory.sample(first * 2, 1, period_us // 2).tobytes() == whole[:1].tobytes() or period_us % 2


def full(segment, step_us=50):
    """Seconds since the start of the scan, and rows relative to the centre."""
    _, trajectory = motions_of(segment)
    begin, end = trajectory.segments[1].scan_us
    first, last = -(-begin // step_us), end // step_us
    rows = trajectory.sample(first, last - first + 1, step_us)
    rows[:, 0:3] -= CENTRE
    t_s = np.arange(first, last + 1) * step_us * 1e-6 - trajectory.segments[1].t_start_us * 1e-6
    return t_s, rows, trajectory


@settings(max_examples=40)
@given(circles)
def test_a_circle_has_its_radius_and_its_frequency_and_begins_at_positive_x(segment):
    t_s, rows, trajectory = full(segment)
    t_s = t_s - segment.lead_s
    phase = 2 * math.pi * segment.frequency_hz * t_s
    expected = segment.radius_m * np.stack([np.cos(phase), np.sin(phase)], axis=1)
    assert np.abs(rows[:, :2] - expected).max() < 1e-9 * segment.radius_m
    assert np.abs(rows[:, 2]).max() < 1e-20
    speed = 2 * math.pi * segment.frequency_hz * segment.radius_m
    assert np.abs(np.hypot(rows[:, 3], rows[:, 4]) / speed - 1).max() < 1e-9
    begin, end = trajectory.segments[1].scan_us
    assert end - begin == pytest.approx(segment.turns / segment.frequency_hz * 1e6, abs=2)


@settings(max_examples=40)
@given(lissajous, rosettes, sines)
def test_lissajous_rosette_and_sine_are_what_their_equations_say(figure, flower, sine):
    t_s, rows, _ = full(figure)
    for i in range(3):
        angle = 2 * math.pi * figure.frequency_hz[i] * (t_s - figure.lead_s) + figure.phase_rad[i]
        assert np.abs(rows[:, i] / figure.amplitude_m[i] - np.sin(angle)).max() < 1e-9
    t_s, rows, _ = full(flower)
    t_s = t_s - flower.lead_s
    radius = flower.radius_m * np.sin(2 * math.pi * flower.petal_hz * t_s)
    angle = 2 * math.pi * flower.rotation_hz * t_s
    assert np.abs(rows[:, 0] - radius * np.cos(angle)).max() < 1e-9 * flower.radius_m
    assert np.abs(rows[:, 1] - radius * np.sin(angle)).max() < 1e-9 * flower.radius_m
    t_s, rows, _ = full(sine)
    i = "xyz".index(sine.axis)
    angle = 2 * math.pi * sine.frequency_hz * (t_s - sine.lead_s)
    assert np.abs(rows[:, i] / sine.amplitude_m - np.sin(angle)).max() < 1e-9
    assert np.abs(np.delete(rows[:, :3], i, axis=1)).max() < 1e-20


@settings(max_examples=60)
@given(sweeps, st.booleans(), st.floats(0.0, 1.0))
def test_a_sweep_runs_from_one_frequency_to_the_other_by_its_law(segment, down, where):
    if down:
        segment = segment.model_copy(update={"from_hz": segment.to_hz, "to_hz": segment.from_hz})
    (motion,) = [m for m in motions_of(segment)[0] if hasattr(m, "turns")]
    t_s = np.array([segment.lead_s, segment.lead_s + where * segment.duration_s, segment.lead_s + segment.duration_s])
    turns, frequency_hz, rate = motion.turns(t_s)
    assert frequency_hz[[0, 2]] == pytest.approx([segment.from_hz, segment.to_hz], rel=1e-12)
    if segment.law == "linear":
        expected = segment.from_hz + (segment.to_hz - segment.from_hz) * where
        assert turns[2] == pytest.approx((segment.from_hz + segment.to_hz) / 2 * segment.duration_s, rel=1e-9)
    else:
        expected = segment.from_hz * (segment.to_hz / segment.from_hz) ** where
    assert frequency_hz[1] == pytest.approx(expected, rel=1e-9)
    step = 1e-5
    about = motion.turns(t_s[1] + step * np.array([-1.0, 1.0]))
    assert np.diff(about[0])[0] / (2 * step) == pytest.approx(frequency_hz[1], rel=1e-5)
    assert np.diff(about[1])[0] / (2 * step) == pytest.approx(rate[1], rel=1e-5)
    t_s, rows, _ = full(segment, 10)
    i = "xyz".index(segment.axis)
    assert np.abs(rows[:, i]).max() <= segment.amplitude_m * (1 + 1e-9)
    envelope = np.hypot(rows[:, i], rows[:, 3 + i] / (2 * math.pi * motion.turns(t_s)[1]))
    assert np.abs(envelope / segment.amplitude_m - 1).max() < 1e-6


@settings(max_examples=60)
@given(linear_spirals | angular_spirals)
def test_spirals_keep_their_pitch_and_their_velocity(segment):
    period_us = 50
    _, trajectory = motions_of(segment)
    begin, end = trajectory.segments[1].scan_us
    ticks = np.arange(-(-begin // period_us), end // period_us)
    assume(len(ticks) > 400)
    for part in (ticks[:200], ticks[-200:]):
        rows = trajectory.sample(int(part[0]), len(part), period_us)
        rows[:, 0:3] -= CENTRE
        check_spiral(segment, rows, period_us * 1e-6)
    # from the inner radius to the outer one, to what moves in a period of sampling
    radii = np.hypot(*(np.concatenate([trajectory.sample(t, 1, 1) for t in (begin, end)])[:, :2] - CENTRE[:2]).T)
    slack_m = 1e-11 + 1e-6 * max(segment.speed_m_per_s or 0.0, (segment.frequency_hz or 0.0) * segment.pitch_m)
    assert radii == pytest.approx([segment.inner_radius_m, segment.radius_m], abs=slack_m)
    if segment.speed_m_per_s is not None:  # the lead-in turns up to 11 % faster than the law's first turn
        turning_m = math.hypot(segment.inner_radius_m, segment.pitch_m / (2 * math.pi))
        first_hz = segment.speed_m_per_s / (2 * math.pi * turning_m)
        assert 0.999 * first_hz < trajectory.segments[1].highest_hz < 1.115 * first_hz
    # the lead-out stays inside what it is said to
    last = trajectory.sample(trajectory.segments[1].t_end_us, 1, 1)[0, :2] - CENTRE[:2]
    beyond = np.hypot(*last) - segment.radius_m
    assert 0 < beyond <= segment.lead_out_turns * segment.pitch_m * (1 + 1e-9)


def check_spiral(segment, rows, period_s):
    """r grows by the pitch in each turn, and the speed or the angular velocity is what was asked for."""
    radius = np.hypot(rows[:, 0], rows[:, 1])
    angle = np.unwrap(np.arctan2(rows[:, 1], rows[:, 0]))
    grown = segment.pitch_m * (angle - angle[0]) / (2 * math.pi)
    assert np.diff(angle).min() > 0
    assert np.abs(radius - radius[0] - grown).max() < 1e-15
    speed = np.hypot(rows[:, 3], rows[:, 4])
    if segment.speed_m_per_s is not None:
        assert np.abs(speed / segment.speed_m_per_s - 1).max() < 1e-11
    else:
        assert np.abs(np.diff(angle) / (2 * math.pi * segment.frequency_hz * period_s) - 1).max() < 1e-6


@settings(max_examples=50)
@given(waypoints)
def test_waypoints_pass_every_point_as_near_as_promised_inside_the_limits(segment):
    _, trajectory = motions_of(segment)
    middle = trajectory.segments[1]
    step_us = max(1, (middle.t_end_us - middle.t_start_us) // 20_000)
    count = (middle.t_end_us - middle.t_start_us) // step_us + 10
    rows = trajectory.sample(middle.t_start_us // step_us, count, step_us)
    slack = 1 + 1e-6
    assert np.abs(rows[:, 3:6]).max() <= segment.velocity_max_m_per_s * slack
    assert np.abs(rows[:, 6:9]).max() <= segment.acceleration_max_m_per_s2 * slack
    seen_m = np.abs(np.diff(rows[:, 0:3], axis=0)).max()
    for point in segment.points_m:
        nearest = np.linalg.norm(rows[:, 0:3] - np.array(point), axis=1).min()
        assert nearest <= segment.deviation_m + 2 * seen_m
    # never off the straight lines by more than that
    corners = np.array([CENTRE, *segment.points_m])
    off = np.min([distance_to_leg(rows[:, 0:3], a, b) for a, b in pairwise(corners)], axis=0)
    assert off.max() <= segment.deviation_m + 1e-12


def distance_to_leg(points, a, b):
    along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(points - a - along[:, None] * (b - a), axis=1)


def test_rounding_corners_saves_time_and_a_right_angle_is_passed_as_calculated():
    corner = ((4e-6, 0.0, 15e-6), (4e-6, 4e-6, 15e-6))
    start = Move(kind="move", to_m=(0.0, 0.0, 15e-6), **limits)
    times, nearest = [], []
    for deviation in (0.0, 10e-9, 100e-9):
        path = Waypoints(kind="waypoints", points_m=corner, deviation_m=deviation, **limits)
        trajectory = Trajectory([start, path])
        segment = trajectory.segments[1]
        times.append(segment.t_end_us - segment.t_start_us)
        rows = trajectory.sample(segment.t_start_us, times[-1], 1)
        nearest.append(np.linalg.norm(rows[:, :3] - np.array(corner[0]), axis=1).min())
    assert times[0] == times[1] > times[2]
    # where it rounds the corner, jerk binds: v sqrt(2) 2 sqrt(v / j) / 12 = deviation; 0.999 of that speed is taken
    assert nearest[:2] == pytest.approx([0.0, 0.0], abs=1e-13), "a stop is quicker than to creep by within 10 nm"
    assert nearest[2] == pytest.approx(100e-9 * 0.999**1.5, rel=1e-3)


def test_steps_jump_when_they_say_and_stand_still_between():
    segment = Steps(kind="steps", by_m=(1e-6, 0.0, -0.5e-6), count=2, dwell_s=0.01)
    trajectory = Trajectory([MOVE, segment, Hold(kind="hold", duration_s=0.02)])
    timed = trajectory.segments[1]
    assert np.array(timed.jumps_us) - timed.t_start_us == pytest.approx([10_000, 20_000, 30_000, 40_000])
    assert timed.scan_us == (timed.jumps_us[0], timed.t_end_us)
    for n, jump_us in enumerate(timed.jumps_us):
        rows = trajectory.sample(jump_us - 1, 3, 1)
        there, here = CENTRE + np.array(segment.by_m), CENTRE
        assert rows[0, :3] == pytest.approx(here if n % 2 == 0 else there, abs=1e-20)
        assert rows[1:, :3] == pytest.approx(np.tile(there if n % 2 == 0 else here, (2, 1)), abs=1e-20)
        assert not rows[:, 3:].any()
    assert [s.jumps_us for s in (trajectory.segments[0], trajectory.segments[2])] == [(), ()]


@pytest.mark.parametrize("there_and_back", [True, False])
def test_a_staircase_stands_on_each_tread(there_and_back):
    segment = Staircase(
        kind="staircase", step_m=(0.0, 0.0, 50e-9), steps=3, dwell_s=0.01, settle_s=0.004,
        there_and_back=there_and_back, **limits,
    )  # fmt: skip
    trajectory = Trajectory([MOVE, segment])
    timed = trajectory.segments[1]
    levels = [1, 2, 3, 2, 1, 0] if there_and_back else [1, 2, 3]
    assert len(timed.lines_us) == len(levels)
    for level, (begin, end) in zip(levels, timed.lines_us, strict=True):
        assert end - begin == pytest.approx(6000, abs=2)
        rows = trajectory.sample(begin, end - begin, 1)
        assert rows[:, 2] == pytest.approx(CENTRE[2] + level * 50e-9, abs=1e-15)
        assert np.abs(rows[:, 3:6]).max() < 1e-12


def test_a_move_is_straight():
    trajectory = Trajectory([MOVE, Move(kind="move", to_m=(-4e-6, 1e-6, 18e-6), **limits)])
    begin, end = trajectory.segments[1].t_start_us, trajectory.segments[1].t_end_us
    rows = trajectory.sample(begin, end - begin + 1, 1)
    assert distance_to_leg(rows[:, :3], CENTRE, np.array([-4e-6, 1e-6, 18e-6])).max() < 1e-15


@pytest.mark.parametrize(
    ("kind", "given", "message"),
    [
        (Spiral, {"kind": "spiral", "radius_m": 1e-6, "inner_radius_m": 1e-7, "pitch_m": 1e-7}, "give one of speed"),
        (
            Spiral,
            {"kind": "spiral", "radius_m": 1e-6, "inner_radius_m": 2e-6, "pitch_m": 1e-7, "frequency_hz": 1.0},
            "not inside radius_m",
        ),
        (
            Sweep,
            {"kind": "sweep", "axis": "x", "amplitude_m": 1e-6, "from_hz": 9.0, "to_hz": 9.0, "duration_s": 1.0},
            "use kind = 'sine'",
        ),
        (
            Lissajous,
            {"kind": "lissajous", "amplitude_m": (1e-6, 0.0, 0.0), "frequency_hz": (0.0, 9.0, 0.0), "duration_s": 1.0},
            "nothing would move",
        ),
        (Steps, {"kind": "steps", "by_m": (0.0, 0.0, 0.0), "dwell_s": 1.0}, "by_m is zero"),
        (
            Staircase,
            {"kind": "staircase", "step_m": (1e-6, 0.0, 0.0), "steps": 1, "dwell_s": 1.0, "settle_s": 1.0, **limits},
            "nothing is left",
        ),
        (Waypoints, {"kind": "waypoints", "points_m": (), **limits}, "at least 1 item"),
    ],
)
def test_a_segment_that_means_nothing_is_refused(kind, given, message):
    with pytest.raises(ValidationError, match=message):
        kind(**given)


def test_a_spiral_with_no_room_to_stop_and_a_point_given_twice_are_refused():
    tight = Spiral(
        kind="spiral", radius_m=1.2e-6, inner_radius_m=0.6e-6, pitch_m=1e-6, speed_m_per_s=1e-4, lead_out_turns=5.0
    )  # fmt: skip
    with pytest.raises(TrajectoryError, match=r"reference\.1 \(spiral\): the lead-out would turn back"):
        Trajectory([MOVE, tight])
    with pytest.raises(TrajectoryError, match=r"reference\.1 \(waypoints\): points_m\.1 is where the path already is"):
        Trajectory([MOVE, Waypoints(kind="waypoints", points_m=((0.0, 0.0, 1e-6),) * 2, **limits)])

"""Trajectories: continuity and limits of whatever is planned, sampling that doesn't depend on how it is asked for."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pkxyz_ctrl.config.files import CONFIG_DIR, FrozenModel, parse, read_toml
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory import Hold, Move, Raster, Segment, Trajectory, TrajectoryError
from pkxyz_ctrl.trajectory.check import check_against
from pkxyz_ctrl.trajectory.motion import at_rest
from pkxyz_ctrl.trajectory.pieces import advance, joined
from pkxyz_ctrl.trajectory.raster import reversal, reversal_time_s, step, step_time_s
from pkxyz_ctrl.trajectory.segments import Limits, travel

micrometres = st.floats(-20e-6, 20e-6)
limits = st.fixed_dictionaries(
    {
        "velocity_max_m_per_s": st.floats(1e-4, 5e-3),
        "acceleration_max_m_per_s2": st.floats(0.02, 5.0),
        "jerk_max_m_per_s3": st.floats(5.0, 5000.0),
    }
)
moves = st.builds(
    lambda to, bounds: Move(kind="move", to_m=to, **bounds), st.tuples(micrometres, micrometres, micrometres), limits
)
rasters = st.builds(
    lambda bounds, **shape: Raster(kind="raster", **shape, **bounds),
    limits,
    centre_m=st.none() | st.tuples(micrometres, micrometres, micrometres),
    line_length_m=st.floats(0.1e-6, 10e-6),
    lines=st.integers(1, 5),
    line_pitch_m=st.floats(0.0, 1e-6),
    layers=st.integers(1, 3),
    layer_pitch_m=st.floats(0.0, 2e-6),
    line_rate_hz=st.floats(2.0, 200.0),
)
holds = st.builds(lambda s: Hold(kind="hold", duration_s=s), st.floats(1e-4, 0.1))


def planned(segments):
    """The trajectory, if limits allow what hypothesis asked for (that others are refused is tested below)."""
    try:
        return Trajectory(segments)
    except TrajectoryError as error:
        assume("beyond" not in str(error) and "nowhere" not in str(error))
        raise


def pieces_of(trajectory):
    """Durations, states and jerks of every piece; the last, of standing still at the end, has no duration."""
    every = joined(trajectory._motions)
    return every.duration_s[:-1], every.state, every.jerk_m_per_s3


@settings(max_examples=60)
@given(st.lists(holds | moves | rasters, min_size=1, max_size=3))
def test_position_velocity_and_acceleration_are_continuous_from_rest_to_rest(segments):
    trajectory = planned(segments)
    duration, state, jerk = pieces_of(trajectory)
    assert np.array_equal(state[0], np.zeros((3, 3)))
    for n in range(len(duration)):
        jump = np.abs(advance(state[n], jerk[n], duration[n]) - state[n + 1]).max(axis=1)
        # ruckig's times are exact to about a nanosecond: times the largest jerk asked for, 5e-6 m/s2
        assert np.all(jump < (1e-13, 1e-11, 5e-6)), f"piece {n} of {len(duration)}"
    assert np.array_equal(state[-1][1:], np.zeros((2, 3)))
    end = trajectory.sample(trajectory.duration_us, 1, 1)[0]
    assert np.array_equal(end, np.concatenate([trajectory.end_m, np.zeros(6)]))


@settings(max_examples=60)
@given(moves | rasters)
def test_no_axis_ever_passes_its_limits(segment):
    trajectory = planned([segment])
    duration, state, jerk = pieces_of(trajectory)
    # in a piece of constant jerk acceleration is extreme at its ends, velocity there or where acceleration crosses zero
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = np.nan_to_num(-state[:-1, 2] / jerk[:-1], posinf=0, neginf=0)
    crossing = np.clip(crossing, 0, duration[:, None])
    velocity = state[:-1, 1] + state[:-1, 2] * crossing + jerk[:-1] * crossing**2 / 2
    slack = 1 + 1e-6
    assert np.abs(velocity).max() <= segment.velocity_max_m_per_s * slack
    assert np.abs(state[:, 1]).max() <= segment.velocity_max_m_per_s * slack
    assert np.abs(state[:, 2]).max() <= segment.acceleration_max_m_per_s2 * slack
    assert np.abs(jerk).max() <= segment.jerk_max_m_per_s3 * slack
    reached = max(
        np.abs(state[:, 1]).max() / segment.velocity_max_m_per_s,
        np.abs(state[:, 2]).max() / segment.acceleration_max_m_per_s2,
        np.abs(jerk).max() / segment.jerk_max_m_per_s3,
    )
    assert reached > 0.999, "some limit has to bind, or the move is slower than it may be"


@settings(max_examples=40)
@given(rasters, st.integers(0, 3000), st.integers(1, 400), st.integers(1, 50), st.sampled_from([50, 200, 500]))
def test_a_tick_has_the_same_bits_however_it_is_asked_for(segment, first, count, chunk, period_us):
    trajectory = planned([segment, Hold(kind="hold", duration_s=0.01)])
    whole = trajectory.sample(first, count, period_us)
    starts = range(first, first + count, chunk)
    parts = [trajectory.sample(n, min(chunk, first + count - n), period_us) for n in starts]
    assert np.concatenate(parts).tobytes() == whole.tobytes()


@settings(max_examples=40)
@given(rasters)
def test_raster_passes_every_line_at_one_speed_in_serpentine_order(segment):
    trajectory = planned([segment])
    timed = trajectory.segments[0]
    assert len(timed.lines_us) == segment.lines * segment.layers
    assert timed.scan_us == (timed.lines_us[0][0], timed.lines_us[-1][1])
    assert timed.t_start_us < timed.scan_us[0] < timed.scan_us[1] < timed.t_end_us
    centre = np.array(segment.centre_m or (0.0, 0.0, 0.0))
    speed = segment.line_speed_m_per_s()
    rows = [np.arange(segment.lines)[:: 1 if layer % 2 == 0 else -1] for layer in range(segment.layers)]
    for n, ((begin, end), row) in enumerate(zip(timed.lines_us, np.concatenate(rows), strict=True)):
        way = 1 if n % 2 == 0 else -1
        at_begin, at_end = trajectory.sample(begin, 1, 1)[0], trajectory.sample(end, 1, 1)[0]
        y = centre[1] + (row - (segment.lines - 1) / 2) * segment.line_pitch_m
        z = centre[2] + (n // segment.lines - (segment.layers - 1) / 2) * segment.layer_pitch_m
        tolerance = 1e-12 + speed * 2e-6  # line ends are inside by up to a microsecond each
        assert at_begin[:3] == pytest.approx([centre[0] - way * segment.line_length_m / 2, y, z], abs=tolerance)
        assert at_end[:3] == pytest.approx([centre[0] + way * segment.line_length_m / 2, y, z], abs=tolerance)
        inside = np.concatenate([trajectory.sample(t, 1, 1) for t in range(begin + 2, end - 2, (end - begin) // 7)])
        assert inside[:, 3] == pytest.approx(way * speed, rel=1e-9)
        assert np.abs(inside[:, [4, 5]]).max() < 1e-10
        assert np.abs(inside[:, 6:]).max() < 1e-7
    if len(timed.lines_us) > 1:
        starts = np.array([begin for begin, _ in timed.lines_us])
        assert np.diff(starts) == pytest.approx(1e6 / segment.line_rate_hz, abs=1.001)


@settings(max_examples=200)
@given(
    st.floats(1e-6, 1e-2), st.floats(1e-9, 1e-5), st.floats(0.01, 10), st.floats(1.0, 1e4), st.floats(1.0, 3.0)
)  # fmt: skip
def test_turn_around_profiles_arrive_and_stay_inside_limits(speed, distance, a, j, slack):
    bounds = Limits(speed, a, j)
    time_s = reversal_time_s(speed, a, j) * slack
    state = run(reversal(speed, bounds, time_s), (0.0, -speed, 0.0), bounds)
    assert state == pytest.approx((0.0, speed, 0.0), abs=1e-9 * max(speed, speed * time_s))
    shortest = step_time_s(distance, bounds)
    state = run(step(-distance, bounds, shortest * slack), (0.0, 0.0, 0.0), bounds)
    assert state[0] == pytest.approx(-distance, rel=1e-9)
    assert abs(state[1]) < 1e-8 * distance / shortest
    assert abs(state[2]) < 1e-9 * a
    # the independent planner finds no shorter step, and this one is no longer than that
    assert travel(at_rest([0, 0, 0]), at_rest([distance, 0, 0]), bounds).total_s == pytest.approx(shortest, rel=3e-3)


def run(phases, start, bounds):
    v_max, a_max, j_max = bounds
    p, v, a = start
    for t, j in zip(*phases, strict=True):
        assert t >= 0
        assert abs(j) <= j_max * (1 + 1e-9)
        p, v, a = p + t * (v + t * (a / 2 + t * j / 6)), v + t * (a + t * j / 2), a + t * j
        assert abs(a) <= a_max * (1 + 1e-9)
        assert abs(v) <= v_max * (1 + 1e-9)
    return p, v, a


def test_a_line_rate_beyond_the_limits_is_refused_with_the_rate_that_is_possible():
    shape = {
        "kind": "raster", "line_length_m": 4e-6, "lines": 3, "line_pitch_m": 0.3e-6, "velocity_max_m_per_s": 5e-3,
        "acceleration_max_m_per_s2": 0.5, "jerk_max_m_per_s3": 300.0,
    }  # fmt: skip
    with pytest.raises(TrajectoryError, match=r"reference\.1 \(raster\): .* beyond the ([0-9.]+) lines/s") as refused:
        Trajectory([Hold(kind="hold", duration_s=0.01), Raster(line_rate_hz=1000.0, **shape)])
    possible = float(str(refused.value).split("beyond the ")[1].split()[0])
    Raster(line_rate_hz=possible * 0.999, **shape).line_speed_m_per_s()
    with pytest.raises(TrajectoryError):
        Raster(line_rate_hz=possible * 1.001, **shape).line_speed_m_per_s()


def test_move_and_hold_by_hand():
    # 1 um at jerk 1000 m/s3 with nothing else binding: T = 4 (d / 2j)^(1/3)
    move = Move(
        kind="move", to_m=(1e-6, 0.0, 0.0), velocity_max_m_per_s=1.0, acceleration_max_m_per_s2=100.0,
        jerk_max_m_per_s3=1000.0,
    )  # fmt: skip
    trajectory = Trajectory([move, Hold(kind="hold", duration_s=0.05, settle_s=0.02)])
    first, second = trajectory.segments
    assert first.t_end_us == np.ceil(4 * (1e-6 / 2000) ** (1 / 3) * 1e6)
    assert second.still_us == (first.t_end_us + 20_000, first.t_end_us + 50_000)
    assert trajectory.duration_us == first.t_end_us + 50_000
    half = trajectory.sample(0, 2, round(2 * (1e-6 / 2000) ** (1 / 3) * 1e6))[1]
    assert half[0] == pytest.approx(0.5e-6, rel=1e-3)
    with pytest.raises(TrajectoryError, match=r"reference\.1 \(move\): .*nowhere"):
        Trajectory([move, move])
    with pytest.raises(TrajectoryError, match="no segments"):
        Trajectory([])


def test_segments_begin_where_they_are_told_to():
    limits = {"velocity_max_m_per_s": 0.5e-3, "acceleration_max_m_per_s2": 0.5, "jerk_max_m_per_s3": 300.0}
    start_m = (1e-6, -2e-6, 18e-6)
    wait = Hold(kind="hold", duration_s=0.01)
    raster = Raster(kind="raster", line_length_m=2e-6, lines=3, line_pitch_m=0.1e-6, line_rate_hz=60.0, **limits)
    away = Trajectory([wait, raster, wait], start_m=np.array(start_m))
    from_rest = Trajectory([wait, raster, wait])
    rows, same = (each.sample(-1, away.duration_us // 200 + 3, 200) for each in (away, from_rest))
    assert away.duration_us == from_rest.duration_us
    same[:, 0:3] += start_m
    for n, rounding in ((0, 1e-15), (3, 1e-12), (6, 1e-8)):
        assert np.allclose(rows[:, n : n + 3], same[:, n : n + 3], rtol=0.0, atol=rounding)
    assert np.array_equal(rows[[0, 1, -1], 0:3], [start_m] * 3)
    assert np.array_equal(away.end_m, start_m)
    move = Move(kind="move", to_m=start_m, **limits)
    with pytest.raises(TrajectoryError, match=r"reference\.0 \(move\): .*nowhere"):
        Trajectory([move], start_m=start_m)
    for wrong in ((0.0, np.nan, 0.0), (0.0, np.inf, 0.0), (0.0, 0.0), ((0.0, 0.0, 0.0),)):
        with pytest.raises(TrajectoryError, match=r"begins at .* three finite numbers"):
            Trajectory([move], start_m=wrong)


def test_the_default_scan_can_be_followed_and_worse_ones_say_where_and_why_not():
    class Reference(FrozenModel):
        reference: tuple[Segment, ...]

    source = CONFIG_DIR / "scenarios" / "raster.toml"
    data = {"reference": read_toml(source)["reference"]}
    stage = Stage.load("reconstructed")
    check_against(stage, Trajectory(parse(data, Reference, str(source)).reference))
    bounds = {"velocity_max_m_per_s": 1e-3, "acceleration_max_m_per_s2": 0.1, "jerk_max_m_per_s3": 20.0}
    harsh = {"velocity_max_m_per_s": 0.1, "acceleration_max_m_per_s2": 100.0, "jerk_max_m_per_s3": 1e6}
    weak = Stage(
        stage.config.model_copy(update={"limits": stage.config.limits.model_copy(update={"voltage_max_v": 150.0})})
    )
    needed = float(stage.holding_voltages(np.array([0.0, 0.0, 30e-6])).max())
    cases = [
        (stage, [(0.0, 0.0, -1e-6)], "at its target .* stroke 1 would be -.* outside 0 to 25 um"),
        (stage, [(0.0, 0.0, 2e-6), (0.0, 0.0, 0.0)], r"reference\.1 .* on its way, .* combs only pull"),
        (stage, [(0.0, 0.0, 400e-6)], "at its target .* reach of the out-of-plane links"),
        (weak, [(0.0, 0.0, 30e-6)], rf"comb [123] would need {needed:.1f} V, beyond the limit of 150 V"),
    ]
    for device, targets, message in cases:
        limits = [bounds, harsh][: len(targets)]
        trajectory = Trajectory(
            [Move(kind="move", to_m=to, **given) for to, given in zip(targets, limits, strict=True)]
        )
        with pytest.raises(TrajectoryError, match=message):
            check_against(device, trajectory)

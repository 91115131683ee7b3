"""Learning without a loop: harmonics, timetable, what a window teaches, the stored file, and what is refused."""

import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learning_rig import LINES, PERIOD, setup, trajectory

from hil.runs.learning import belongs
from pkxyz_ctrl.config.files import ConfigError, parse
from pkxyz_ctrl.learning import LearningConfig, LearningError, timetable
from pkxyz_ctrl.learning.harmonics import count_up_to, fade, harmonics, noise, period_rows, weighted
from pkxyz_ctrl.learning.store import Stored, load, require_same, save
from pkxyz_ctrl.learning.timetable import FADE_TICKS, LEAD_TICKS, SETTLE_TICKS, WINDOW_MIN_TICKS
from pkxyz_ctrl.learning.update import beginning, learn
from pkxyz_ctrl.trajectory import Circle, Hold, Lissajous, Raster, Sine, Trajectory

N, TICK_S = 400, 200e-6
QUICK = settings(max_examples=30)


def some_harmonics(seed: int, count: int = 40, size_m: float = 20e-9):
    dice = np.random.default_rng(seed)
    return (
        size_m * (dice.normal(size=(count, 3)) + 1j * dice.normal(size=(count, 3))) / np.arange(1, count + 1)[:, None]
    )


# -- harmonics ------------------------------------------------------------------------------------------------------


@QUICK
@given(st.integers(0, 1000), st.integers(0, 3 * N))
def test_harmonics_and_rows_are_each_others_inverse_wherever_the_window_begins(seed, phase):
    correction = some_harmonics(seed)
    rows = period_rows(correction, N, TICK_S)
    assert harmonics(np.roll(rows[:, 0:3], -phase, axis=0), phase, 40) == pytest.approx(correction, abs=1e-20)


@QUICK
@given(st.integers(0, 1000))
def test_velocity_and_acceleration_are_derivatives(seed):
    """By differences of order eight on a grid that is a tenth as fine as the finest harmonic's period."""
    rows = period_rows(some_harmonics(seed, count=10), N, TICK_S)
    weights = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
    for low in (0, 3):
        value = rows[:, low : low + 3]
        slope = sum(w * (np.roll(value, -k, axis=0) - np.roll(value, k, axis=0)) for k, w in weights.items()) / TICK_S
        assert slope == pytest.approx(rows[:, low + 3 : low + 6], abs=2e-6 * np.abs(slope).max())


def test_a_fade_is_a_smooth_step_and_the_product_rule_holds():
    tick = np.arange(-10, FADE_TICKS + 10)
    value, slope, curvature = fade(tick, 0, TICK_S)
    assert value[0] == slope[0] == curvature[0] == 0.0
    assert (value[-1], slope[-1], curvature[-1]) == (1.0, 0.0, 0.0)
    assert (np.diff(value) >= 0).all()
    rows = weighted(
        np.tile([2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0, 19.0, 23.0], (len(tick), 1)), (value, slope, curvature)
    )
    assert rows[:, 0:3] == pytest.approx(value[:, None] * [2, 3, 5])
    assert rows[:, 3:6] == pytest.approx(slope[:, None] * [2, 3, 5] + value[:, None] * [7, 11, 13])
    assert rows[:, 6:9] == pytest.approx(
        curvature[:, None] * [2, 3, 5] + 2 * slope[:, None] * [7, 11, 13] + value[:, None] * [17, 19, 23]
    )
    fine = fade(np.linspace(0, FADE_TICKS, 20001), 0, TICK_S)
    step_s = FADE_TICKS * TICK_S / 20000
    assert np.gradient(fine[0], step_s)[1:-1] == pytest.approx(fine[1][1:-1], abs=1e-3)
    assert np.gradient(fine[1], step_s)[1:-1] == pytest.approx(fine[2][1:-1], rel=1e-3, abs=1.0)


def test_noise_is_measured_where_no_scan_is_even_beside_a_line():
    dice = np.random.default_rng(5)
    white = 2e-9 * dice.normal(size=(200, N, 3))
    found = np.mean([noise(error) for error in white], axis=0)
    assert found == pytest.approx(np.full(3, (2e-9) ** 2 / N), rel=0.06)
    line = 50e-9 * np.sin(2 * np.pi * 150 * np.arange(N) / N)[:, None]
    assert np.mean([noise(error + line) for error in white], axis=0) == pytest.approx(found, rel=0.05)


@pytest.mark.parametrize(
    ("cutoff_hz", "period", "count"), [(450.0, 400, 36), (450.0, 200, 18), (1e4, 400, 99), (1, 20, 1)]
)
def test_harmonics_up_to_the_cutoff(cutoff_hz, period, count):
    assert count_up_to(cutoff_hz, period, TICK_S) == count


# -- what a window teaches ------------------------------------------------------------------------------------------


def lessons(response, windows, noise_m=2e-9, seed=1, disturbance=None, start=None):
    """A linear loop: E = D + M C and noise. Errors without noise by window, and what is known in the end."""
    dice = np.random.default_rng(seed)
    d = some_harmonics(seed) if disturbance is None else disturbance
    known = beginning(np.zeros_like(d) if start is None else start, 1.0)
    sigma = noise_m / math.sqrt(2 * N)
    errors = []
    for _ in range(windows):
        clean = d + np.einsum("kij,kj->ki", response, known.correction)
        seen = clean + sigma * (dice.normal(size=d.shape) + 1j * dice.normal(size=d.shape))
        errors.append(math.sqrt(2 * (np.abs(clean) ** 2).sum()))
        known, _ = learn(known, seen, np.full(3, noise_m**2 / N))
    return np.array(errors), known


def responses(seed, size):
    dice = np.random.default_rng(seed)
    return np.eye(3) + size * (dice.uniform(-1, 1, (40, 3, 3)) + 1j * dice.uniform(-1, 1, (40, 3, 3))) / math.sqrt(6)


@QUICK
@given(st.integers(0, 10_000), st.floats(0.0, 0.3))
def test_a_loop_near_its_model_is_ten_times_better_after_three_windows(seed, size):
    errors, _ = lessons(responses(seed, size), 4, seed=seed)
    assert errors[3] < 0.1 * errors[0]


@QUICK
@given(st.integers(0, 10_000), st.floats(-4.0, 4.0))
def test_a_loop_that_answers_as_it_likes_never_stays_worse(seed, factor):
    """Down to the wrong sign, and four times as strong: what is kept in the end is no worse than nothing."""
    m = np.tile(factor * np.eye(3, dtype=complex), (40, 1, 1))
    errors, known = lessons(m, 12, seed=seed)
    d = some_harmonics(seed)
    kept = d + np.einsum("kij,kj->ki", m, known.best)
    worst_noise = 5.0 * 2e-9 * math.sqrt(40 * 3 / N)
    assert math.sqrt(2 * (np.abs(kept) ** 2).sum()) < errors[0] + worst_noise


@QUICK
@given(st.integers(0, 10_000))
def test_of_noise_alone_less_than_half_is_learnt_and_less_with_time(seed):
    nothing = np.zeros((40, 3), complex)
    first, known = lessons(np.tile(np.eye(3), (40, 1, 1)), 2, seed=seed, disturbance=nothing)
    floor = 2e-9 * math.sqrt(2 * 40 * 3 / N)
    assert first[1] < 0.5 * floor
    assert np.abs(known.correction).max() < 1e-9


@QUICK
@given(st.integers(0, 10_000))
def test_a_device_that_changes_meanwhile_is_learnt_anew(seed):
    m = responses(seed, 0.2)
    _, known = lessons(m, 6, seed=seed)
    other = some_harmonics(seed + 1)
    d = other - np.einsum("kij,kj->ki", m, known.correction)
    dice = np.random.default_rng(seed)
    errors = []
    for _ in range(6):
        clean = d + np.einsum("kij,kj->ki", m, known.correction)
        errors.append(math.sqrt(2 * (np.abs(clean) ** 2).sum()))
        seen = clean + 1e-10 * dice.normal(size=clean.shape)
        known, _ = learn(known, seen, np.full(3, 4e-18 / N))
    assert errors[0] > 10e-9
    assert min(errors[3:]) < 0.15 * errors[0]


# -- when -----------------------------------------------------------------------------------------------------------


@QUICK
@given(st.integers(2, 12), st.sampled_from([2, 4, 10]), st.sampled_from([25.0, 50.0]))
def test_windows_are_whole_periods_and_what_they_teach_acts_inside_the_scan(frames, lines, rate_hz):
    scan = Trajectory([
        Raster(
            kind="raster", line_length_m=2e-6, lines=lines, line_pitch_m=0.1e-6, frames=frames, line_rate_hz=rate_hz,
            velocity_max_m_per_s=1e-3, acceleration_max_m_per_s2=1.0, jerk_max_m_per_s3=500.0,
        )
    ])  # fmt: skip
    try:
        table = timetable(scan, 200)
    except LearningError:
        assert scan.segments[0].scan_us is not None
        begin, end = scan.segments[0].scan_us
        assert (
            end - begin
        ) // 200 < 2 * lines * 5000 / rate_hz + LEAD_TICKS + FADE_TICKS + SETTLE_TICKS + WINDOW_MIN_TICKS
        return
    assert table.period == lines * 5000 / rate_hz
    assert table.window % table.period == 0
    assert table.window >= WINDOW_MIN_TICKS
    assert table.periods in (frames - 1, frames)
    for n in range(table.windows):
        assert table.change(n) >= table.window_end(n) + LEAD_TICKS
        assert table.window_begin(n + 1) >= table.change(n) + FADE_TICKS
        assert table.change(n) + FADE_TICKS <= table.end
    assert table.change(table.windows) + FADE_TICKS > table.end


def test_a_frame_repeats_itself_after_its_period():
    table = timetable(trajectory(), 200)
    assert table.period == PERIOD
    period = trajectory().sample(table.begin, PERIOD, 200)
    for n in range(1, table.periods):
        again = trajectory().sample(table.begin + n * PERIOD, PERIOD, 200)
        assert again[:, 0:3] == pytest.approx(period[:, 0:3], abs=1e-14)
        assert again[:, 3:9] == pytest.approx(period[:, 3:9], abs=1e-7)


@pytest.mark.parametrize(
    ("segment", "period_s"),
    [
        (Circle(kind="circle", radius_m=1e-6, frequency_hz=100.0, turns=80.0), 0.01),
        (Sine(kind="sine", axis="y", amplitude_m=1e-6, frequency_hz=12.5, cycles=10.0), 0.08),
        (
            Lissajous(
                kind="lissajous", amplitude_m=(1e-6, 1e-6, 0.0), frequency_hz=(30.0, 40.0, 7.0), duration_s=1.0
            ),
            0.1,
        ),
        (Hold(kind="hold", duration_s=1.0), None),
    ],
)  # fmt: skip
def test_periods_of_what_repeats(segment, period_s):
    assert Trajectory([segment]).segments[0].period_s == (None if period_s is None else pytest.approx(period_s))


def circle(frequency_hz: float, turns: float = 50.0):
    return Circle(kind="circle", radius_m=1e-6, frequency_hz=frequency_hz, turns=turns)


@pytest.mark.parametrize(
    ("segments", "words"),
    [
        ([Hold(kind="hold", duration_s=1.0)], "exactly one segment that repeats .* none does"),
        ([circle(100.0), circle(50.0)], r"reference\.0 \(circle\), reference\.1 \(circle\)"),
        ([circle(30.0)], r"33\.3333 ms, which is 166\.667 ticks of 200 us; choose a rate"),
        ([circle(500.0)], "repeats after 10 ticks; at least 16"),
        ([circle(100.0, 4.0)], r"lasts 200 ticks and needs 400; let it run for more periods \(frames, turns"),
    ],
)
def test_what_cannot_be_learnt_is_refused_with_a_remedy(segments, words):
    with pytest.raises(LearningError, match=words):
        timetable(Trajectory(segments), 200)


def test_frames_of_an_odd_number_of_lines_are_refused():
    with pytest.raises(ValueError, match="end on the far side"):
        Raster(
            kind="raster", line_length_m=2e-6, lines=3, line_pitch_m=0.1e-6, frames=2, line_rate_hz=50.0,
            velocity_max_m_per_s=1e-3, acceleration_max_m_per_s2=1.0, jerk_max_m_per_s3=500.0,
        )  # fmt: skip


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ({"mode": "apply"}, "needs the file"),
        ({"mode": "refresh"}, "needs the file"),
        ({"mode": "learn", "file": "a.json"}, "learn begins with nothing"),
        ({"gain": 1.5}, "gain: .*1"),
        ({"cutoff": 100.0}, "unknown key"),
    ],
)
def test_a_wrong_section_is_one_line(section, words):
    with pytest.raises(ConfigError, match=words):
        parse(section, LearningConfig, "x.toml")


# -- the stored file ------------------------------------------------------------------------------------------------


@pytest.fixture
def here():
    run = setup()
    return belongs(run.trajectory, run.stage, run.controller, run.bus)


@QUICK
@given(seed=st.integers(0, 1000))
def test_a_correction_comes_back_from_its_file_bit_for_bit(tmp_path_factory, seed):
    run = setup()
    stored = Stored(
        belongs(run.trajectory, run.stage, run.controller, run.bus), some_harmonics(seed), {"scenario": "a"}
    )
    path = tmp_path_factory.mktemp("learnt") / "learnt.json"
    save(stored, path)
    again = load(path)
    assert np.array_equal(again.harmonics_m, stored.harmonics_m)
    assert again.provenance == {"scenario": "a"}
    require_same(again, stored.belongs, "x")


def test_a_correction_of_another_run_is_refused_by_name(here):
    run = setup()
    stored = Stored(here, some_harmonics(1), {})
    require_same(stored, here, "a.json")
    longer = belongs(trajectory(12), run.stage, run.controller, run.bus)  # more frames of the same
    require_same(stored, longer, "a.json")
    moved = belongs(trajectory(9, 0.2e-6), run.stage, run.controller, run.bus)
    with pytest.raises(LearningError, match=r"a\.json: belongs to another trajectory: .* up to 0\.\d+ um away"):
        require_same(stored, moved, "a.json")
    slower = run.bus.model_copy(update={"period_us": 400})
    with pytest.raises(LearningError, match=rf"period is {PERIOD} ticks of 200 us, here it is {PERIOD // 2} of 400"):
        require_same(stored, belongs(run.trajectory, run.stage, run.controller, slower), "a.json")
    other = run.controller.model_copy(update={"homing_s": 0.06})
    with pytest.raises(LearningError, match="learnt with another controller; learn anew"):
        require_same(stored, belongs(run.trajectory, run.stage, other, run.bus), "a.json")
    assert LINES % 2 == 0


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such file; learn first"),
        ("not json", "cannot be read as a stored correction"),
        ("[]", "is not a stored correction"),
        ('{"format": "pkxyz learning 1"}', "is damaged: KeyError"),
    ],
)
def test_a_file_that_is_none_is_one_line(tmp_path, content, words):
    path = tmp_path / "learnt.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(LearningError, match=words):
        load(path)


def test_a_damaged_file_is_refused(tmp_path, here):
    path = tmp_path / "learnt.json"
    save(Stored(here, some_harmonics(1), {}), path)
    data = json.loads(path.read_text())
    data["sine_m"] = data["sine_m"][:-1]
    path.write_text(json.dumps(data))
    with pytest.raises(LearningError, match="is damaged: ValueError: cosines and sines"):
        load(path)
    with pytest.raises(LearningError, match="cannot be written"):
        save(Stored(dataclasses.replace(here), some_harmonics(1), {}), tmp_path / "no" / "folder.json")

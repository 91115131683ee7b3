"""Identification of the plant in its running loop, against what the plant really is."""

import dataclasses
import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import MIDDLE, bus, controller, stage
from sim_truth import truth_about
from typer.testing import CliRunner

import hil
from hil.cli import app
from hil.lanes.excitation import Excitation, Passage, excitation, tones
from hil.lanes.lane import Lane
from hil.lanes.setup import bare_setup
from hil.studies.identify.calibrated_stage import write_calibrated_stage
from hil.studies.identify.identification import as_json, exciting, identify, modes_hz
from hil.studies.identify.outside_scale import outside_scale, read_points
from hil.studies.identify.plant_response import _spectra, _trend, measure_plant
from hil.studies.margins.excited import at_point
from pkxyz_ctrl.config.files import ConfigError, find
from pkxyz_ctrl.design.identification.modal_fit import FitError, fit_modes
from sim.motion.geometry import strokes

CHAINS = range(3)


@cache
def bench(plant="harsh"):
    return bare_setup("reconstructed", plant, controller(), bus(), 1)


@cache
def found(plant="harsh", kind="multisine"):
    """With the command's defaults."""
    return identify(
        bench(plant), MIDDLE, "fast", kind=kind, amplitude_m={"multisine": 5e-9, "stepped": 25e-9}[kind], periods=6
    )


@cache
def truth(plant="harsh", kind="multisine"):
    response = found(plant, kind).response
    return truth_about(bench(plant).new_plant(), response.mean_v2, response.measured_s)


# -- what is asked for ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["multisine", "stepped"])
def test_modes_and_gains_of_the_harsh_plant(kind):
    """Its in-plane modes overlap: 31 Hz apart, 51 Hz wide."""
    modes, is_ = found("harsh", kind).modes, truth("harsh", kind)
    assert modes.frequency_hz == pytest.approx(is_.frequency_hz, rel=0.002)
    assert modes.damping == pytest.approx(is_.damping, rel=0.10)
    assert modes.static_gain[CHAINS, CHAINS] == pytest.approx(is_.static_gain[CHAINS, CHAINS], rel=0.01)
    assert modes.noise_alone


def test_the_lab_with_its_slow_sense_chain():
    """A pole at 1.6 kHz takes 7 % off the modes' gains and turns them; beside it mains, flexible modes, 1/f noise."""
    result, is_ = found("lab"), truth("lab")
    modes, numbers = result.modes, result.calibrated.calibration
    assert modes.noise_alone
    assert modes.frequency_hz == pytest.approx(is_.frequency_hz, rel=0.01)
    assert abs(modes.sense_corner_hz - 1600.0) < 4.0 * modes.sense_corner_standard_error_hz < 2000.0
    errors = numbers.standard_error
    assert abs(numbers.sense_delay_s - 99.5e-6) < 4.0 * errors.sense_delay_s < 20e-6
    assert numbers.quality_factor == pytest.approx(18.0, rel=0.02)
    config, half_way = bench("lab").plant, 0.5  # of the overlap by which a fringe is given
    pull = (1 + np.array(config.comb_mismatch.relative)) * (1 + np.array(config.amplifier_gain.relative)) ** 2
    pull *= (1 + half_way * config.fringe.relative_per_25um) / (1 + config.mass_error.relative)
    pull *= 1 + (np.array(config.finger_misalignment.offset_m) / bench("lab").stage.drive_comb.finger_gap_m) ** 2
    assert (np.abs(np.array(numbers.comb_gain) - pull) < 4.0 * np.array(errors.comb_gain)).all()
    assert max(errors.comb_gain) < 0.0015  # by the gains alone, without the resonances: 0.015
    assert found("harsh").modes.sense_corner_hz is None  # nothing asks for a pole there


def test_no_tone_lies_on_a_line_of_the_mains():
    """It is alike in all periods: 50 Hz of the lab alone made a chi-square of 1.8."""
    for kind, seconds in (("multisine", 1.0), ("stepped", 0.1)):
        hz = np.concatenate([p.bins for p in exciting(bench(), MIDDLE, Lane.FAST, kind, 5e-9, 6).passages]) / seconds
        assert len(hz) > 60
        assert not (np.isin(np.round(hz) % 50, 0) | np.isin(np.round(hz) % 60, 0)).any()


def test_standard_errors_are_those_of_the_errors():
    """None beyond 4.5 of its standard error; a static gain may differ by 0.2 % more, for the plant drifts meanwhile."""
    modes, is_ = found().modes, truth()
    assert (np.abs(modes.frequency_hz - is_.frequency_hz) < 4.5 * modes.frequency_standard_error_hz).all()
    assert (np.abs(modes.damping - is_.damping) < 4.5 * modes.damping_standard_error).all()
    slack = 4.5 * modes.static_gain_standard_error + 0.002 * np.abs(is_.static_gain).max()
    assert (np.abs(modes.static_gain - is_.static_gain) < slack).all()
    slack = 4.5 * modes.acceleration_gain_standard_error + 0.002 * np.abs(is_.acceleration_gain).max()
    assert (np.abs(modes.acceleration_gain - is_.acceleration_gain) < slack).all()
    assert 0.9 < modes.chi_square < 1.1
    assert (modes.frequency_standard_error_hz < 1e-3 * modes.frequency_hz).all()


def test_modes_that_coincide_are_one_pair_of_poles():
    """As drawn, x and y are alike at mid-workspace: three pairs of poles would leave one to the noise, of any Q."""
    modes, is_ = found("nominal").modes, truth("nominal")
    assert modes.apart.tolist() == [True, False, True]
    assert (np.abs(modes.frequency_hz - is_.frequency_hz) < 4.5 * modes.frequency_standard_error_hz).all()
    assert (np.abs(modes.damping - is_.damping) < 4.5 * modes.damping_standard_error).all()
    assert modes.static_gain[CHAINS, CHAINS] == pytest.approx(is_.static_gain[CHAINS, CHAINS], rel=0.01)
    assert 0.9 < modes.chi_square < 1.1
    assert found().modes.apart.all()  # 31 Hz apart they are three


def test_the_stage_file_alone_would_not_do():
    """So the harsh plant is a test: two resonances and every gain are beyond the bounds to begin with."""
    drawn = modes_hz(bench(), MIDDLE)
    assert (np.abs(drawn / truth().frequency_hz - 1.0)[:2] > 0.01).all()


def test_homing_finds_the_capacitance_at_rest():
    """Of the channel's offset and of what the tilt does to the table; both walk a little while it is looked at."""
    zero, plant = found().response.zero, bench().new_plant()
    p, at_rest = plant.params[0], np.empty(3)
    strokes(p, plant.state[0]["motion"], at_rest)
    offset_f = p["sense_offset_f"] + p["sense_f_per_m"] * at_rest + p["sense_rest_f"]
    offset_f += p["feedthrough_f_per_v"] * p["amplifier_offset_v"] - found().setup.law[0]["tick"]["sense"]["rest_f"]
    walked_f = 4.0 * p["sense_walk_f_per_rt_s"] * np.sqrt(0.1) + 1e-9 * p["sense_f_per_m"]
    assert (np.abs(zero.offset_f - offset_f) < 4.5 * zero.standard_error_f + walked_f).all()
    assert zero.samples in (249, 250)
    assert (zero.standard_error_f < 0.05e-15).all()


def test_lanes_give_the_same_bits():
    added = excitation(
        "multisine", tones(250, 20, 2), period_ticks=250, periods=3, amplitude_m=5e-9, first_tick=0, seed=1
    )
    run = at_point(bench(), MIDDLE, added)
    fast, lockstep = measure_plant(run, "fast"), measure_plant(run, "lockstep")
    assert np.array_equal(fast.drive_v2, lockstep.drive_v2)
    assert np.array_equal(fast.sense_count, lockstep.sense_count)
    assert np.array_equal(fast.zero.offset_f, lockstep.zero.offset_f)


# -- the parts, without a loop --------------------------------------------------------------------------------------


@settings(max_examples=30)
@given(st.floats(-3.0, 3.0), st.floats(0.5, 20.0), st.floats(-1.0, 1.0), st.integers(0, 2**32 - 1))
def test_what_drifts_is_no_tone(ramp, seconds, bend, seed):
    """A ramp, a parabola and an exponential of seconds beside tones of 1: the tones stand to 1e-4 of what drifts."""
    n, m = 1000, 6
    passage = Passage(0, np.array([5, 17, 130]), np.zeros(3))
    t, rng = np.arange(n * m) / n, np.random.default_rng(seed)
    spectrum = rng.normal(size=(3, 3)) + 1j * rng.normal(size=(3, 3))
    turns = np.exp(2j * np.pi * np.outer(t, passage.bins))
    drift = ramp * t + bend * t**2 + np.exp(-t / max(seconds, 3.0))
    samples = (turns @ spectrum).real + drift[:, None]
    played = Excitation(n, m, 1.0, 0, (passage,))
    seen = _spectra(samples, passage, _trend(played, np.arange(m)))
    assert np.abs(seen - spectrum).max() < 1e-4
    plain = 2 / n * np.fft.rfft(samples.reshape(m, n, 3), axis=1)[:, passage.bins]
    assert np.abs(seen - spectrum).max() <= np.abs(plain - spectrum).max() + 1e-12


def sampled_response(f, hz, damping, shapes_in, shapes_out, lag, period_s, delay_periods):
    """Exact response at the samples of modes driven through a lag of ``lag`` periods by held inputs, by matrix
    exponentials: the independent oracle of the fit's form.
    """
    w = 2 * np.pi * hz
    a = scipy.linalg.block_diag(*([[0, 1], [-wi * wi, -2 * d * wi]] for wi, d in zip(w, damping, strict=True)))
    b = np.zeros((6, 3))
    c = np.zeros((3, 6))
    for i in range(3):
        b[2 * i + 1], c[:, 2 * i] = w[i] ** 2 * shapes_in[i], shapes_out[:, i]

    def held(duration):
        whole = scipy.linalg.expm(np.block([[a, b], [np.zeros((3, 9))]]) * duration)
        return whole[:6, :6], whole[:6, 6:]

    phi, _ = held(period_s)
    late, old = held((1 - lag) * period_s), held(lag * period_s)
    z = np.exp(2j * np.pi * f * period_s)
    through = late[1][None] + (late[0] @ old[1])[None] / z[:, None, None]
    return c @ np.linalg.solve(z[:, None, None] * np.eye(6) - phi, through) * z[:, None, None] ** -delay_periods


@settings(max_examples=4)
@given(st.floats(0.0, 0.9), st.floats(0.005, 0.1), st.floats(0.005, 0.08), st.integers(1, 2), st.integers(0, 2**32 - 1))
def test_the_fit_is_exact_where_there_is_no_noise(lag, split, damping, delay_periods, seed):
    rng = np.random.default_rng(seed)
    hz = np.array([600.0, 600.0 * (1 + split), 780.0])
    ratios = damping * rng.uniform(0.8, 1.2, 3)
    shapes_in, shapes_out = (np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2))
    f = np.unique(np.round(np.geomspace(5, 1500, 90)))
    p = sampled_response(f, hz, ratios, shapes_in, shapes_out, lag, 200e-6, delay_periods)
    u = rng.normal(size=(len(f), 3, 3)) + 1j * rng.normal(size=(len(f), 3, 3))
    fit = fit_modes(
        f, u, p @ u, np.full((len(f), 3), 1e-3), period_s=200e-6, delay_periods=delay_periods,
        start_hz=np.array([619.0, 619.0, 778.0]), start_damping=0.025,
    )  # fmt: skip
    assert fit.frequency_hz == pytest.approx(hz, rel=1e-5)
    assert fit.damping == pytest.approx(ratios, rel=1e-3)
    assert np.abs(fit.static_gain - shapes_out @ shapes_in).max() < 1e-4
    assert np.abs(fit.response(f) - p).max() < 1e-3
    acceleration = (shapes_out * (2 * np.pi * hz) ** 2) @ shapes_in
    assert np.abs(fit.acceleration_gain - acceleration).max() < 1e-3 * np.abs(acceleration).max()


def test_too_few_tones_are_refused():
    f = np.linspace(100, 900, 8)
    ones = np.ones((8, 3, 3), complex)
    with pytest.raises(FitError, match="too few"):
        fit_modes(
            f, ones, ones, np.ones((8, 3)), period_s=200e-6, delay_periods=1, start_hz=np.full(3, 600.0),
            start_damping=0.02,
        )  # fmt: skip


def test_stepped_tones_crowd_about_the_modes():
    added = exciting(bench(), MIDDLE, Lane.FAST, "stepped", 25e-9, 6)
    hz = np.unique(np.concatenate([p.bins for p in added.passages])) / (added.period_ticks * 200e-6)
    near = (hz > 500) & (hz < 900)
    assert near.sum() > 15
    assert len(hz) - near.sum() > 8
    assert len(added.passages) == 3 * len(hz)


# -- the scale, from outside ------------------------------------------------------------------------------------------

POINTS_M = np.array([[0, 0, 10], [2, 0, 18], [-2, 1, 18], [0, -2, 24], [1, 1.5, 21], [0, 0, 19]]) * 1e-6


def seen_by_an_instrument(gain, origin_m, commanded_m):
    """Where the table is when the controller takes it to be at ``commanded_m``, from another origin."""
    believed = stage().inverse_kinematics(commanded_m)
    return stage().forward_kinematics(believed / gain) + origin_m


@settings(max_examples=50)
@given(
    st.lists(st.floats(0.9, 1.1), min_size=3, max_size=3), st.lists(st.floats(-50e-6, 50e-6), min_size=3, max_size=3)
)
def test_an_outside_reference_gives_each_chains_sense_gain(gain, origin_m):
    """Exactly, whatever the instrument's origin."""
    found = outside_scale(stage(), POINTS_M, seen_by_an_instrument(np.array(gain), np.array(origin_m), POINTS_M))
    assert found.sense_gain == pytest.approx(gain, rel=1e-6)
    assert found.origin_m == pytest.approx(origin_m, abs=1e-11)
    assert found.residual_m < 1e-11


def test_its_standard_errors_are_those_of_its_errors():
    """100 instruments with 5 nm of noise: mean square of error over standard error is 1 within its own scatter."""
    rng, gain = np.random.default_rng(1), np.array([1.02, 0.985, 1.01])
    clean = seen_by_an_instrument(gain, np.zeros(3), POINTS_M)
    runs = [outside_scale(stage(), POINTS_M, clean + rng.normal(scale=5e-9, size=clean.shape)) for _ in range(100)]
    errors = np.array([(run.sense_gain - gain) / run.standard_error for run in runs])
    assert 0.7 < np.mean(errors**2) < 1.6  # t of 12 degrees has variance 1.2
    stroke_m = 5e-9 * np.sqrt((stage().jacobian(POINTS_M) ** 2).sum(axis=2).mean())  # of that noise
    assert np.mean([run.residual_m for run in runs]) == pytest.approx(stroke_m * np.sqrt(12 / 18), rel=0.05)


def test_points_that_do_not_tell_are_refused():
    with pytest.raises(ConfigError, match="at least 3"):
        outside_scale(stage(), POINTS_M[:2], POINTS_M[:2])
    with pytest.raises(ConfigError, match="spread them"):
        outside_scale(stage(), np.repeat(POINTS_M[:1], 4, axis=0), np.repeat(POINTS_M[:1], 4, axis=0))


def test_a_reference_that_cannot_be_read_names_line_and_column(tmp_path):
    head = "commanded_x_um, commanded_y_um, commanded_z_um, seen_x_um, seen_y_um, seen_z_um\n"
    for text, words in (
        (head.replace("seen_z_um", "z"), "no column 'seen_z_um'"),
        (head + "0, 0, 1, 0, 0, 1\n0, 0, 1, 0, nan, 1\n", "line 3: seen_y_um: 'nan' is no number"),
        (head + "0, 0, 1, 0, 0\n", "line 2: seen_z_um"),
    ):
        (tmp_path / "reference.csv").write_text(text)
        with pytest.raises(ConfigError, match=words):
            read_points(tmp_path / "reference.csv")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_points(tmp_path / "none.csv")


# -- the command ----------------------------------------------------------------------------------------------------


def test_the_command_prints_and_writes_what_was_found(tmp_path):
    done = CliRunner().invoke(app, ["identify", "--plant", "harsh", "--json", "--out", str(tmp_path / "new")])
    assert done.exit_code == 0, done.output
    data = json.loads(done.stdout)
    expected = as_json(found())
    assert {k: v for k, v in data.items() if k in expected} == json.loads(json.dumps(expected))
    names = {p.name for p in (tmp_path / "new").iterdir()}
    assert {"identification.json", "response.csv", "response.png"} <= names
    assert json.loads((tmp_path / "new" / "identification.json").read_text()) == data
    table = (tmp_path / "new" / "response.csv").read_text().splitlines()
    assert len(table) == 1 + 9 * len(found().response.frequency_hz)


def test_no_frames_no_lockstep():
    done = CliRunner().invoke(app, ["identify", "--bus", "local_20k", "--lane", "lockstep"])
    assert isinstance(done.exception, ConfigError)
    assert "--lane fast" in str(done.exception)


def test_another_seed_is_another_digest():
    again = dataclasses.replace(found(), setup=dataclasses.replace(found().setup, seed=2))
    assert as_json(again)["digest"] != as_json(found())["digest"]


# -- the page -------------------------------------------------------------------------------------------------------

PAGE = Path(__file__).parents[3] / "docs" / "understand" / "identification.md"


def row_of(start, column):
    """The numbers in a cell of the page's table row that begins so; the first column is 0."""
    line = next(line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith(f"| {start} |"))
    return [float(n) for n in re.findall(r"\d+\.?\d*", line.split("|")[column + 1].partition(":")[0])]


def test_the_page_tells_what_is_found():
    modes, is_ = found().modes, truth()
    for start, true, measured, digits in (
        ("resonances (Hz)", is_.frequency_hz, modes.frequency_hz, 2),
        ("damping ratios", is_.damping, modes.damping, 4),
        (
            "static gain of each chain (counts/V^2)",
            is_.static_gain[CHAINS, CHAINS],
            modes.static_gain[CHAINS, CHAINS],
            4,
        ),
    ):
        assert row_of(start, 1) == pytest.approx(true, rel=2e-4), start
        assert row_of(start, 2) == [round(float(v), digits) for v in measured], start


def test_the_page_tells_what_it_is_worth(tmp_path):
    """What moves of the error on the harsh plant under lqg, with the stage file as shipped and with the one found."""
    write_calibrated_stage(find("stages", "reconstructed"), found(), "test", tmp_path / "stage.toml")
    told = []
    for file in ("reconstructed", str(tmp_path / "stage.toml")):
        scenario = hil.load_scenario("raster_harsh", stage=file, controller="lqg")
        run = hil.run(scenario)
        tick = run["reference_tick"]
        (scan_us,) = [s.scan_us for s in scenario.trajectory.segments if s.scan_us]
        scan = (tick >= 0) & (tick * 200 >= scan_us[0]) & (tick * 200 < scan_us[1])
        error_nm = [(run[f"position_{a}_m"] - run[f"reference_{a}_m"])[scan] * 1e9 for a in "xyz"]
        told.append(" / ".join(f"{np.std(e):.1f}" for e in error_nm))
    assert f"the moving part of the raster's error falls from {told[0]} nm to {told[1]} nm" in PAGE.read_text(
        encoding="utf-8"
    )

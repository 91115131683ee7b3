"""From strokes to counts: scale, errors, filter, delay, converters."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sim_rig import FARAD_PER_COUNT, GRADIENT_F_PER_M, REST_F, ZERO_F, config, counts, plant, settle


def shown_m(p):
    """Strokes as an ideal reader of the counts sees them."""
    scale_f, zero_f = p.params["count_f"][0], p.params["count_zero_f"][0]
    return (np.array(p.sample()) * scale_f + (zero_f - REST_F)) / GRADIENT_F_PER_M


@settings(max_examples=40)
@given(st.tuples(*[st.floats(-10e-6, 10e-6)] * 2, st.floats(-2e-6, 30e-6)))
def test_counts_show_the_strokes_to_half_a_count(x):
    p = plant(config())
    p.state["motion"][0, :3] = x
    half = 0.5 * FARAD_PER_COUNT / GRADIENT_F_PER_M
    assert np.abs(shown_m(p) - p.stroke_m).max() <= half * (1 + 1e-6)


@pytest.mark.parametrize(("offset_f", "count"), [(1.0, 32767), (-1.0, -32768)])
def test_counts_saturate_at_sixteen_bits(offset_f, count):
    p = plant(config(sense_offset={"offset_f": (offset_f, 0.0, offset_f * 1e20)}))
    a, b, c = p.sample()
    assert (a, c) == (count, count)
    assert -32768 < b < 32767


def test_gain_offset_curvature_feedthrough():
    p = plant(
        config(
            sense_gain={"relative": (1e-2, -1e-2, 0.0), "curvature_per_25um": 0.02},
            sense_offset={"offset_f": (1e-14, 0.0, -1e-14)},
            feedthrough={"f_per_v": 1e-17},
        )
    )
    p.drive(counts(120, 110, 100))
    settle(p, 100_000)
    q = p.stroke_m
    gain = GRADIENT_F_PER_M * np.array([1.01, 0.99, 1.0])
    farad = REST_F + gain * (q + 0.5 * 0.02 / 25e-6 * q * q) + np.array([1e-14, 0, -1e-14]) + 1e-17 * p.voltage_v
    assert np.array(p.sample()) * FARAD_PER_COUNT + ZERO_F == pytest.approx(farad, abs=0.51 * FARAD_PER_COUNT)


def test_a_coarser_converter_has_coarser_steps():
    p = plant(config(sense_adc={"step_counts": 16}, sense_noise={"density_f_per_rt_hz": 5e-17}))
    seen = {c for _ in range(200) for c in p.sample()}
    assert len(seen) > 3
    assert all(c % 16 == 0 for c in seen)


def swing(**effects):
    """A bare stage let go from (30, -20, 50) nm, with these effects of the sense chain, and the same without."""
    p, ideal = (plant(config(**e), fine=True) for e in (effects, {}))
    for each in (p, ideal):
        each.state["motion"][0, :3] = [30e-9, -20e-9, 50e-9]
        each.state["knot_count"] = 0
        settle(each, 200)  # first step fills the memory of filter and delay
    return p, ideal


@pytest.mark.parametrize("delay_us", [1, 37, 150, 500, 1000])
def test_delay_shows_the_past(delay_us):
    p, ideal = swing(sense_delay={"delay_s": delay_us * 1e-6})
    past = {}
    for t in range(201, 4001):
        ideal.advance_to(t)
        past[t] = ideal.stroke_m
    error = []
    for t in range(400, 4001, 200):
        p.advance_to(t)
        if t - delay_us > 400:
            error.append(shown_m(p) - past[t - delay_us])
    assert len(error) > 10
    assert np.abs(error).max() < 0.2e-9  # cubic between samples 200 us apart, (w h)^4 / 384 of a 70 nm swing


def test_filter_follows_its_differential_equation():
    """f' = (q - f) / tau by 1 us steps of the ideal stroke, against the plant's closed form in steps of 200 us."""
    tau = 1 / (2 * math.pi * 10e3)
    p, ideal = swing(sense_bandwidth={"corner_hz": 10e3})
    f = p.state["filtered_m"][0].copy()
    before = ideal.stroke_m
    kept = math.exp(-1e-6 / tau)
    for t in range(201, 3001):
        ideal.advance_to(t)
        now = ideal.stroke_m
        slope = (now - before) / 1e-6
        f = now - slope * tau + (f - before + slope * tau) * kept  # exact for a straight piece
        before = now
        if t % 200 == 0:
            p.advance_to(t)
            assert np.abs(shown_m(p) - f).max() < 0.02e-9
            assert np.abs(now - f).max() > 0.5e-9 or t < 400  # and the filter does something

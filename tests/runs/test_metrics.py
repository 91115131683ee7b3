"""Figures of a run against the same figures from whole arrays, and the verdicts on them."""

from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_rows import START_TICKS, default_scenario, tracking_rows

from hil.runs.metrics import METRICS, Metrics, evaluate
from pkxyz_ctrl.config.bound import Bound
from pkxyz_ctrl.safety.modes import Mode

PERIOD_US = 200


def figures_of(rows, cuts=()):
    metrics = Metrics(default_scenario().trajectory, PERIOD_US)
    for block in np.split(rows, sorted(cuts)):
        metrics.update(block)
    return asdict(metrics.figures())


def rows_in(rows, key):
    """Index arrays of the windows ``key`` of the segments, straight from the definition of a window."""
    windows = [getattr(s, key) for s in default_scenario().trajectory.segments]
    t_us = rows["t_us"] - START_TICKS * PERIOD_US
    return [np.flatnonzero((t_us >= w[0]) & (t_us < w[1])) for w in windows if w]


@settings(max_examples=25)
@given(st.integers(0, 99), st.lists(st.integers(0, 5500), max_size=20))
def test_figures_equal_those_of_whole_arrays_in_any_blocks(seed, cuts):
    rows = tracking_rows(seed, error_m=2e-9)
    figures = figures_of(rows, cuts)
    (scan,) = rows_in(rows, "scan_us")
    error = (rows["position_m"] - rows["reference_m"])[scan] * 1e9
    assert list(figures["rms_error_nm"].values()) == pytest.approx(np.sqrt((error**2).mean(axis=0)), rel=1e-12)
    assert list(figures["max_error_nm"].values()) == pytest.approx(np.abs(error).max(axis=0), rel=1e-12)
    assert list(figures["error_deviation_nm"].values()) == pytest.approx(error.std(axis=0), rel=1e-9)
    doubt = (rows["estimate_m"] - rows["position_m"])[scan] * 1e9
    assert list(figures["estimate_error_nm"].values()) == pytest.approx(np.sqrt((doubt**2).mean(axis=0)), rel=1e-12)
    holds = [rows["position_m"][at] * 1e9 for at in rows_in(rows, "still_us")]
    assert len(holds) == 2
    off = np.concatenate([(rows["position_m"] - rows["reference_m"])[at] * 1e9 for at in rows_in(rows, "still_us")])
    assert list(figures["hold_rms_nm"].values()) == pytest.approx(np.sqrt((off**2).mean(axis=0)), rel=1e-9)
    weights = [len(hold) - 1 for hold in holds]
    variance = np.average([hold.var(axis=0, ddof=1) for hold in holds], axis=0, weights=weights)
    assert list(figures["hold_noise_nm"].values()) == pytest.approx(np.sqrt(variance), rel=1e-6)
    assert figures["ticks"] == len(rows)


def test_errors_outside_the_scan_and_before_tracking_do_not_count():
    rows = tracking_rows()
    before = figures_of(rows)
    outside = np.setdiff1d(np.arange(len(rows)), np.concatenate(rows_in(rows, "scan_us") + rows_in(rows, "still_us")))
    rows["position_m"][outside] += 1e-6
    assert figures_of(rows) == before
    (scan,) = rows_in(rows, "scan_us")
    rows["position_m"][scan[0], 1] += 1e-6
    rows["position_m"][scan[-1], 2] -= 1e-6
    after = figures_of(rows)
    assert after["max_error_nm"]["x"] == before["max_error_nm"]["x"]
    assert after["max_error_nm"]["y"] == pytest.approx(1000, rel=0.01)
    assert after["max_error_nm"]["z"] == pytest.approx(1000, rel=0.01)


def test_a_constant_offset_in_a_hold_is_no_noise_and_a_faulty_stage_is_not_scored():
    rows = tracking_rows()
    before, about = figures_of(rows)["hold_noise_nm"], figures_of(rows)["hold_rms_nm"]
    first, second = rows_in(rows, "still_us")
    rows["position_m"][first] += 5e-9
    rows["position_m"][second] -= 7e-9
    assert list(figures_of(rows)["hold_noise_nm"].values()) == pytest.approx(list(before.values()), rel=1e-6)
    share = [len(at) / (len(first) + len(second)) for at in (first, second)]
    offset_nm = np.sqrt(share[0] * 5.0**2 + share[1] * 7.0**2)
    seen = list(figures_of(rows)["hold_rms_nm"].values())
    assert seen == pytest.approx(
        [np.hypot(offset_nm, each) for each in about.values()], rel=0.03
    )  # but about the set-point
    rows["mode"] = Mode.FAULT
    assert {key: value for key, value in figures_of(rows).items() if key.endswith("_nm")} == dict.fromkeys(
        ["rms_error_nm", "max_error_nm", "error_deviation_nm", "hold_rms_nm", "hold_noise_nm", "estimate_error_nm"]
    )
    with pytest.raises(TypeError, match="block of rows"):
        figures_of(np.zeros(3))


def test_saturated_ticks_are_ticks_not_combs():
    rows = tracking_rows()
    rows["saturated"][[3, 400, 5000]] = 1
    assert figures_of(rows, [400, 401])["saturated_ticks"] == 3


THREE = {"x": 1.0, "y": 3.0, "z": 2.0}


@pytest.mark.parametrize(
    ("measured", "bound", "value", "ok"),
    [
        (THREE, Bound(max=3.0), 3.0, True),
        (THREE, Bound(max=2.999), 3.0, False),
        (THREE, Bound(min=1.0), 1.0, True),
        (THREE, Bound(min=1.001), 1.0, False),
        (THREE, Bound(min=0.5, max=3.5), 3.0, True),
        (THREE, Bound(min=1.5, max=3.5), 1.0, False),
        (THREE, Bound(min=1.5, max=2.5), 1.0, False),
        (0, Bound(max=0.0), 0.0, True),
        (1, Bound(max=0.0), 1.0, False),
        ([], Bound(max=0.0), 0.0, True),
        (["a fault", "another"], Bound(max=0.0), 2.0, False),
        (None, Bound(max=5.0), None, False),
    ],
)
def test_verdicts(measured, bound, value, ok):
    (verdict,) = evaluate({"rms_error_nm": bound}, {"rms_error_nm": measured})
    limits = {k: v for k, v in (("min", bound.min), ("max", bound.max)) if v is not None}
    assert verdict.as_json() == {"name": "rms_error_nm", "value": value, **limits, "ok": ok}


def test_bus_load_is_not_judged_where_there_is_no_bus():
    assert evaluate({"bus_load": Bound(max=0.85)}, {"bus_load": None})[0].ok is None
    assert evaluate({"bus_load": Bound(max=0.85)}, {"bus_load": 0.9})[0].ok is False


def test_every_figure_can_be_bounded_and_everything_that_can_be_bounded_is_described():
    assert set(figures_of(tracking_rows())) <= set(METRICS)
    assert all((words and words[0].islower()) or words.startswith("RMS") for words in METRICS.values())

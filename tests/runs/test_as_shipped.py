"""What the default law makes of its first scan on a stage that nobody has identified, over many seeds.

``pkxyz bench`` says it of one seed; noise, and what is learnt from it, differ.
"""

from functools import cache

import numpy as np
import pytest
from scan_rig import over_seeds, rms_m, scan_errors

SEEDS = range(1, 11)


@cache
def first_scans(scenario, seeds=SEEDS, **what):
    """Errors (n, 3) of one scan each, m."""
    return [scan_errors(scenario, seed, **what)[0][0] for seed in seeds]


@pytest.mark.parametrize(
    ("scenario", "rms_nm", "asked_nm", "within"),
    [
        ("raster", (1.03, 0.98, 0.93), 1.1, 9),
        ("raster_mild", (2.63, 2.92, 2.51), 3.2, 10),
        ("raster_harsh", (20.2, 22.9, 12.6), None, 0),
    ],
)
def test_a_raster_about_the_set_point(scenario, rms_nm, asked_nm, within):
    """Within what is asked for in every axis of every seed, but for 0.03 nm in one on nominal. Harsh has no bound: its
    mean is the sense chain's and the tilt's.
    """
    each_nm = 1e9 * np.array([rms_m(error_m) for error_m in first_scans(scenario)])
    assert over_seeds(each_nm * 1e-9) == pytest.approx(rms_nm, rel=0.02)
    if asked_nm is not None:
        assert over_seeds(each_nm * 1e-9).max() <= asked_nm
        assert np.count_nonzero((each_nm <= asked_nm).all(axis=1)) == within
        assert each_nm.max() < asked_nm + 0.04


@pytest.mark.parametrize(
    ("scenario", "deviation_nm", "largest_nm", "asked_nm"),
    [("raster_mild", (1.07, 1.04, 0.96), 1.22, 1.3), ("raster_harsh", (3.13, 2.90, 2.07), 3.54, 4.5)],
)
def test_a_raster_about_its_own_mean(scenario, deviation_nm, largest_nm, asked_nm):
    """Of every seed, in every axis."""
    deviation_m = np.array([error_m.std(axis=0) for error_m in first_scans(scenario)])
    assert over_seeds(deviation_m) == pytest.approx(deviation_nm, rel=0.02)
    assert 1e9 * deviation_m.max() == pytest.approx(largest_nm, rel=0.02)
    assert 1e9 * deviation_m.max() <= asked_nm


@pytest.mark.parametrize(
    ("plant", "median_nm", "largest_nm", "asked_nm"),
    [("nominal", (1.40, 1.39), (1.99, 1.78), 1.5), ("mild", (3.77, 3.66), (4.37, 3.83), 8.0)],
)
def test_a_circle(plant, median_nm, largest_nm, asked_nm):
    """In the middle of the seeds within what is asked for; on mild in every one."""
    each_nm = 1e9 * np.array([rms_m(error_m)[:2] for error_m in first_scans("circle", plant=plant)])
    assert np.median(each_nm, axis=0) == pytest.approx(median_nm, abs=0.03)
    assert each_nm.max(axis=0) == pytest.approx(largest_nm, abs=0.03)
    assert np.median(each_nm, axis=0).max() <= asked_nm
    assert plant == "nominal" or each_nm.max() <= asked_nm

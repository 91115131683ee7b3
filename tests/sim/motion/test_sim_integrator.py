"""The plant's integration against scipy's DOP853 at rtol 1e-12, started anew at each change of the drive."""

import numpy as np
import pytest
from sim_rig import config, counts, plant

from hil.bench.rigs.reference_motion import reference_motion

PM = 1e-12


def scan(n: int, period_us: int) -> np.ndarray:
    """Counts (n, 3) of a scan of some micrometres about mid-workspace, reached by a 20 ms ramp of the force."""
    t = np.arange(n) * period_us * 1e-6
    ramp = np.clip(t / 20e-3, 0, 1)
    ramp = np.sqrt(ramp * ramp * (3 - 2 * ramp))
    volts = [
        ramp * (130 + 6 * np.sin(2 * np.pi * 45 * t + k) + 2 * np.sin(2 * np.pi * 180 * t + 2 * k)) for k in (0, 2, 4)
    ]
    return np.array([counts(*row) for row in np.transpose(volts)])


@pytest.mark.parametrize("period_us", [200, 500])
def test_within_a_picometre_over_a_scan(period_us):
    """At most 0.08 pm in periods of 200 us, 0.05 pm in those of 500."""
    p = plant(config(amplifier_bandwidth={"corner_hz": 30e3}), period_us=period_us)
    drives = scan(100_000 // period_us, period_us)
    truth = reference_motion(p.params, p.state, drives, period_us)
    ours = []
    for k, row in enumerate(drives):
        p.drive(row)
        p.advance_to((k + 1) * period_us)
        ours.append(p.position_m)
    error = np.abs(np.array(ours) - truth)
    assert np.ptp(truth, axis=0).min() > 1e-6
    assert error[-1].max() < 0.2 * PM
    assert error.max() < 0.1 * PM


def test_a_jump_costs_less_than_a_nanometre():
    """0 to 130 V at once: how the Jacobian turns while the transient lasts is what the method leaves to its steps."""
    p = plant(config(amplifier_bandwidth={"corner_hz": 30e3}))
    drives = np.repeat([counts(130, 120, 110)], 20, axis=0)
    truth = reference_motion(p.params, p.state, drives, 200)
    ours = []
    for k, row in enumerate(drives):
        p.drive(row)
        p.advance_to((k + 1) * 200)
        ours.append(p.position_m)
    assert np.abs(truth).max() > 15e-6
    assert np.abs(np.array(ours) - truth).max() < 1e-9


def test_cutting_a_period_changes_nothing_but_rounding():
    whole, cut = (plant(config(amplifier_bandwidth={"corner_hz": 30e3}, slew={"limit_v_per_s": 5e6})) for _ in range(2))
    for k, row in enumerate(scan(250, 200)):
        for p in (whole, cut):
            p.drive(row)
        cut.advance_to(k * 200 + 7 + k % 150)
        for p in (whole, cut):
            p.advance_to((k + 1) * 200)
        np.testing.assert_allclose(cut.voltage_v, whole.voltage_v, atol=1e-9)
        np.testing.assert_allclose(cut.position_m, whole.position_m, atol=0.5 * PM)


def test_slewing_against_small_steps():
    """Ramps end within a step and are split there: one step of 200 us equals two hundred of 1 us to 10 pm."""
    coarse, fine = (
        plant(config(amplifier_bandwidth={"corner_hz": 30e3}, slew={"limit_v_per_s": 1e6})) for _ in range(2)
    )
    for k in range(40):
        row = counts(100 + 50 * (k % 2), 90 + 40 * (k % 3), 100)
        coarse.drive(row)
        fine.drive(row)
        coarse.advance_to((k + 1) * 200)
        for t in range(1, 201):
            fine.advance_to(k * 200 + t)
    np.testing.assert_allclose(coarse.voltage_v, fine.voltage_v, atol=1e-7)
    np.testing.assert_allclose(coarse.position_m, fine.position_m, atol=10 * PM)


def test_time_does_not_go_back():
    p = plant(config())
    p.advance_to(200)
    with pytest.raises(ValueError, match="cannot go back"):
        p.advance_to(199)
    p.advance_to(200)
    assert p.t_us == 200

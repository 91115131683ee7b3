"""From counts to volts: converter, bandwidth, slew, current limit, charging."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sim_rig import VOLT_PER_COUNT, config, counts, plant, settle


@settings(max_examples=40)
@given(st.tuples(*[st.integers(-32768, 32767)] * 3))
def test_counts_are_linear_volts(c):
    p = plant(config())
    p.drive(c)
    p.advance_to(1)
    np.testing.assert_allclose(p.voltage_v, np.array(c) * VOLT_PER_COUNT, rtol=1e-15, atol=0)


def test_gain_offset_and_coarse_converter():
    p = plant(
        config(
            amplifier_gain={"relative": (0.01, 0.0, -0.01)},
            amplifier_offset={"offset_v": (0.1, -0.2, 0.0)},
            dac={"step_counts": 4},
        )
    )
    assert p.voltage_v == pytest.approx([0.1, -0.2, 0.0])  # zero counts: the offset alone
    p.drive((1001, 1002, 1003))
    p.advance_to(1)
    steps = np.array([1000, 1004, 1004])
    expected = steps * VOLT_PER_COUNT * np.array([1.01, 1.0, 0.99]) + np.array([0.1, -0.2, 0.0])
    assert p.voltage_v == pytest.approx(expected, rel=1e-14)


@settings(max_examples=30)
@given(st.floats(1e3, 100e3), st.integers(1, 300))
def test_bandwidth_is_one_pole(corner_hz, t_us):
    p = plant(config(amplifier_bandwidth={"corner_hz": corner_hz}))
    p.drive(counts(100, 50, 0))
    p.advance_to(t_us)
    risen = 1 - math.exp(-2 * math.pi * corner_hz * t_us * 1e-6)
    assert p.voltage_v == pytest.approx(counts(100, 50, 0) * VOLT_PER_COUNT * risen, rel=1e-12)


def test_slew_ramps_then_settles_as_one_pole():
    """Ramp at S until the gap is S tau, then exp(-t / tau): 100 V at 2 V/us with tau = 5.3 us ramps for 44.7 us."""
    p = plant(config(amplifier_bandwidth={"corner_hz": 30e3}, slew={"limit_v_per_s": 2e6}))
    p.drive(counts(100, -100, 1))
    tau = 1 / (2 * math.pi * 30e3)
    target = counts(100, -100, 1) * VOLT_PER_COUNT
    ramp_s = (target[0] - 2e6 * tau) / 2e6
    for t_us in range(1, 100):
        p.advance_to(t_us)
        t = t_us * 1e-6
        expected = 2e6 * t if t < ramp_s else target[0] - 2e6 * tau * math.exp(-(t - ramp_s) / tau)
        assert p.voltage_v[0] == pytest.approx(expected, rel=1e-9)
        assert p.voltage_v[1] == pytest.approx(-expected, rel=1e-9)
        assert p.voltage_v[2] == pytest.approx(target[2] * (1 - math.exp(-t / tau)), rel=1e-9)  # never slews


def test_current_limit_charges_comb_and_wire():
    """dV/dt = I / (C + stray): 0.1 mA into 2.55 pF of comb and 20 pF of wire is 4.4 V/us; engaged it is slower."""
    rest_f = 2 * 360 * 8.8541878128e-12 * 100e-6 / 5e-6 * 20e-6
    p = plant(config(current_limit={"limit_a": 1e-4, "stray_f": 20e-12}))
    p.drive(counts(200, 200, 200))
    p.advance_to(10)
    assert p.voltage_v == pytest.approx(np.full(3, 1e-4 / (rest_f + 20e-12) * 10e-6), rel=1e-4)
    settle(p, 60_000)
    q = p.stroke_m[0]
    assert q > 20e-6
    p.drive(counts(0, 0, 0))
    before = p.voltage_v[0]
    p.advance_to(p.t_us + 10)
    assert before - p.voltage_v[0] == pytest.approx(1e-4 / (rest_f * (1 + q / 20e-6) + 20e-12) * 10e-6, rel=1e-3)


def test_force_loses_the_sign_of_the_voltage():
    plus, minus = plant(config()), plant(config())
    plus.drive(counts(80, 70, 60))
    minus.drive(-counts(80, 70, 60))
    for p in (plus, minus):
        settle(p, 20_000)
    assert (plus.position_m == minus.position_m).all()
    assert (plus.stroke_m > 0).all()


def test_charging_opposes_and_creeps():
    """The opposing voltage tends to its share exponentially; driven to 0 V, a comb pulls with what is left."""
    p = plant(config(charging={"fraction": 0.1, "time_constant_s": 0.05}))
    p.drive(counts(100, 0, 0))
    settle(p, 50_000)
    assert p.state["charge_v"][0] == pytest.approx(
        [counts(100)[0] * VOLT_PER_COUNT * 0.1 * (1 - math.exp(-1)), 0, 0], rel=1e-9
    )
    slow, plain = plant(config(charging={"fraction": 0.1, "time_constant_s": 1.0})), plant(config())
    slow.drive(counts(100, 0, 0))
    settle(slow, 8_000_000, 1000)
    slow.drive(counts(0, 0, 0))
    settle(slow, 300_000)
    assert slow.voltage_v[0] == 0
    left_v = slow.state["charge_v"][0, 0]
    assert left_v == pytest.approx(10 * math.exp(-0.3), rel=1e-3)
    plain.drive(counts(left_v, 0, 0))
    settle(plain, 300_000)
    assert slow.stroke_m[0] == pytest.approx(
        plain.stroke_m[0], rel=2e-2
    )  # it trails by the time constant of the damping

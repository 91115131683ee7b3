"""Stops, pull-in, breakage: the stage never passes a wall, and never shows a NaN."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sim_rig import CONFIGS, DEVICE, config, counts, plant, settle

from sim.config import PlantConfig
from sim.plant import Event


def test_a_released_stage_bounces_between_the_stops():
    """Held high, let go: it meets the lower stop and goes no deeper than its speed allows, v sqrt(m / k)."""
    p = plant(config(stops={}))
    for k in range(1, 101):
        p.drive(counts(*[18 * k**0.5] * 3))
        settle(p, 1000)
    settle(p, 50_000)
    assert p.events == ()
    high = p.stroke_m.max()
    assert high > 20e-6
    p.drive((0, 0, 0))
    lowest = 0.0
    for _ in range(2000):
        p.advance_to(p.t_us + 10)
        lowest = min(lowest, p.stroke_m.min())
    assert -2e-6 - 1.7e-6 < lowest < -2.0e-6
    assert {e.kind for e in p.events} == {"stop"}
    assert {e.chain for e in p.events} == {1, 2, 3}
    assert all(a.t_us <= b.t_us for a, b in zip(p.events, p.events[1:], strict=False))
    settle(p, 200_000)
    assert np.abs(p.position_m).max() < 1e-13


def test_stops_hold_against_full_force():
    """One comb at 200 V wants to go beyond 27 um; the wall carries the rest, k times the depth."""
    p = plant(config(stops={}))
    p.drive(counts(200, 200, 200))
    settle(p)
    depth = p.stroke_m - 27e-6
    assert (depth > 0).all()
    assert depth.max() < 0.1e-6


def test_stops_steps_agree_with_fine_ones():
    """Contact is integrated in steps of 2.5 us; over several bounces that parts from 1 us steps by tens of nm."""
    coarse, fine = plant(config(stops={})), plant(config(stops={}))
    for p in (coarse, fine):
        p.state["motion"][0, :3] = [0.0, 0.0, 25e-6]
    for k in range(40):
        coarse.advance_to(200 * (k + 1))
        for t in range(1, 201):
            fine.advance_to(200 * k + t)
        assert np.abs(coarse.position_m - fine.position_m).max() < 50e-9
    assert len(fine.events) >= 3
    assert [e.kind for e in coarse.events] == [e.kind for e in fine.events]


def test_side_pull_in_shorts_the_comb_and_holds_the_slider():
    p = plant(config(stops={}, pull_in={"lateral_stiffness_ratio": 0.01}))
    p.drive(counts(180, 60, 60))
    settle(p, 20_000)
    snaps = [e for e in p.events if e.kind == "pulled_in"]
    assert [e.chain for e in snaps] == [1]
    where = p.state["held_m"][0, 0]
    assert p.voltage_v[0] == 0
    settle(p)
    assert p.stroke_m[0] == pytest.approx(where, abs=0.1e-6)
    p.drive(counts(0, 0, 0))
    settle(p)
    assert p.stroke_m[0] == pytest.approx(where, abs=0.1e-6)  # fingers stick


def test_pull_in_law():
    """It snaps where 2 n eps0 h (y0 + q) V^2 / g^3 passes the lateral stiffness 16 E h t / (l1 + l2), and not below."""
    f, c = DEVICE.flexures, DEVICE.drive_comb
    lateral = 16 * 150e9 * f.leaf_height_m * f.leaf_thickness_m / (f.leaf_inner_length_m + f.leaf_outer_length_m)
    side = 2 * c.finger_count * 8.8541878128e-12 * c.finger_height_m / c.finger_gap_m**3
    for ratio, expected in ((0.999, ["pulled_in"] * 3), (1.001, [])):
        share = side * (20e-6 + 0.0) * 150.0**2 / lateral
        p = plant(config(pull_in={"lateral_stiffness_ratio": share * ratio}))
        p.drive(counts(150, 150, 150))
        p.advance_to(1)  # time for the voltage, not for a stroke
        assert [e.kind for e in p.events] == expected


@pytest.mark.parametrize("name", ["nominal", "mild", "harsh", "lab"])
def test_shipped_plants_survive_full_voltage(name):
    """No pull-in, nothing broken at 200 V on any set of combs."""
    p = plant(PlantConfig.load(CONFIGS / "plants" / f"{name}.toml"))
    for pattern in range(8):
        p.drive(counts(*(200.0 * (pattern >> i & 1) for i in range(3))))
        settle(p, 20_000)
    assert {e.kind for e in p.events} <= {"stop"}
    assert np.isfinite(p.position_m).all()


def test_a_blow_breaks_it_once_and_for_all():
    p = plant(config(stops={}))
    p.external_force_n = (0.0, 0.0, 1e6)
    p.advance_to(200)
    assert Event(200, "broken", 0) in p.events
    where = p.position_m
    p.external_force_n = np.zeros(3)
    p.drive(counts(100, 100, 100))
    settle(p, 10_000)
    assert (p.position_m == where).all()
    assert (p.velocity_m_per_s == 0).all()
    assert (p.voltage_v == 0).all()
    assert [e.kind for e in p.events].count("broken") == 1


@settings(max_examples=60)
@given(
    st.sampled_from(["nominal", "mild", "harsh", "lab"]),
    st.lists(
        st.tuples(
            st.tuples(*[st.integers(-32768, 32767)] * 3),
            st.integers(0, 5000),
            st.tuples(*[st.sampled_from([0.0, 1e-6, -1e-3, 1e-2, -1.0, 1e3, 1e12])] * 3),
        ),
        min_size=1,
        max_size=8,
    ),
)
def test_nan_never(name, actions):
    """Whatever is driven, however long, under whatever blows: finite numbers, counts of 16 bits, voltages in range."""
    p = plant(PlantConfig.load(CONFIGS / "plants" / f"{name}.toml"))
    for drive, dt_us, force in actions:
        p.external_force_n = force
        p.drive(drive)
        p.advance_to(p.t_us + dt_us)
        assert np.isfinite(p.position_m).all()
        assert np.isfinite(p.velocity_m_per_s).all()
        assert np.isfinite(p.stroke_m).all()
        assert np.abs(p.voltage_v).max() < 203
        assert all(-32768 <= c <= 32767 for c in p.sample())

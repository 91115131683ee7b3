"""Each effect's switch: sizes behind an open switch change no bit, and a closed one changes what it should."""

import math

import numpy as np
import pytest
from sim_rig import BARE, DEVICE, config, counts, plant, settle
from sim_truth import stiffness_at

from sim.config import PlantConfig

MODES = (
    {
        "frequency_hz": 2600.0, "quality_factor": 50.0, "compliance_share": 0.01,
        "comb_shape": (0.82, -0.41, -0.41), "table_shape": (0.0, 0.5, 0.1),
    },
    {
        "frequency_hz": 4100.0, "quality_factor": 80.0, "compliance_share": 0.005,
        "comb_shape": (0.3, 0.3, 0.3), "table_shape": (0.2, 0.0, -0.4),
    },
)  # fmt: skip

SIZES: dict[str, dict] = {
    "stiffness_mismatch": {"leaf": (0.1, -0.08, 0.06), "crank_hinge": (0.1, 0.05, -0.1), "link_hinge": (0.1, 0.1, 0.1)},
    "mass_error": {"relative": 0.05},
    "damping": {"quality_factor": 7.0},
    "gravity": {"tilt_x_rad": 0.02, "tilt_y_rad": -0.01, "level_is_rest": False},
    "parasitic": {"compliance_share": 0.01},
    "drift": {"force_n": (1e-7, -1e-7, 2e-7), "time_constant_s": 0.01, "walk_n_per_rt_s": 1e-8},
    "brownian": {"temperature_k": 300.0},
    "stops": {"clearance_m": 0.0},
    "comb_mismatch": {"relative": (0.08, -0.1, 0.05)},
    "fringe": {"relative_per_25um": 0.05},
    "levitation": {"ratio": 0.05},
    "pull_in": {"lateral_stiffness_ratio": 1e-3},
    "charging": {"fraction": 0.02, "time_constant_s": 0.01},
    "amplifier_bandwidth": {"corner_hz": 5e3},
    "slew": {"limit_v_per_s": 1e5},
    "current_limit": {"limit_a": 1e-5},
    "amplifier_gain": {"relative": (0.01, -0.01, 0.02)},
    "amplifier_offset": {"offset_v": (0.1, -0.05, 0.08)},
    "dac": {"step_counts": 64},
    "sense_noise": {"density_f_per_rt_hz": 5e-18},
    "sense_bandwidth": {"corner_hz": 10e3},
    "sense_delay": {"delay_s": 20e-6},
    "sense_gain": {"relative": (1e-2, -1e-2, 1e-2), "curvature_per_25um": 0.01},
    "sense_offset": {"offset_f": (3e-14, -2e-14, 1e-14)},
    "sense_drift": {"walk_f_per_rt_s": 1e-14},
    "sense_adc": {"step_counts": 64},
    "feedthrough": {"f_per_v": 1e-17},
    "crosstalk": {"own_f_per_v": 1e-17, "others_f_per_v": -1e-17},
    "sense_flicker": {"density_f_per_rt_hz": 5e-16, "corner_hz": 100.0},
    "amplifier_noise": {"density_v_per_rt_hz": 1e-3, "corner_hz": 100.0},
    "flexible_modes": {"modes": MODES},
    "finger_misalignment": {"offset_m": (5e-7, -3e-7, 4e-7)},
    "table_tilt": {"about_x_rad_per_m": (10.0, 0.0, 0.0), "arm_m": (0.0, 0.0, 1e-3)},
    "base_noise": {"density_m_per_s2_per_rt_hz": (1e-3, 1e-3, 1e-3)},
    "floor_vibration": {"velocity_m_per_s": 1e-3},
    "mains": {"harmonics": ({"order": 1, "acceleration_m_per_s2": 1.0, "voltage_v": 0.1, "sense_f": 1e-15},)},
    "temperature": {"offset_k": 100.0, "sense_gain_per_k": 1e-5},
    "ageing": {"springs": (0.1, 0.0, 0.0), "combs": (0.0, 0.1, 0.0), "time_constant_s": 1e-3},
}
SEEN_BY_NO_COMB = {"table_tilt"}
MOVES_NOTHING = {
    "sense_noise",
    "sense_bandwidth",
    "sense_delay",
    "sense_gain",
    "sense_offset",
    "sense_drift",
    "sense_adc",
    "feedthrough",
    "crosstalk",
    "sense_flicker",
}
TAKES_THE_GENERAL_STEP = {"sense_flicker"}  # ... of what moves nothing


def run(cfg: PlantConfig, *, usual: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) and counts (n, 3) of a lively drive with steps up to 150 V; with the step of the usual length,
    or not ``usual`` with that of any length alone, whose bits a general step without modes has.
    """
    p = plant(cfg)
    p.params["regular_s"] = p.params["regular_s"] if usual else -1.0
    x, c = [], []
    for k in range(60):
        p.drive(counts(90 + 60 * math.sin(0.3 * k), 80 + 50 * math.sin(0.4 * k), 100 - 60 * math.cos(0.2 * k)))
        p.advance_to(200 * (k + 1))
        x.append(p.position_m)
        c.append(p.sample())
    return np.array(x), np.array(c)


def with_effect(name: str, on: bool) -> PlantConfig:
    base = {n: dict(e) for n, e in BARE.items()}
    if name == "damping":
        base["damping"] = {"on": True}
    return PlantConfig.model_validate({"name": "test"} | base | {name: {"on": on} | SIZES[name]})


def test_no_effect_is_forgotten():
    assert set(SIZES) == set(PlantConfig.model_fields) - {"name"}


@pytest.mark.parametrize("name", sorted(SIZES))
def test_a_switch_acts_where_it_should_and_nowhere_else(name):
    x0, c0 = run(config())
    x, c = run(with_effect(name, True))
    assert (c != c0).any() == (name not in SEEN_BY_NO_COMB)
    beside, _ = run(config(), usual=False) if name in TAKES_THE_GENERAL_STEP else (x0, c0)
    assert (x == beside).all() == (name in MOVES_NOTHING)
    if name == "damping":
        return  # off means none, not the stage file's
    x, c = run(with_effect(name, False))
    assert (x == x0).all()
    assert (c == c0).all()


def test_weight_and_tilt():
    """Level: m g / K_zz = 417 nm. If that is the rest pose, a tilt about x pushes along y: m g sin(tilt) / K_xx."""
    sag = plant(config(gravity={"level_is_rest": False})).position_m
    assert sag[2] == pytest.approx(-4.833e-6 * 9.80665 / 113.64, rel=3e-3)
    assert abs(sag[0]) < 1e-15
    tilted = plant(config(gravity={"tilt_x_rad": 0.01})).position_m
    assert tilted[1] == pytest.approx(-4.833e-6 * 9.80665 * math.sin(0.01) / 75.96, rel=3e-3)
    turned = plant(config(gravity={"tilt_y_rad": 0.01})).position_m
    assert turned[0] == pytest.approx(4.833e-6 * 9.80665 * math.sin(0.01) / 75.96, rel=3e-3)
    assert abs(plant(config(gravity={})).position_m).max() < 1e-18


def test_it_starts_at_rest_and_stays_there():
    p = plant(
        config(gravity={"level_is_rest": False, "tilt_x_rad": 0.02}, amplifier_offset={"offset_v": (5.0, -3.0, 2.0)})
    )
    start = p.position_m
    settle(p, 100_000)
    assert np.abs(p.position_m - start).max() < 1e-18


def test_external_force_moves_by_its_compliance():
    p = plant(config())
    p.external_force_n = (1e-6, 0.0, 2e-6)
    settle(p)
    assert p.position_m == pytest.approx([1e-6 / 75.96, 0, 2e-6 / 113.64], rel=2e-3, abs=1e-12)
    p.external_force_n = np.zeros(3)
    settle(p)
    assert np.abs(p.position_m).max() < 1e-18
    with pytest.raises(ValueError, match="three finite numbers"):
        p.external_force_n = (np.nan, 0.0, 0.0)


def test_parasitic_mode_rings_at_its_frequency_and_share():
    """A force step of comb 1: static share of the in-plane compliance at its own slider, 2.6 kHz, decay w / 2Q."""
    share = 0.02
    p = plant(
        config(parasitic={"compliance_share": share, "comb_shape": (1.0, 0.0, 0.0), "table_shape": (0.0, 0.5, 0.0)})
    )
    quiet = plant(config())
    for each in (p, quiet):
        each.drive(counts(100, 0, 0))
    r, table = [], []
    for t in range(2, 40_001, 2):
        p.advance_to(t)
        quiet.advance_to(t)
        r.append(p.stroke_m[0] - quiet.stroke_m[0])
        table.append(p.position_m[1] - quiet.position_m[1])
    r = np.array(r)
    static = (
        share
        * p.params["force_gain_n_per_v2"][0, 0]
        * p.voltage_v[0] ** 2
        / stiffness_at(p.params[0], np.zeros(3))[0, 0]
    )
    assert r[-1] == pytest.approx(static, rel=1e-2)
    np.testing.assert_allclose(table, 0.5 * r, atol=1e-18)
    up = np.flatnonzero((r[1:-1] > r[:-2]) & (r[1:-1] >= r[2:]))[:40] + 1
    assert np.diff(up).mean() * 2e-6 == pytest.approx(1 / 2600, rel=2e-3)
    rate = np.polyfit(up * 2e-6, np.log(r[up] - static), 1)[0]
    assert -rate == pytest.approx(math.pi * 2600 / 50, rel=0.02)


def test_parasitic_mode_is_the_same_at_any_step():
    """Closed-form response: steps of 200 us equal steps of 1 us through slewing and settling, to a picometre."""
    effects = {"parasitic": {"compliance_share": 0.002}, "amplifier_bandwidth": {}, "slew": {"limit_v_per_s": 2e6}}
    coarse, fine = plant(config(**effects)), plant(config(**effects))
    for k in range(50):
        for p in (coarse, fine):
            p.drive(counts(100 + 40 * (k % 2), 90, 80 + 20 * (k % 3)))
        coarse.advance_to(200 * (k + 1))
        for t in range(1, 201):
            fine.advance_to(200 * k + t)
        assert coarse.state["parasitic"][0, 0] == pytest.approx(fine.state["parasitic"][0, 0], abs=1e-12)


def test_fringe_and_levitation_in_balance():
    """Static: extra force of comb 1 by 1 + phi q, and the lifted table by ratio * sum F / K_zz."""
    plain, fringed, lifted = (
        plant(config(**e)) for e in ({}, {"fringe": {"relative_per_25um": 0.1}}, {"levitation": {"ratio": 0.01}})
    )
    for p in (plain, fringed, lifted):
        p.drive(counts(40, 40, 40))
        settle(p)
    z, q = plain.position_m[2], plain.stroke_m[0]
    assert fringed.position_m[2] / z - 1 == pytest.approx(0.1 * q / 25e-6, rel=0.05)
    force = 3 * plain.params["force_gain_n_per_v2"][0, 0] * plain.voltage_v[0] ** 2
    assert lifted.position_m[2] - z == pytest.approx(0.01 * force / 113.64, rel=0.05)


def test_drift_settles_as_an_exponential():
    p = plant(config(drift={"force_n": (1e-6, 0.0, 0.0), "time_constant_s": 0.2}))
    settle(p, 200_000)
    assert p.position_m[0] == pytest.approx(1e-6 / 75.96 * (1 - math.exp(-1)), rel=0.01)
    settle(p, 2_000_000, 1000)
    assert p.position_m[0] == pytest.approx(1e-6 / 75.96, rel=3e-3)


def test_out_of_plane_chains_stiffen_z():
    device = DEVICE.model_copy(update={"flexures": DEVICE.flexures.model_copy(update={"out_of_plane_chains": 3})})
    one, three = (stiffness_at(plant(config(), device=d).params[0], np.zeros(3)) for d in (DEVICE, device))
    assert one[0, 0] == pytest.approx(three[0, 0], rel=1e-14)
    assert three[2, 2] - one[2, 2] == pytest.approx(8 * 6.25e-6 / 500e-6**2, rel=1e-6)  # 12 K3 - 4 K3, over delta_0^2

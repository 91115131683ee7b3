"""The plant lab: everything on, and the page's table of its noises against what formulas say."""

import dataclasses
import json
import re

import numpy as np
import pytest
from loop_rig import MIDDLE, rows_of, setup, stage
from scipy.integrate import quad
from sim_rig import CONFIGS, DEVICE, GRADIENT_F_PER_M, counts, plant
from sim_truth import stiffness_at

from pkxyz_ctrl.trajectory import Hold, Move, Trajectory
from sim.config import Device, PlantConfig

ROOT = CONFIGS.parent
LAB = PlantConfig.load(CONFIGS / "plants" / "lab.toml")
OFF = {"dac", "sense_adc", "parasitic", "sense_delay", "feedthrough", "ageing"}
"""Coarser converters, which harsh has; what flexible_modes, sense_bandwidth and crosstalk stand for here; and age."""


def test_everything_is_on_that_a_real_room_has():
    on = {name for name in PlantConfig.model_fields if name != "name" and getattr(LAB, name).on}
    assert set(PlantConfig.model_fields) - {"name"} - on == OFF


def test_the_stage_file_says_the_lag_of_the_chain_and_is_the_same_device():
    """99.5 us, 1 / (2 pi 1.6 kHz); all else as reconstructed."""
    assert Device.load(CONFIGS / "stages" / "lab.toml") == DEVICE
    text = (CONFIGS / "stages" / "lab.toml").read_text(encoding="utf-8")
    lag_s = float(re.search(r"^delay_s = ([\d.e-]+)", text, re.MULTILINE)[1])
    assert lag_s == pytest.approx(1 / (2 * np.pi * LAB.sense_bandwidth.corner_hz), rel=2e-3)


def test_the_pages_noises_are_those_of_the_formulas():
    """Deviations of a mode (K, m, Q) under white noise, sqrt(k T / K), D sqrt(pi f / 2): within a tenth, of 20 s."""
    kept = json.loads((ROOT / "docs" / "figures" / "plant_noise.json").read_text(encoding="utf-8"))
    shown = {words: [float(v) for v in cells[:3]] for words, cells in kept.items()}
    p = plant(LAB).params[0]
    stiff = np.diag(stiffness_at(p, np.zeros(3)))
    base = np.array(LAB.base_noise.density_m_per_s2_per_rt_hz) * p["mass_kg"] / stiff
    ringing = np.sqrt(np.sqrt(stiff / p["mass_kg"]) * 18.0 / 4)
    assert shown["table above its legs"] == pytest.approx(base * ringing * 1e9, rel=0.1)
    assert shown["thermal force"] == pytest.approx(np.sqrt(1.380649e-23 * 296.0 / stiff) * 1e9, rel=0.1)
    white = LAB.sense_noise.density_f_per_rt_hz * np.sqrt(np.pi / 2 * LAB.sense_bandwidth.corner_hz)
    assert shown["sense chain, white"] == pytest.approx([white / GRADIENT_F_PER_M * 1e9] * 3, rel=0.05)
    names = ("amplifier", "table above its legs", "floor through the legs", "mains, 50 to 300 Hz", "warming package")
    moving = [shown[name] for name in (*names, "thermal force")]
    assert shown["all that moves it"] == pytest.approx(np.sqrt(np.sum(np.square(moving), axis=0)), rel=0.1)


def test_a_good_stage_holds_what_it_is_asked_to():
    """No snap and no stop on the way to mid-workspace and while it is shaken for a tenth of a second."""
    p = plant(LAB)
    for k in range(1500):
        volt = 130.0 * min(1.0, k / 1000) ** 0.5
        p.drive(counts(volt, volt, volt))
        p.advance_to(200 * (k + 1))
    assert p.events == ()
    assert 11e-6 < p.stroke_m.min() < p.stroke_m.max() < 13e-6


def rms_mv(noise, pole_hz, low_hz, high_hz, white=True):
    """Of an amplifier's noise by its density: white and 1/f below the corner, through a pole of first order."""

    def density2(log_hz):
        hz = np.exp(log_hz)
        flicker = noise.corner_hz / hz if noise.lowest_hz <= hz <= noise.corner_hz else 0.0
        return hz * noise.density_v_per_rt_hz**2 * (float(white) + flicker) / (1 + (hz / pole_hz) ** 2)

    corners = np.log([noise.lowest_hz, 20.0, noise.corner_hz, pole_hz])
    ends = np.log([low_hz, high_hz])
    return 1e3 * np.sqrt(quad(density2, *ends, points=corners[(corners > ends[0]) & (corners < ends[1])], limit=200)[0])


def test_the_amplifiers_millivolts_are_the_integral_of_its_density():
    """As the file's words have them, and as the plant draws what of it is 1/f."""
    noise, pole_hz = LAB.amplifier_noise, LAB.amplifier_bandwidth.corner_hz
    assert rms_mv(noise, pole_hz, 1e-3, 1e8) == pytest.approx(1.55, abs=0.005)
    assert noise.density_v_per_rt_hz * np.sqrt(np.pi / 2 * pole_hz) == pytest.approx(1.30e-3, abs=5e-6)
    assert rms_mv(noise, pole_hz, noise.lowest_hz, 20.0, white=False) == pytest.approx(0.65, abs=0.005)
    assert rms_mv(noise, pole_hz, 20.0, noise.corner_hz, white=False) == pytest.approx(0.54, abs=0.005)
    p = plant(LAB)
    flicker_v = p.params["amplifier_flicker_v"][0] * np.sqrt(p.state["amplifier_flicker"][0].shape[1])
    assert 1e3 * flicker_v == pytest.approx(rms_mv(noise, 1e9, 1e-3, 1e4, white=False), rel=1e-3)


def test_20_af_a_volt_of_unshielded_pads_move_z_by_31_nm():
    """Held at mid-workspace by what the combs say, which cannot tell their own drives' 133 V from a stroke."""
    height = stage().forward_kinematics(MIDDLE)
    there = Move(kind="move", to_m=tuple(map(float, height)), velocity_max_m_per_s=1e-3,
                 acceleration_max_m_per_s2=1.0, jerk_max_m_per_s3=1e3)  # fmt: skip
    held = Trajectory([there, Hold(kind="hold", duration_s=0.2)])
    run = dataclasses.replace(setup(), trajectory=held, duration_s=0.4)

    def z_m(own_f_per_v):
        sizes = {"on": True, "own_f_per_v": own_f_per_v, "others_f_per_v": 0.0, "rate_f_per_v_per_s": 0.0}
        with_it = run.plant.model_copy(update={"crosstalk": run.plant.crosstalk.model_copy(update=sizes)})
        rows, result = rows_of(dataclasses.replace(run, plant=with_it), "fast")
        assert not result.faults
        return rows[rows["reference_tick"] >= 500]["position_m"].mean(axis=0)

    moved_nm = (z_m(20e-18) - z_m(0.0)) * 1e9
    assert abs(moved_nm[2]) == pytest.approx(31.0, abs=0.7)
    assert np.abs(moved_nm[:2]).max() < 0.5
    assert abs(z_m(LAB.crosstalk.own_f_per_v) - z_m(0.0))[2] * 1e9 == pytest.approx(0.3, abs=0.15)

"""The plant lab: everything on, and the page's table of its noises against what formulas say."""

import json
import re

import numpy as np
import pytest
from sim_rig import CONFIGS, DEVICE, GRADIENT_F_PER_M, counts, plant

from sim.config import Device, PlantConfig
from sim.parameters import rest_stiffness

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
    stiff = np.diag(rest_stiffness(p, np.zeros(3)))
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

"""Parameters of the surroundings from the plant file, and the random state that they start from."""

import math

import numpy as np

from sim.config.plant_file import PlantConfig
from sim.config.surroundings import Flicker, FloorVibration, Mains
from sim.motion import layout
from sim.motion.layout import FLICKERS
from sim.motion.noise import next_u64, normal
from sim.surroundings.tones import sum_tones

TONES_A_BAND = 3
THIRD_OCTAVE_HZ = 1000.0
"""Bands are centred at this times 2^(n / 3), IEC 61260-1."""
NOMINAL = 1.03
"""Bands are called by round numbers: 1 Hz is 0.977, 80 Hz is 78.7."""


def build_surroundings(p: np.void, config: PlantConfig) -> None:
    """Everything in the sections of ``sim.config.surroundings``; call when the mechanism's parameters stand."""
    p["shaken_on"] = config.base_noise.on
    if config.base_noise.on:
        p["base_m_per_s2_per_rt_hz"] = config.base_noise.density_m_per_s2_per_rt_hz
    for hz, metre, volt, farad in [*_floor(config.floor_vibration), *_mains(config.mains)]:
        k = int(p["tone_count"])
        p["tone_rad_per_s"][k] = 2 * math.pi * hz
        p["tone_m_per_s2"][k], p["tone_v"][k], p["tone_f"][k] = metre, volt, farad
        p["tone_count"] = k + 1
    noise, flicker = config.amplifier_noise, config.sense_flicker
    p["amplifier_noise_on"], p["sense_flicker_on"] = noise.on, flicker.on
    if noise.on:
        p["amplifier_v_per_rt_hz"] = noise.density_v_per_rt_hz
        p["amplifier_flicker_per_s"], size = _relaxations(noise)
        p["amplifier_flicker_v"] = noise.density_v_per_rt_hz * size
    if flicker.on:
        p["sense_flicker_per_s"], size = _relaxations(flicker)
        p["sense_flicker_f"] = flicker.density_f_per_rt_hz * size
    _slow(p, config)


def _relaxations(flicker: Flicker) -> tuple[np.ndarray, float]:
    """Rates (FLICKERS,), 1/s, spread evenly by ratio from the lowest frequency to the corner, and the deviation of each
    for a density of 1.

    One relaxation of deviation s and rate a has the one-sided density 4 s^2 a / (a^2 + w^2); with a ratio R between
    neighbours they add up to s^2 / (f ln R), so s^2 = D^2 corner ln R.
    """
    ratio = (flicker.corner_hz / flicker.lowest_hz) ** (1.0 / FLICKERS)
    hz = flicker.lowest_hz * ratio ** (np.arange(FLICKERS) + 0.5)
    return 2 * math.pi * hz, math.sqrt(flicker.corner_hz * math.log(ratio))


def _floor(floor: FloorVibration) -> list[tuple[float, float, float, float]]:
    """(Hz, m/s^2, V, F) amplitudes of the tones that make the floor's bands, through the table's legs."""
    if not floor.on:
        return []
    tones: list[tuple[float, float, float, float]] = []
    for band in range(-30, -9):  # 1 to 100 Hz
        centre_hz = THIRD_OCTAVE_HZ * 2.0 ** (band / 3)
        if not floor.lowest_hz / NOMINAL <= centre_hz <= floor.highest_hz * NOMINAL:
            continue
        for k in range(TONES_A_BAND):
            golden = (len(tones) * 0.6180339887) % 1.0 - 0.5  # no tone is a multiple of another
            hz = centre_hz * 2.0 ** ((k - 1 + 0.4 * golden) / (3 * TONES_A_BAND))
            rms_m_per_s = floor.velocity_m_per_s / math.sqrt(TONES_A_BAND)
            tones.append((hz, 2 * math.pi * hz * math.sqrt(2) * rms_m_per_s * _transmitted(floor, hz), 0.0, 0.0))
    return tones


def _transmitted(floor: FloorVibration, hz: float) -> float:
    """Motion of the table by that of the floor: a mass on springs and dashpots."""
    if floor.isolator_hz is None:
        return 1.0
    r = hz / floor.isolator_hz
    loss = r / floor.isolator_quality
    return math.sqrt((1 + loss**2) / ((1 - r**2) ** 2 + loss**2))


def _mains(mains: Mains) -> list[tuple[float, float, float, float]]:
    root2 = math.sqrt(2)
    return [
        (h.order * mains.frequency_hz, root2 * h.acceleration_m_per_s2, root2 * h.voltage_v, root2 * h.sense_f)
        for h in (mains.harmonics if mains.on else ())
    ]


def _slow(p: np.void, config: PlantConfig) -> None:
    warm, old = config.temperature, config.ageing
    p["slow_on"] = warm.on or old.on
    if not p["slow_on"]:
        return
    p["warm_k"], p["warming_k"], p["swing_k"] = np.array([warm.offset_k, warm.settling_k, warm.swing_k]) * warm.on
    p["warming_s"], p["swing_rad_per_s"] = warm.settling_s, 2 * math.pi / warm.swing_period_s
    p["stiffness_per_k"], p["comb_per_k"] = warm.stiffness_per_k, warm.comb_gain_per_k
    p["sense_per_k"] = warm.sense_gain_per_k
    p["ageing_from_s"], p["ageing_s"] = old.start_s, old.time_constant_s
    p["ageing_springs"], p["ageing_combs"] = np.array(old.springs) * old.on, np.array(old.combs) * old.on
    for name in ("leaf_n_per_m", "crank_hinge_nm", "link_hinge_nm", "force_gain_n_per_v2", "sense_f_per_m"):
        p[f"drawn_{name}"] = p[name]


def seed_offsets(config: PlantConfig) -> dict[int, int]:
    """Of the surroundings' streams."""
    return {
        layout.BASE_STREAM: config.base_noise.seed_offset,
        layout.AMPLIFIER_STREAM: config.amplifier_noise.seed_offset,
        layout.AMPLIFIER_FLICKER_STREAM: config.amplifier_noise.seed_offset,
        layout.SENSE_FLICKER_STREAM: config.sense_flicker.seed_offset,
        layout.FLOOR_STREAM: config.floor_vibration.seed_offset,
        layout.MAINS_STREAM: config.mains.seed_offset,
    }


def start_surroundings(p: np.void, s: np.void, config: PlantConfig) -> None:
    """Draw where lines, 1/f noise and the filtered noise of the chain stand, when the streams have started."""
    lines, tones = len(_mains(config.mains)), int(p["tone_count"])
    for k in range(tones):
        source = layout.MAINS_STREAM if k >= tones - lines else layout.FLOOR_STREAM
        for j in range(3):
            turn = 2 * math.pi * float(next_u64(s["random"][source])) / 2.0**64
            s["tone_phase"][k, j] = math.cos(turn), math.sin(turn)
    if tones:
        sum_tones(p, s)
    for source, memory, on in (
        (layout.AMPLIFIER_FLICKER_STREAM, s["amplifier_flicker"], p["amplifier_noise_on"]),
        (layout.SENSE_FLICKER_STREAM, s["sense_flicker"], p["sense_flicker_on"]),
    ):
        if on:
            memory[:] = np.reshape(
                [normal(s["random"][source], s["spare"][source]) for _ in range(memory.size)], (3, -1)
            )
    if p["sense_chain_noise_f"] > 0.0:
        for i in range(3):
            n = layout.SENSE_STREAM + i
            s["sense_chain_noise"][i] = normal(s["random"][n], s["spare"][n])

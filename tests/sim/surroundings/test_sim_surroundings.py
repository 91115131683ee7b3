"""The room and the electronics' noise: spectra and sizes against the formulas that they are given by."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize, signal
from sim_rig import DEVICE, GRADIENT_F_PER_M, config, counts, plant, settle
from sim_truth import stiffness_at

from sim.config import PlantConfig
from sim.config.surroundings import FloorVibration
from sim.surroundings.build import build_surroundings

FS_HZ = 5000.0


def recorded(p, n, look, period_us=200):
    """(n, ...) of look(p), taken after each period."""
    out = []
    for _ in range(n):
        p.advance_to(p.t_us + period_us)
        out.append(look(p))
    return np.array(out)


def density(x, hz, share=0.2):
    """One-sided density (..., ) of columns of x (n, k) around each hz, within +-share, in units/rtHz."""
    f, s = signal.welch(x, FS_HZ, nperseg=2048, axis=0)
    return np.array([np.sqrt(s[(f > h * (1 - share)) & (f < h * (1 + share))].mean(axis=0)) for h in hz])


@pytest.mark.parametrize(("corner_hz", "period_us"), [(1600.0, 200), (10e3, 200), (400.0, 500)])
def test_noise_of_a_chain_follows_from_density_bandwidth_and_aliasing(corner_hz, period_us):
    """Deviation D sqrt(pi / 2 f_c) whatever the rate; correlation exp(-w_c T) from sample to sample, so the folded
    spectrum is (1 - a^2) / |1 - a e^-jw|^2. 5 aF/rtHz at 1.6 kHz: 1.97 nm, as per-sample noise has at 5 kHz."""
    noise = {"density_f_per_rt_hz": 5e-18, "sampled": "through_chain"}
    p = plant(config(sense_noise=noise, sense_bandwidth={"corner_hz": corner_hz}), period_us=period_us, fine=True)
    x = recorded(p, 12_000, lambda p: p.sample(), period_us) * 1e-18
    expected = 5e-18 * np.sqrt(np.pi / 2 * corner_hz)
    assert x.std() == pytest.approx(expected, rel=0.03)
    if corner_hz == 1600.0:
        assert expected / GRADIENT_F_PER_M == pytest.approx(1.97e-9, rel=0.01)
    kept = np.exp(-2 * np.pi * corner_hz * period_us * 1e-6)
    next_one = np.mean(x[1:] * x[:-1], axis=0) / np.mean(x**2, axis=0)
    assert next_one == pytest.approx(np.full(3, kept), abs=4 / np.sqrt(len(x)))
    f, s = signal.welch(x, 1e6 / period_us, nperseg=256, axis=0)
    w = 2 * np.pi * f * period_us * 1e-6
    folded = 2 * expected**2 * period_us * 1e-6 * (1 - kept**2) / (1 - 2 * kept * np.cos(w) + kept**2)
    assert (s.mean(axis=1) / folded)[2:-2] == pytest.approx(np.ones(len(f) - 4), abs=0.25)
    assert (s.mean(axis=1) / folded)[2:-2].mean() == pytest.approx(1.0, abs=0.03)


def test_the_chain_lags_by_what_its_bandwidth_costs():
    """Of a slow swing a filter at 1.6 kHz shows what was 99.5 us ago."""
    p = plant(config(sense_bandwidth={"corner_hz": 1600.0}))
    out = []
    for k in range(8000):  # pieces of 50 us, so that the force's steps do not show in the phase
        p.external_force_n = (0.0, 1e-5 * np.sin(2 * np.pi * 20.0 * k * 50e-6), 0.0)
        p.advance_to(50 * (k + 1))
        out.append([p.stroke_m[0], p.state["filtered_m"][0, 0]])
    wave = np.exp(-2j * np.pi * 20.0 * 50e-6 * np.arange(4000)) @ np.array(out)[4000:]
    lag_s = -np.angle(wave[1] / wave[0]) / (2 * np.pi * 20.0)
    assert lag_s == pytest.approx(1 / (2 * np.pi * 1600.0), rel=2e-3)


def test_noise_through_the_chain_needs_one():
    with pytest.raises(ValueError, match="needs sense_bandwidth"):
        PlantConfig.model_validate({"sense_noise": {"sampled": "through_chain"}})


def test_flicker_of_the_sense_chain_falls_as_one_over_f():
    """D sqrt(corner / f) per rtHz from well above the lowest frequency to the corner."""
    flicker = {"density_f_per_rt_hz": 5e-17, "corner_hz": 1000.0, "lowest_hz": 0.1}
    p = plant(config(sense_flicker=flicker), fine=True)
    hz = np.array([10.0, 30.0, 100.0, 300.0])
    found = density(recorded(p, 60_000, lambda p: p.sample()) * 1e-18, hz).mean(axis=1)
    assert found == pytest.approx(5e-17 * np.sqrt(1000.0 / hz), rel=0.12)


def test_ripple_of_the_amplifier_has_the_density_of_its_file():
    """White and 1/f, as laid out over calls of 200 us: the mean of each call is what pushes the stage."""
    noise = {"density_v_per_rt_hz": 6e-6, "corner_hz": 300.0, "lowest_hz": 0.1}
    p = plant(config(amplifier_noise=noise))
    weights = 1 / np.arange(1, 5) * 200e-6 ** np.arange(4)
    mean = recorded(p, 60_000, lambda p: weights @ p.state["ripple_v"][0])
    hz = np.array([10.0, 100.0, 1000.0])
    folded = np.sinc(hz * 200e-6)  # of the mean over a call; white noise folds back what this takes
    expected = 6e-6 * np.sqrt(1 + np.where(hz < 300.0, 300.0 / hz * folded**2, 0.0))
    assert density(mean, hz).mean(axis=1) == pytest.approx(expected, rel=0.08)


@pytest.mark.parametrize("source", ["base_noise", "amplifier_noise"])
def test_the_stage_rings_as_white_noise_lets_it(source):
    """Deviation of a mode (m, K, Q) under a force of one-sided density S: sqrt(S^2 w Q / 4) / K. At 631 Hz, an eighth
    of the rate, noise that were held over a call would lose 5 % of its power."""
    if source == "base_noise":
        p = plant(config(base_noise={"density_m_per_s2_per_rt_hz": (1e-3, 0.0, 0.0)}, damping={"quality_factor": 10.0}))
        newton = 4.833e-6 * 1e-3
    else:
        p = plant(config(amplifier_noise={"density_v_per_rt_hz": 1e-3, "corner_hz": 1e-3, "lowest_hz": 1e-4},
                         damping={"quality_factor": 10.0}))  # fmt: skip
        p.drive(counts(30, 30, 30))
        per_v = 2 * p.params["force_gain_n_per_v2"][0, 0] * 30.0
        newton = per_v * 1e-3 * np.sqrt(2 * 0.75)  # of two combs, on x
    settle(p, 100_000)
    x = recorded(p, 40_000, lambda p: p.position_m[0])
    stiff = stiffness_at(p.params[0], np.zeros(3))[0, 0]
    w = np.sqrt(stiff / 4.833e-6)
    expected = newton / stiff * np.sqrt(w * 10.0 / 4)
    assert (x - x.mean()).std() == pytest.approx(expected, rel=0.08)  # 8 s hold some 1600 correlation times


@given(st.floats(1e-6, 1e-4), st.one_of(st.none(), st.floats(1.0, 5.0)), st.floats(0.5, 10.0))
@settings(max_examples=20)
def test_each_band_of_the_floor_has_its_velocity(velocity, isolator_hz, quality):
    """Sum of the tones of a one-third octave band, back through the table's legs: the rms of the file, 1 to 80 Hz."""
    floor = FloorVibration(on=True, velocity_m_per_s=velocity, isolator_hz=isolator_hz, isolator_quality=quality)
    p = plant(config(floor_vibration=floor.model_dump())).params[0]
    n = int(p["tone_count"])
    hz, acceleration = p["tone_rad_per_s"][:n] / (2 * np.pi), p["tone_m_per_s2"][:n]
    if isolator_hz is not None:
        r = hz / isolator_hz
        acceleration = acceleration / np.abs((1 + 1j * r / quality) / (1 - r**2 + 1j * r / quality))
    band = np.round(3 * np.log2(hz / 1000.0))
    assert sorted(set(band)) == list(range(-30, -10))  # 0.98 to 79 Hz
    for b in set(band):
        tones = acceleration[band == b] / (2 * np.pi * hz[band == b]) / np.sqrt(2)
        assert np.sqrt((tones**2).sum()) == pytest.approx(velocity, rel=1e-9)


def test_tones_do_not_depend_on_how_time_is_cut():
    """A floor is a function of time: periods of 200 us or of jittering ones meet the same base."""
    room = {
        "floor_vibration": {"velocity_m_per_s": 5e-5},
        "mains": {"harmonics": ({"order": 2, "acceleration_m_per_s2": 1e-2},)},
    }
    a, b = plant(config(**room)), plant(config(**room))
    for k in range(200):
        a.advance_to(200 * (k + 1))
        b.advance_to(200 * k + 13 + k % 100)
        b.advance_to(200 * (k + 1))
    assert np.abs(a.position_m).max() > 1e-10
    assert np.abs(a.position_m - b.position_m).max() < 1e-13


def test_mains_show_where_they_are_put():
    """Shaking by the compliance, ripple by the comb's slope, hum in the chain: rms of each at 50 Hz."""
    harmonic = {"order": 1, "acceleration_m_per_s2": 0.02, "voltage_v": 0.0, "sense_f": 3e-16}
    p = plant(config(mains={"harmonics": (harmonic,)}), fine=True)
    settle(p, 100_000)
    both = recorded(p, 1000, lambda p: [*p.position_m, *(np.array(p.sample()) * 1e-18 - GRADIENT_F_PER_M * p.stroke_m)])
    assert both[:, 0].std() == pytest.approx(0.02 * 4.833e-6 / 75.96, rel=0.02)
    assert both[:, 3:].std(axis=0) == pytest.approx(np.full(3, 3e-16), rel=0.02)
    p = plant(config(mains={"harmonics": ({"order": 1, "voltage_v": 0.01},)}))
    p.drive(counts(60, 0, 0))
    settle(p, 200_000)
    y = recorded(p, 1000, lambda p: p.position_m[1])
    per_v = 2 * p.params["force_gain_n_per_v2"][0, 0] * 60.0 / 75.96
    assert (y - y.mean()).std() == pytest.approx(per_v * 0.01, rel=0.03)


def test_warmth_softens_springs_and_changes_gains():
    """+10 K at -60 ppm/K: 600 ppm more stroke for the same force; the sense combs show 100 ppm more of it."""
    cold, warm = plant(config()), plant(config(temperature={"offset_k": 10.0, "sense_gain_per_k": 1e-5}))
    for p in (cold, warm):
        p.drive(counts(50, 50, 50))
        settle(p)
    assert warm.position_m[2] / cold.position_m[2] - 1 == pytest.approx(600e-6, rel=0.1)
    assert warm.params["sense_f_per_m"] / cold.params["sense_f_per_m"] - 1 == pytest.approx(1e-4, rel=1e-6)


def test_temperature_settles_and_swings():
    p = plant(config(temperature={"settling_k": 8.0, "settling_s": 0.1, "swing_k": 2.0, "swing_period_s": 0.4}))
    shown = recorded(p, 2000, lambda p: p.params["leaf_n_per_m"][0, 0])
    kelvin = (shown / plant(config()).params["leaf_n_per_m"][0, 0] - 1) / -60e-6
    t = 200e-6 * np.arange(2000)
    assert kelvin == pytest.approx(8 * (1 - np.exp(-t / 0.1)) + 2 * np.sin(2 * np.pi * t / 0.4), abs=1e-6)


def test_a_spring_and_a_comb_age_from_an_instant_on():
    aged = plant(
        config(ageing={"start_s": 0.05, "time_constant_s": 0.02, "springs": (-0.02, 0, 0), "combs": (0, 0, 0.05)})
    )
    fresh = plant(config())
    for p in (aged, fresh):
        p.drive(counts(60, 60, 60))
        settle(p, 50_000)
    assert (aged.position_m == fresh.position_m).all()
    settle(aged, 500_000)
    ratio = [aged.params[n][0] / fresh.params[n][0] for n in ("leaf_n_per_m", "crank_hinge_nm", "force_gain_n_per_v2")]
    assert ratio[0] == pytest.approx([0.98, 1, 1], abs=1e-9)
    assert ratio[1] == pytest.approx([0.98, 1, 1], abs=1e-9)
    assert ratio[2] == pytest.approx([1, 1, 1.05], abs=1e-9)


def sideways(volt, stroke_m, offset_m, softening_m, ratio):
    """Bending of one comb's fingers, m, None where there is no balance, found on a grid and by bisection: a solution
    from the device's dimensions."""
    f, comb = DEVICE.flexures, DEVICE.drive_comb
    gap, overlap = comb.finger_gap_m, comb.overlap_rest_m + stroke_m
    k = (
        16
        * f.youngs_modulus_pa
        * f.leaf_height_m
        * f.leaf_thickness_m
        / (f.leaf_inner_length_m + f.leaf_outer_length_m)
    )
    k *= ratio / (1 + (stroke_m / softening_m) ** 2)
    half = 0.5 * comb.finger_count * 8.8541878128e-12 * comb.finger_height_m * overlap * volt**2

    def left_over(y):
        d = offset_m + y
        return half * (1 / (gap - d) ** 2 - 1 / (gap + d) ** 2) - k * y

    y = np.linspace(0, (gap - offset_m) * 0.999, 20_001)
    over = np.array([left_over(each) for each in y])
    if (over > 0).all():
        return None
    first = int(np.argmax(over <= 0))
    return optimize.brentq(left_over, y[max(first - 1, 0)], y[first], xtol=1e-18) if first else 0.0


@pytest.mark.parametrize("offset_m", [0.2e-6, 0.8e-6])
def test_fingers_aside_pull_harder_and_snap_earlier(offset_m):
    """Slow rise of one comb's voltage, damped so that nothing rings: bending as an own solution has it, force by
    1 / (1 - (d / g)^2), a snap at the voltage where the own solution finds no balance any more, which is below that of
    centred fingers."""
    ratio, softening = 0.012, 20e-6
    sides = {"pull_in": {"lateral_stiffness_ratio": ratio}, "stops": {}, "damping": {"quality_factor": 2.0}}
    p = plant(config(**sides, finger_misalignment={"offset_m": (offset_m, 0, 0), "softening_stroke_m": softening}))
    centred = plant(config(**sides))
    seen = []
    for volt in np.arange(1.0, 190.0, 1.0):
        for each in (p, centred):
            if not each.events:
                each.drive(counts(volt, 0.3 * volt, 0.3 * volt))
                settle(each, 20_000)
        if not p.events:
            seen.append((p.voltage_v[0], p.stroke_m[0], p.state["aside_m"][0, 0], p.state["comb_rise"][0, 0]))
    assert [e.kind for e in p.events] == ["pulled_in"]
    assert p.events[0].chain == 1
    assert not centred.events or centred.events[0].t_us > p.events[0].t_us
    for volt, stroke, aside, rise in seen[5::8]:
        expected = sideways(volt, stroke, offset_m, softening, ratio)
        assert aside == pytest.approx(expected, rel=1e-6, abs=1e-15)
        assert rise == pytest.approx(1 / (1 - ((offset_m + aside) / 5e-6) ** 2), rel=1e-9)
    volt, stroke = seen[-1][:2]
    assert sideways(volt + 2.0, stroke + 0.6e-6, offset_m, softening, ratio) is None
    assert seen[-1][3] > 1.02


def test_a_tilting_table_moves_its_point_by_the_arm():
    """(theta x arm): 100 rad/m about x by y, 5 um in y and 3 in z: z gains theta 5 um, y loses theta 3 um."""
    p = plant(config(table_tilt={"about_x_rad_per_m": (0, 100.0, 0), "arm_m": (0, 5e-6, 3e-6)}))
    p.external_force_n = (1e-4, 2e-4, 0.0)
    settle(p)
    table = p.state["motion"][0, :3]
    theta = 100.0 * table[1]
    assert p.position_m - table == pytest.approx([0.0, -theta * 3e-6, theta * 5e-6], rel=1e-9, abs=1e-18)
    assert theta * 5e-6 > 1e-9


def test_crosstalk_passes_the_chain():
    """Own, others' and rate part of the voltages through the filter, against the filter's equation in steps of 1 us."""
    corner, rate = 1600.0, 1e-21
    talk = {"own_f_per_v": 2e-18, "others_f_per_v": -3e-19, "rate_f_per_v_per_s": rate}
    effects = {
        "sense_bandwidth": {"corner_hz": corner},
        "amplifier_bandwidth": {"corner_hz": 30e3},
        "slew": {"limit_v_per_s": 1e6},
    }
    p, fine, silent = plant(config(**effects, crosstalk=talk)), plant(config(**effects)), plant(config(**effects))
    tau, shown = 1 / (2 * np.pi * corner), np.zeros((2, 3))
    kept = np.exp(-1e-6 / tau)
    for k in range(30):
        for each in (p, fine, silent):
            each.drive(counts(10 + 60 * (k % 2), 20 + 10 * (k % 3), 15))
        for t in range(1, 201):
            before = fine.voltage_v
            fine.advance_to(200 * k + t)
            through = fine.voltage_v
            slope = (through - before) / 1e-6
            shown[0] = through - slope * tau + (shown[0] - before + slope * tau) * kept
            shown[1] = slope + (shown[1] - slope) * kept
        p.advance_to(200 * (k + 1))
        silent.advance_to(200 * (k + 1))
        found = (np.array(p.sample()) - np.array(silent.sample())) * 1e-16
        expected = 2e-18 * shown[0] - 3e-19 * (shown[0].sum() - shown[0]) + rate * shown[1]
        assert np.abs(found - expected).max() < 1.01e-16 + 2e-18  # a count of each of two samples
        assert p.state["filtered_v"][0] == pytest.approx(shown[0], abs=2e-3)


def test_lines_have_room():
    """The widest floor and all harmonics fit into the record of parameters."""
    from sim.motion.layout import PARAMS, TONES

    p = np.zeros(1, PARAMS)
    harmonics = tuple({"order": k} for k in range(1, 9))
    cfg = config(floor_vibration={"highest_hz": 100.0}, mains={"harmonics": harmonics})
    build_surroundings(p[0], cfg)
    assert 60 < int(p["tone_count"][0]) <= TONES

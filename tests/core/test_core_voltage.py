"""Forces to counts: limits that nothing can pass, the square-root law there and back, noise shaping by its spectrum."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import MIDDLE, stage, tick_law
from scipy import signal

from pkxyz_ctrl.core.voltage import counts_for_forces, force_limits, forces_of_counts, shape
from pkxyz_ctrl.design.model.plant_model import linearise
from pkxyz_ctrl.design.noise_shaping import shaping_between_modes

MOST = 32767
HOSTILE = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=True),
    st.sampled_from([np.nan, np.inf, -np.inf, -0.0, 5e-324, 1e308, -1e308]),
    st.floats(0, 3e-3),
)
COUNTS = st.tuples(*[st.integers(0, MOST)] * 3).map(lambda c: np.array(c, np.int32))


def drive_with(*, slew=MOST, most=MOST, shaping=1):
    drive = tick_law()["drive"]
    drive["count_slew_max"], drive["count_max"], drive["noise_shaping"] = slew, most, shaping
    return drive


def convert(drive, force_n, last, carry_v):
    count = np.zeros(3, np.int32)
    counts_for_forces(drive, np.asarray(force_n, dtype=float), last, carry_v, count)
    return count


@settings(max_examples=400)
@given(
    st.lists(st.tuples(HOSTILE, HOSTILE, HOSTILE), min_size=1, max_size=8),
    COUNTS,
    st.integers(1, MOST),
    st.integers(1, MOST),
    st.booleans(),
)
def test_no_force_however_hostile_leaves_the_limits(forces, last, slew, most, shaping):
    """Tick after tick, the carry of the last one included."""
    drive, carry, last = drive_with(slew=slew, most=most, shaping=shaping), np.zeros(3), np.minimum(last, most)
    for force in forces:
        count = convert(drive, force, last, carry)
        assert np.all((count >= 0) & (count <= most))
        assert np.all(np.abs(count.astype(int) - last) <= slew)
        assert np.all(np.abs(carry) <= drive["volt_per_count"])
        last = count


@pytest.mark.parametrize("force", [np.nan, -np.inf, -1.0, -0.0, 0.0])
def test_what_is_no_pull_is_0_v(force):
    drive, carry = drive_with(), np.full(3, 1.0)
    assert convert(drive, [force] * 3, np.full(3, 20_000, np.int32), carry).tolist() == [0, 0, 0]


@pytest.mark.parametrize("force", [np.inf, 1e300, 1.0])
def test_what_is_too_much_is_the_most(force):
    drive = drive_with(most=30_000)
    assert convert(drive, [force] * 3, np.full(3, 20_000, np.int32), np.zeros(3)).tolist() == [30_000] * 3


@settings(max_examples=200)
@given(COUNTS)
def test_counts_to_forces_and_back(count):
    """Every count is found again from the force that it gives, exactly, with nothing left to carry."""
    for shaping in (0, 1):
        drive, force, carry = drive_with(shaping=shaping), np.zeros(3), np.zeros(3)
        forces_of_counts(drive, count, force)
        volts = count * (200 / 32767)
        assert force == pytest.approx(drive["force_gain_n_per_v2"] * volts**2, rel=1e-12)
        assert np.array_equal(convert(drive, force, count, carry), count)
        assert np.abs(carry).max() <= 1e-12 * 200


@settings(max_examples=200)
@given(st.tuples(*[st.floats(0, 2.6e-3)] * 3), COUNTS, st.integers(1, MOST), st.integers(1, MOST))
def test_a_force_within_the_limits_is_met_to_half_a_count(fractions, last, slew, most):
    """What ``force_limits`` promises, ``counts_for_forces`` keeps: inside them only the rounding is left."""
    drive, last, lower, upper = drive_with(slew=slew, most=most), np.minimum(last, most), np.zeros(3), np.zeros(3)
    force_limits(drive, last, lower, upper)
    assert np.all((lower >= 0) & (lower <= upper))
    force = np.clip(fractions, lower, upper)
    count = convert(drive, force, last, np.zeros(3))
    wanted = np.sqrt(force / drive["force_gain_n_per_v2"]) / drive["volt_per_count"]
    assert np.abs(count - wanted).max() <= 0.5 + 1e-6


def test_force_limits_are_those_of_the_counts_in_reach():
    """0 V is in reach from ``slew`` counts on, to the last bit; the voltage limit from as far below it."""
    drive, lower, upper = drive_with(slew=100, most=30_000), np.zeros(3), np.zeros(3)
    one = drive["force_gain_n_per_v2"] * drive["volt_per_count"] ** 2
    for last, low, high in (
        (0, 0, 100),
        (100, 0, 200),
        (101, 1, 201),
        (29_900, 29_800, 30_000),
        (30_000, 29_900, 30_000),
    ):
        force_limits(drive, np.full(3, last, np.int32), lower, upper)
        assert lower == pytest.approx(np.full(3, one * low**2), rel=1e-12, abs=0)
        assert upper == pytest.approx(np.full(3, one * high**2), rel=1e-12)


def sweep(shaping, ticks=1 << 16):
    """Voltage error in counts of a slow sweep over thousands of counts on three combs (ticks, 3), and the carries."""
    drive, carry = drive_with(shaping=shaping), np.zeros(3)
    t = np.arange(ticks)[:, None]
    volts = 100 + 60 * np.sin(2 * np.pi * t / np.array([9973.0, 7919.0, 12007.0]))
    force = drive["force_gain_n_per_v2"] * volts**2
    counts, carries = np.zeros((ticks, 3), np.int32), np.zeros((ticks, 3))
    last = np.round(volts[0] / drive["volt_per_count"]).astype(np.int32)
    for k in range(ticks):
        counts_for_forces(drive, force[k], last, carry, counts[k])
        last, carries[k] = counts[k], carry
    return counts - volts / drive["volt_per_count"], carries / drive["volt_per_count"]


def spectrum(error, bands):
    """One-sided density in counts^2 times the sampling rate, averaged over bands of the normalised frequency."""
    f, density = signal.welch(error, fs=1.0, nperseg=1024, axis=0, detrend=False)
    return np.array([density[(f >= low) & (f < high)].mean() for low, high in bands]), f


BANDS = [(0.01, 0.03), (0.03, 0.07), (0.07, 0.15), (0.15, 0.25), (0.25, 0.35), (0.35, 0.45), (0.45, 0.5)]
WHITE = 2 / 12  # one count's rounding, one-sided over half the sampling rate


def test_shaped_error_rises_as_the_first_difference():
    """|1 - z^-1|^2 times the white density of rounding, in seven bands; at low frequencies far below it."""
    error, carry = sweep(shaping=1)
    density, f = spectrum(error, BANDS)
    shape = np.abs(1 - np.exp(-2j * np.pi * f)) ** 2
    expected = np.array([WHITE * shape[(f >= low) & (f < high)].mean() for low, high in BANDS])
    assert np.all((density > 0.85 * expected) & (density < 1.15 * expected))
    assert density[0] < 0.03 * WHITE
    assert 0.248 < np.abs(carry).mean() < 0.252  # uniform over one count
    assert np.abs(carry).max() <= 0.5 + 1e-9
    # the errors are differences of the carry, so they telescope: no sum ever exceeds a count
    assert np.abs(np.cumsum(error, axis=0)).max() <= 0.5 + 1e-6
    assert np.abs(error.mean(axis=0)).max() < 1 / len(error)


def test_unshaped_error_is_white():
    error, carry = sweep(shaping=0)
    density, _ = spectrum(error, BANDS)
    assert np.all((density > 0.85 * WHITE) & (density < 1.15 * WHITE))
    assert np.abs(error).max() <= 0.5 + 1e-9
    assert np.abs(carry + error).max() < 1e-6  # it is noted, and not used


@pytest.mark.parametrize("count", [20, 20_000])
def test_a_constant_between_two_counts_is_met_on_average(count):
    """0.3 of a count: three ticks in ten the upper one. Without shaping it would be the lower one for ever."""
    drive = drive_with()
    force = np.full(3, drive["force_gain_n_per_v2"] * ((count + 0.3) * drive["volt_per_count"]) ** 2)
    for shaping, mean in ((1, count + 0.3), (0, count)):
        drive["noise_shaping"] = shaping
        carry, last, total = np.zeros(3), np.full(3, count, np.int32), np.zeros(3)
        for _ in range(1000):
            last = convert(drive, force, last, carry)
            total += last
        assert total / 1000 == pytest.approx(np.full(3, mean), rel=0, abs=2e-3)


def test_the_carry_does_not_wind_up_at_a_limit():
    """A thousand ticks beyond the limit leave one count of carry; two ticks later the voltage is right to a count."""
    drive, carry, last = drive_with(most=10_000), np.zeros(3), np.full(3, 9_000, np.int32)
    high = np.full(3, drive["force_gain_n_per_v2"] * 150.0**2)
    low = np.full(3, drive["force_gain_n_per_v2"] * (8_000 * drive["volt_per_count"]) ** 2)
    for _ in range(1000):
        last = convert(drive, high, last, carry)
    assert last.tolist() == [10_000] * 3
    for _ in range(3):
        last = convert(drive, low, last, carry)
        assert np.abs(last - 8_000).max() <= 1
    assert last.tolist() == [8_000] * 3


# -- shaping with zeros at the stage's modes ---------------------------------------------------------------------------


def held(shaping, count, ticks=1 << 14):
    """Voltage error in counts (ticks, 3) of a voltage that is held between counts."""
    drive, carry, errors, last = drive_with(), np.zeros(3), np.zeros((2, 3)), np.round(count).astype(np.int32)
    drive["shaping"] = shaping
    force, found = drive["force_gain_n_per_v2"] * (count * drive["volt_per_count"]) ** 2, np.zeros((ticks, 3))
    for k in range(ticks):
        last = convert(drive, force, last, carry)
        shape(drive, True, carry, errors)
        found[k] = last - count
    return found


def test_while_the_voltages_move_the_shaping_is_of_first_order():
    drive, carry, errors = drive_with(), np.array([1e-3, -2e-3, 0.0]), np.ones((2, 3))
    drive["shaping"] = 2.0, -2.0, 1.0
    shape(drive, False, carry, errors)
    assert carry.tolist() == [1e-3, -2e-3, 0.0]
    assert errors.tolist() == [[1e-3, -2e-3, 0.0], [1.0, 1.0, 1.0]]


def test_shaping_of_first_order_is_the_carry_itself_and_tones_are_its_price():
    error = held((1.0, 0.0, 0.0), np.full(3, 20_000.128))
    assert np.abs(np.cumsum(error, axis=0)).max() <= 0.5 + 1e-6
    power = np.abs(np.fft.rfft(error[:, 0])) ** 2
    assert np.sort(power)[-4:].sum() > 0.3 * power.sum()  # at 0.128 of the rate and its multiples: 640 Hz of 5 kHz


@pytest.mark.parametrize("fraction", [0.128, 0.25, 0.5, 0.731])
def test_between_the_modes_the_error_has_a_zero_and_is_no_tone(fraction):
    """631 and 808 Hz are the lowest and the highest mode of the stage in the middle of its workspace."""
    shaping = shaping_between_modes(linearise(stage(), MIDDLE), 200e-6)
    error = held(shaping, 20_000 + np.array([fraction, fraction / 3, 0.9 * fraction]))
    f, density = signal.welch(error[64:], fs=5000.0, nperseg=2048, axis=0, detrend=False)
    z = np.exp(2j * np.pi * f / 5000.0)
    shape = np.abs(1 - shaping[0] / z - shaping[1] / z**2 - shaping[2] / z**3) ** 2
    for low, high in ((100, 300), (600, 850), (1200, 1600), (2000, 2400)):
        band = (f >= low) & (f < high)
        assert 0.5 < density[band].mean() / (WHITE / 5000.0 * shape[band].mean()) < 2.0
    modes = (f >= 600) & (f < 850)
    assert density[modes].mean() < 0.05 * WHITE / 5000.0  # of first order it would be 0.7
    assert np.abs(error.mean(axis=0)).max() < 1e-3
    assert np.abs(error).max() < 4.0

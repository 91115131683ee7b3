"""Random numbers of the plant, against numpy's generator and statistics with stated odds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from sim_rig import GRADIENT_F_PER_M, config, plant, settle

from sim.motion.noise import next_u64, normal, stream
from sim.motion.streams import start_streams


@settings(max_examples=30)
@given(st.integers(0, 2**63), st.integers(0, 7), st.integers(0, 9))
def test_the_bits_are_numpys_own(seed, source, offset):
    words = stream(seed, source, offset)
    oracle = np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(source, offset)))
    assert [int(next_u64(words)) for _ in range(50)] == oracle.random_raw(50).tolist()


@settings(max_examples=50)
@given(
    st.integers(0, 2**128 - 1), st.dictionaries(st.integers(0, 13), st.integers(-(2**31), 2**33), min_size=1)
)  # fmt: skip
def test_sources_that_are_started_together_have_the_streams_of_each(seed, offsets):
    random = np.zeros((14, 4), np.uint64)
    start_streams(random, seed, offsets)
    for source in range(14):
        alone = stream(seed, source, offsets[source]) if source in offsets else np.zeros(4, np.uint64)
        assert random[source].tolist() == alone.tolist()


def test_a_seed_that_is_too_long_is_refused():
    for seed in (-1, 2**128):
        with pytest.raises(ValueError, match="128 bits"):
            start_streams(np.zeros((14, 4), np.uint64), seed, {0: 0})


def test_deviates_are_normal():
    words, spare = stream(5, 0, 0), np.zeros(2)
    x = np.array([normal(words, spare) for _ in range(20_000)])
    assert stats.kstest(x, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(x[:-1], x[1:])[0, 1]) < 4 / np.sqrt(len(x))


def samples(seed: int, n: int = 4000, **noise) -> np.ndarray:
    p = plant(config(sense_noise=noise), seed=seed, fine=True)
    return np.array([p.sample() for _ in range(n)]) * 1e-18


@pytest.mark.parametrize("period_us", [50, 200, 500])
def test_noise_of_a_sample_is_density_times_root_half_rate(period_us):
    """5 aF/rtHz: 2.0 nm rms at 5 kHz. Chi-squared bounds at about 4 sigma."""
    p = plant(config(sense_noise={"density_f_per_rt_hz": 5e-18}), period_us=period_us, fine=True)
    x = np.array([p.sample() for _ in range(4000)]) * 1e-18
    expected = 5e-18 * np.sqrt(1e6 / period_us / 2)
    assert x.std(axis=0) == pytest.approx(np.full(3, expected), rel=0.045)
    if period_us == 200:
        assert expected / GRADIENT_F_PER_M == pytest.approx(1.96e-9, rel=0.01)


def test_channels_are_independent_and_white():
    x = samples(3)
    bound = 4 / np.sqrt(len(x))
    assert np.abs(np.corrcoef(x.T) - np.eye(3)).max() < bound
    for channel in x.T:
        assert abs(np.corrcoef(channel[:-1], channel[1:])[0, 1]) < bound


def test_seed_and_offset_choose_the_stream():
    first = samples(1, 50)
    assert (first == samples(1, 50)).all()
    assert (first != samples(2, 50)).any()
    assert (first != samples(1, 50, seed_offset=1)).any()


def test_an_offset_moves_its_own_source_alone():
    """With another stream of Brownian force the sense noise stays, bit for bit; the motion does not."""
    runs = []
    for offset in (0, 1):
        p = plant(config(brownian={"seed_offset": offset}, sense_noise={}))
        p.advance_to(2000)
        runs.append((p.state["random"][0][:3].copy(), p.position_m))
    assert (runs[0][0] == runs[1][0]).all()
    assert (runs[0][1] != runs[1][1]).any()


def test_brownian_motion_obeys_equipartition():
    """1/2 K <x^2> = 1/2 k T per axis, at 3 million kelvin to stand out; 2 s hold some 250 independent looks."""
    kelvin = 3e6
    p = settle(plant(config(brownian={"temperature_k": kelvin}), seed=4), 40_000, 100)
    x = []
    for _ in range(20_000):
        p.advance_to(p.t_us + 100)
        x.append(p.position_m)
    expected = np.sqrt(1.380649e-23 * kelvin / np.array([75.96, 75.96, 113.64]))
    assert np.std(x, axis=0) == pytest.approx(expected, rel=0.15)


def test_walks_grow_with_the_root_of_time():
    """Force and sense walks over 0.1 s from 60 seeds: size * sqrt(t), within 4 sigma of 180 draws."""
    force, sense = [], []
    for seed in range(60):
        p = plant(config(drift={"walk_n_per_rt_s": 1e-6}, sense_drift={"walk_f_per_rt_s": 1e-15}), seed=seed)
        settle(p, 100_000, 1000)
        force.append(p.state["drift_walk_n"][0].copy())
        sense.append(p.state["sense_walk_f"][0].copy())
    assert np.std(force) == pytest.approx(1e-6 * np.sqrt(0.1), rel=0.2)
    assert np.std(sense) == pytest.approx(1e-15 * np.sqrt(0.1), rel=0.2)

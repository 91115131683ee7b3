"""Dies and random numbers of wafers: the same for whoever draws them, and spread as the process file says."""

import numpy as np
import pytest
from process_rig import SHIPPED, process

from pkxyz_ctrl.fabrication.process import SOURCES, Spread, WaferConfig
from pkxyz_ctrl.fabrication.wafer import die_places_m, dies_per_wafer, sample_devices, sample_wafers, sizes


def bias_of(spread, wafers, seed=1):
    """Etch bias (wafers, D, 3) in um."""
    of = process(etch_bias_m=spread)
    sampled = sample_wafers(of, seed, range(wafers))
    return 1e6 * sizes(of, sampled)["etch_bias_m"].reshape(wafers, -1, 3), sampled


def test_a_device_is_the_same_alone_and_among_many():
    whole = sample_devices(SHIPPED, 7, 0, 1000)
    size = sizes(SHIPPED, whole)
    dies = dies_per_wafer(SHIPPED)
    for number in (0, dies - 1, dies, 417, 999):
        alone = sample_devices(SHIPPED, 7, number, 1)
        assert alone.device.tolist() == [number]
        assert alone.place_m[0].tolist() == whole.place_m[number].tolist()
        mine = sizes(SHIPPED, alone)
        assert all(mine[name][0].tolist() == size[name][number].tolist() for name in SOURCES)


def test_the_spread_of_one_quantity_moves_no_other():
    wider = SHIPPED.model_copy(update={"etch_bias_m": Spread(wafer=1e-6, chain=1e-6)})
    before, after = (sizes(p, sample_devices(p, 1, 0, 200)) for p in (SHIPPED, wider))
    assert [n for n in SOURCES if not np.array_equal(before[n], after[n])] == ["etch_bias_m"]


def test_another_seed_and_another_wafer_are_other_devices():
    a, b = (sample_wafers(SHIPPED, seed, [0]).deviates["hinge_m"].die for seed in (1, 2))
    c = sample_wafers(SHIPPED, 1, [1]).deviates["hinge_m"].die
    assert not np.intersect1d(a, b).size
    assert not np.intersect1d(a, c).size


def test_each_level_has_its_own_standard_deviation():
    bias, _ = bias_of(Spread(mean=0.5e-6, wafer=0.3e-6), 400)
    assert np.ptp(bias, axis=(1, 2)).max() < 1e-12  # of a whole wafer
    assert bias[:, 0, 0].mean() == pytest.approx(0.5, abs=4 * 0.3 / 20)
    assert bias[:, 0, 0].std() == pytest.approx(0.3, rel=4 / np.sqrt(800))
    bias, _ = bias_of(Spread(chain=0.2e-6), 20)
    assert bias.std() == pytest.approx(0.2, rel=4 / np.sqrt(2 * bias.size))
    assert abs(np.corrcoef(bias[..., 0].ravel(), bias[..., 1].ravel())[0, 1]) < 4 / np.sqrt(bias[..., 0].size)


def test_the_field_over_a_wafer_is_correlated_by_distance():
    bias, _ = bias_of(Spread(die=0.1e-6), 3000)
    field, places = bias[..., 0], die_places_m(SHIPPED.wafer)
    assert np.abs(bias[..., 0] - bias[..., 2]).max() < 1e-12  # the same for a die's chains
    found = np.corrcoef(field.T)
    distance = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    assert field.std() == pytest.approx(0.1, rel=0.05)
    assert found == pytest.approx(np.exp(-distance / SHIPPED.wafer.correlation_m), abs=5 / np.sqrt(3000))


def test_a_bowl_is_edge_less_centre_and_a_tilt_a_slope():
    bias, sampled = bias_of(Spread(bowl=0.4e-6), 1)
    radius = np.hypot(*sampled.place_m.T) / SHIPPED.wafer.usable_radius_m
    reach = SHIPPED.wafer.chain_radius_m / SHIPPED.wafer.usable_radius_m
    assert bias[0].mean(axis=1) == pytest.approx(0.4 * (radius**2 + reach**2 - 0.5), abs=1e-12)
    assert np.ptp(bias[0], axis=1).max() > 0.02  # at the edge the chains of a die differ
    slope, sampled = bias_of(Spread(tilt=0.3e-6), 500)
    plane = np.linalg.lstsq(sampled.place_m[: len(slope[0])], slope.mean(axis=2).T, rcond=None)[0]
    edge = plane * SHIPPED.wafer.usable_radius_m
    assert edge.std() == pytest.approx(0.3, rel=4 / np.sqrt(2000))


def test_dies_are_whole_and_do_not_overlap():
    for die_m in (3e-3, 8e-3, 20e-3, 60e-3):
        wafer = SHIPPED.wafer.model_copy(update={"die_m": die_m})
        places = die_places_m(wafer)
        corner = np.hypot(np.abs(places[:, 0]) + die_m / 2, np.abs(places[:, 1]) + die_m / 2)
        assert corner.max() <= wafer.usable_radius_m
        apart = np.abs(places[:, None] - places[None]).max(axis=2) + np.eye(len(places))
        assert apart.min() > die_m * (1 - 1e-9)
    assert dies_per_wafer(SHIPPED) == 76


def test_a_wafer_that_holds_no_die_is_refused():
    with pytest.raises(ValueError, match="no die fits"):
        WaferConfig(diameter_m=0.01, edge_m=1e-3, die_m=8e-3, correlation_m=1e-2, chain_radius_m=0.0)
    with pytest.raises(ValueError, match="more than 2000 dies"):
        WaferConfig(diameter_m=0.3, edge_m=1e-3, die_m=5e-3, correlation_m=1e-2, chain_radius_m=0.0)

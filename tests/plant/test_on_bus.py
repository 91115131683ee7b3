"""The plant behind the node: what SYNC, drive and waiting mean to it, and the truth beside each sample."""

import numpy as np
import pytest
from sim_rig import config, plant

from hil.plant.on_bus import PlantOnBus

PERIOD_US = 200
HELD = (18000, 21000, 16000)
SENSE = {"sense_noise": {}}


def pair():
    """A plant on the bus, and the same plant by hand."""
    effects = config(**SENSE)
    return PlantOnBus(plant(effects, seed=3)), plant(effects, seed=3)


def test_a_sample_moves_on_takes_new_voltages_and_reads_the_sensors():
    on_bus, by_hand = pair()
    for tick in range(200):
        counts = None if tick % 3 else tuple(count + 10 * tick for count in HELD)
        sensed = on_bus.exchange(5_000_000 + tick * PERIOD_US, counts, sample=True)
        by_hand.advance_to(tick * PERIOD_US)
        position_m, stroke_m, voltage_v = by_hand.position_m, by_hand.stroke_m, by_hand.voltage_v.copy()
        if counts is not None:
            by_hand.drive(counts)
        assert sensed == by_hand.sample()
        truth = on_bus.record[0]
        assert np.array_equal(truth["position_m"], position_m)
        assert np.array_equal(truth["stroke_m"], stroke_m)
        assert np.array_equal(truth["comb_voltage_v"], voltage_v)
    assert np.abs(on_bus.record[0]["position_m"]).max() > 1e-6


def test_until_the_first_sample_no_time_passes():
    on_bus, by_hand = pair()
    before = on_bus.sensed
    assert on_bus.exchange(3_000_000, None, sample=False) == before
    assert on_bus.plant.t_us == 0
    assert not on_bus.was_sampled
    assert on_bus.exchange(9_000_000, None, sample=True) == by_hand.sample()
    assert on_bus.was_sampled
    assert on_bus.origin_us == 9_000_000


@pytest.mark.parametrize("later_us", [1, 70, 199])
def test_between_samples_voltages_act_at_once_and_a_look_brings_the_truth(later_us):
    on_bus, by_hand = pair()
    on_bus.exchange(0, HELD, sample=True)
    by_hand.drive(HELD)
    seen = by_hand.sample()
    assert on_bus.exchange(later_us, (0, 0, 0), sample=False) == seen  # nothing new was sampled
    by_hand.advance_to(later_us)
    by_hand.drive((0, 0, 0))
    on_bus.look(PERIOD_US)
    by_hand.advance_to(PERIOD_US)
    assert np.array_equal(on_bus.record[0]["position_m"], by_hand.position_m)
    assert np.array_equal(on_bus.record[0]["comb_voltage_v"], by_hand.voltage_v)

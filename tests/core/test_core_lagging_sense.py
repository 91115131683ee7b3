"""A sine near the corner of the sense chain: what its lag shows there beyond its square is not learnt."""

import numpy as np
import pytest

from hil.bench.rigs.answers import response_of, sine_response
from hil.bench.rigs.motions import MIDDLE_M, rows_of_setup, setup_of
from pkxyz_ctrl.trajectory import Sine

HZ = 1262.0
"""Of a chain with its corner at 1.6 kHz."""


def size_db(response):
    return 20.0 * np.log10(abs(response))


def learning_all_the_while():
    """The same with nothing that holds learning up where the reference turns."""
    sine = Sine(kind="sine", axis="x", amplitude_m=100e-9, frequency_hz=HZ, cycles=200.0)
    setup, first = setup_of([sine], "youla", "lab", MIDDLE_M)
    law = setup.law.copy()
    law["tick"]["adaptation"]["turn_m_per_s2"] = np.inf
    vars(setup)["law"] = law
    begin_us, end_us = setup.trajectory.segments[first].scan_us
    rows = rows_of_setup(setup)[-(-begin_us // setup.bus.period_us) : -(-end_us // setup.bus.period_us)]
    return response_of(rows, setup.bus.period_us, "x", HZ)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_fast_sine_keeps_its_size(axis):
    assert abs(size_db(sine_response(axis, HZ, "youla", "lab"))) < 0.4


def test_it_would_grow_by_a_third_if_that_were_learnt():
    assert 2.0 < size_db(learning_all_the_while()) < 3.0


def test_without_a_lag_nothing_holds_learning_up():
    """So the shipped figures of a stage whose chain settles within the sample are as they were."""
    setup, _ = setup_of([], "youla", "mild", MIDDLE_M)
    assert np.isinf(setup.law["tick"]["adaptation"]["turn_m_per_s2"]).all()
    setup, _ = setup_of([], "youla", "lab", MIDDLE_M)
    limit_m_per_s2 = setup.law["tick"]["adaptation"]["turn_m_per_s2"][0]
    assert (limit_m_per_s2 > 0.2).all()  # a circle of 4 um at 100 Hz turns by 0.2 m/s2 in a period
    assert (limit_m_per_s2 < 1.0).all()

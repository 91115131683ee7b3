"""A stage file says how much its sense chain lags: what laws are designed and judged for behind it."""

import dataclasses

import numpy as np
import pytest
from loop_rig import MIDDLE, bus, stage

from hil.studies.margins.loop import Loop
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.design.model.discrete_law import response
from pkxyz_ctrl.design.model.loop_plant import Perturbation, loop_plant

F_HZ = np.array([20.0, 100.0, 300.0])
LAB = stage("lab")


def gain(device, change=None, sense_lag="filter"):
    p = loop_plant(device, bus(), MIDDLE, change or Perturbation(), sense_lag)
    return response(p.a, p.b, p.c, np.zeros((3, 3)), np.exp(2j * np.pi * F_HZ * 2e-4))[:, 0, 0]


@pytest.mark.parametrize("sense_lag", ["filter", "amplifier"])
def test_a_lag_is_that_of_a_filter_which_also_weakens(sense_lag):
    """To 0.3 %, up to where the hold of a period tells them apart; a lag that strengthened would be off by 3.5 %."""
    lag_s = LAB.sense_delay_s
    found = gain(LAB, sense_lag=sense_lag) / gain(stage())
    assert found == pytest.approx(1.0 / (1.0 + 2j * np.pi * F_HZ * lag_s), rel=0.003)
    assert 0.98 < abs(found[-1]) < 0.985


def test_and_may_be_taken_for_a_delay():
    later = gain(stage(), Perturbation(delay_s=LAB.sense_delay_s))
    assert gain(LAB, sense_lag="delay") == pytest.approx(later, rel=1e-12)


def test_a_device_has_its_own_pole_beside_it():
    found = gain(LAB, Perturbation(sense_bandwidth_hz=2e3)) / gain(LAB)
    assert found == pytest.approx(1.0 / (1.0 + 1j * F_HZ / 2e3), rel=0.01)


@pytest.mark.parametrize("sense_lag", ["filter", "delay", "amplifier"])
def test_without_a_lag_nothing_of_it_is_there(sense_lag):
    plant, plain = loop_plant(stage(), bus(), MIDDLE, sense_lag=sense_lag), loop_plant(stage(), bus(), MIDDLE)
    assert (plant.a == plain.a).all()
    assert (plant.c == plain.c).all()


def designed(name):
    return Loop(LAB, bus(), design_law(LAB, load("controllers", name, ControllerConfig), bus(), autostart=True))


def test_hinf_bears_the_lag_as_a_filter_and_as_a_delay():
    """Designed for a lag that weakens nothing it has Ms 8.3 behind the filter, and loses a fifth of the devices."""
    loop = designed("hinf")
    assert 2.0 < loop.margins(MIDDLE).mimo.peak_s < 2.3
    tolerances = load("tolerances", "wide", Tolerances)
    cases = [dataclasses.replace(tolerances.sample(seed), strokes_m=MIDDLE) for seed in range(1, 101)]
    unstable = sum(np.isinf(loop.peak_sensitivity(case)) for case in cases)
    assert 5 <= unstable <= 12


def test_robust_does_for_the_filter_alone_and_is_refused():
    with pytest.raises(ConfigError, match=r"'robust'.*refused: axis z bears 19\.\d us of additional delay, and 50"):
        designed("robust")

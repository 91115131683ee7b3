"""Devices side by side against one after another: the same bits of memory, plant and error, whatever law and plant."""

from dataclasses import replace

import numpy as np
import pytest

from hil.abreast import batch, machine
from hil.bench.study import short_scan
from hil.lanes import many
from hil.lanes.many import Batch
from hil.runs.scenario import load_scenario
from hil.studies.wafer.closed_loop import WORTH_MAKING, ClosedLoops
from hil.studies.wafer.study import WaferStudy
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.fabrication.process import Process

pytestmark = pytest.mark.skipif(not machine.can_be_had(), reason="needs the vectors of AVX-512")

SCENARIO = short_scan()
DEVICES = 19
"""No multiple of the lanes."""
LAWS = ("lqg", "robust", "hinf", "irc", "pi_notch", "open_loop")


@pytest.fixture(scope="module", autouse=True)
def _made():
    assert batch.prepare(own_laws=False)
    assert batch.prepare(own_laws=True)


def setup_of(controller="youla", plant="nominal"):
    other = load_scenario("raster", controller=controller, plant=plant)
    return replace(SCENARIO, controller=other.controller, plant=other.plant).setup()


def plants_of(base):
    """By their combs and their noise; one can't be held, and ends in a fault."""
    found = []
    for seed in range(1, DEVICES + 1):
        pulls = (3.0, -0.8, 0.0) if seed == 5 else (0.01 * (seed % 7) - 0.03, 0.0, 0.02 - 0.005 * (seed % 5))
        combs = base.plant.comb_mismatch.model_copy(update={"on": True, "relative": pulls})
        plant = base.plant.model_copy(update={"comb_mismatch": combs})
        found.append(replace(base, seed=seed, plant=plant).new_plant())
    return found


def both(setup, laws):
    """A batch run side by side, and one after another."""
    together, alone = (Batch.of(setup, laws, plants_of(setup)) for _ in range(2))
    batch.run_side_by_side(together)
    many.run_one_after_another(alone)
    return together, alone


def same(one, other):
    """Names of the fields whose bits differ; what lies between fields is nobody's."""
    if one.dtype.names is None:
        return [] if one.tobytes() == other.tobytes() else [""]
    return [f"{name}.{rest}" for name in one.dtype.names for rest in same(one[name], other[name])]


def assert_same_bits(together, alone):
    for name in ("found", "memories", "states"):
        assert same(getattr(together, name), getattr(alone, name)) == []


@pytest.mark.parametrize("plant", ["nominal", "mild", "lab", "harsh"])
def test_each_device_has_the_bits_that_it_has_alone(plant):
    setup = setup_of(plant=plant)
    together, alone = both(setup, setup.law)
    assert_same_bits(together, alone)
    assert 0 < together.found["faulted"].sum() < DEVICES
    assert together.found["ticks"].max() > 1000


@pytest.mark.parametrize("controller", LAWS)
def test_under_every_law(controller):
    setup = setup_of(controller)
    assert_same_bits(*both(setup, setup.law))


def test_each_under_a_law_of_its_own_and_of_another_kind():
    setups = [setup_of(controller) for controller in ("youla", *LAWS)]
    laws = many.joined([setups[n % len(setups)].law for n in range(DEVICES)])
    laws.flags.writeable = False
    assert_same_bits(*both(setups[0], laws))


def test_errors_are_the_same_with_and_without(monkeypatch):
    setup = setup_of()
    seen = []
    monkeypatch.setattr(many, "run_one_after_another", lambda batch: seen.append(len(batch.params)))
    with_vectors = batch.scan_errors(setup, setup.law, plants_of(setup))
    assert not seen
    monkeypatch.undo()
    monkeypatch.setattr(machine, "is_there", lambda **_: False)
    assert np.array_equal(with_vectors, batch.scan_errors(setup, setup.law, plants_of(setup)))


def test_without_devices_nothing_is_found():
    assert len(batch.scan_errors(setup_of(), setup_of().law, [])) == 0


def test_a_study_of_many_devices_makes_it_and_one_of_few_does_not(monkeypatch):
    loops = ClosedLoops(WaferStudy(load("processes", "oreo_drie", Process), SCENARIO.stage, 1), SCENARIO, known=True)
    asked, told = [], []
    monkeypatch.setattr(machine, "code", lambda **which: asked.append(which["own_laws"]))
    monkeypatch.setattr(machine, "is_there", lambda **_: False)
    loops.prepare(100, told.append)
    assert not asked
    loops.prepare(WORTH_MAKING, told.append)
    assert asked == [False, True]
    assert all("once" in words for words in told)
    asked.clear()
    replace(loops, known=False).prepare(WORTH_MAKING, told.append)
    assert asked == [False]

"""Many devices in one compiled loop: the errors that the fast lane's rows have, whoever is run beside whom."""

from dataclasses import replace

import numpy as np
import pytest

from hil.bench.study import short_scan
from hil.lanes import in_process as lanes
from hil.lanes import many
from hil.lanes.lane import Lane
from hil.runs.metrics import Metrics
from hil.runs.scenario import load_scenario

SCENARIO = short_scan()


def setups(controller="youla"):
    """Devices by their combs and their noise, one of which can't be held."""
    asked = SCENARIO if controller == "youla" else replace(
        SCENARIO, controller=load_scenario("raster", controller=controller).controller
    )  # fmt: skip
    base = asked.setup()

    def device(seed, pulls):
        combs = base.plant.comb_mismatch.model_copy(update={"on": True, "relative": pulls})
        made = replace(base, seed=seed, plant=base.plant.model_copy(update={"comb_mismatch": combs}))
        made.__dict__["law"] = base.law
        return made

    return [device(3, (0.05, -0.03, 0.01)), device(4, (-0.1, 0.02, 0.1)), device(5, (3.0, -0.8, 0.0)),
            device(6, (0.0, 0.0, 0.0))]  # fmt: skip


def scan_errors(setup, laws, plants):
    batch = many.Batch.of(setup, laws, plants)
    many.run_one_after_another(batch)
    return batch.found


def by_rows(setup):
    """Faults, RMS error and its deviation (3,) in m, as the recording's rows have them."""
    metrics = Metrics(setup.trajectory, setup.bus.period_us)
    ran = lanes.run(setup, Lane.FAST, on_block=metrics.update)
    figures = metrics.figures()
    return bool(ran.faults), figures.rms_error_nm, figures.error_deviation_nm


@pytest.mark.parametrize("controller", ["youla", "lqg", "irc"])
def test_errors_are_those_of_the_rows(controller):
    asked = setups(controller)
    found = scan_errors(asked[0], asked[0].law, [setup.new_plant() for setup in asked])
    ended = []
    for setup, one, rms, deviation in zip(asked, found, many.rms_m(found), many.deviation_m(found), strict=True):
        faulted, rms_nm, deviation_nm = by_rows(setup)
        ended.append(faulted)
        assert bool(one["faulted"]) == faulted
        if not faulted:
            assert 1e9 * rms == pytest.approx(list(rms_nm.values()), rel=1e-9)
            assert 1e9 * deviation == pytest.approx(list(deviation_nm.values()), rel=1e-9)
    assert set(ended) == {False, True}


def test_who_is_run_beside_whom_changes_no_bit():
    asked = setups()
    together = scan_errors(asked[0], asked[0].law, [setup.new_plant() for setup in asked])
    own_laws = many.joined([setup.law for setup in asked])
    own_laws.flags.writeable = False
    assert np.array_equal(together, scan_errors(asked[0], own_laws, [setup.new_plant() for setup in asked]))
    for n, setup in enumerate(asked):
        assert np.array_equal(together[n : n + 1], scan_errors(setup, setup.law, [setup.new_plant()])), n


def test_what_it_has_no_room_for_is_told():
    plain = setups()[0]
    assert many.can_run(plain)
    assert not many.can_run(replace(plain, duration_s=many.TICKS_MOST * plain.bus.period_s + 1.0))
    assert not many.can_run(load_scenario("frames").setup())  # learns
    assert not many.can_run(load_scenario("raster", controller="mpc").setup())

"""A hold that is made quiet while it lasts, and lively again: half the noise, and no step on the way."""

import numpy as np
from operated_rig import OperatedRig, Script, tracked

from hil.operate.commands import Verb
from hil.runs.scenario import load_scenario


def test_a_hold_becomes_quiet_and_lively_again_without_a_bump():
    rig = OperatedRig(load_scenario("raster", controller="youla").setup())
    switched: list[int] = []

    def script() -> Script:
        yield from rig.switched_on()
        for quiet in (False, True, False):
            rig.controller.hold_quietly(quiet)
            switched.append(len(rig.rows))
            yield from rig.wait_s(0.25)
        rig.controller.hold_quietly(True)
        assert (yield from rig.do(Verb.MOVE, relative=1, target_m=(1e-6, np.nan, np.nan)))  # it moves as ever
        yield from rig.wait_s(0.05)

    rows = rig.play(script())
    assert not rig.controller.faults
    error_nm = 1e9 * (rows["position_m"] - rows["reference_m"])
    lively, quiet, again = (error_nm[at + 150 : at + 1250] for at in switched)
    rms_nm = [np.sqrt((part**2).mean(axis=0)) for part in (lively, quiet, again)]
    assert all(0.85 < v < 1.1 for v in (*rms_nm[0], *rms_nm[2]))
    assert all(0.35 < v < 0.75 for v in rms_nm[1])
    for at in switched[1:]:  # the fade, and what it could stir up
        assert np.abs(error_nm[at : at + 200]).max() < 4.5
    assert np.abs(1e9 * (tracked(rows)["position_m"] - tracked(rows)["reference_m"]))[switched[-1] - 4000 :].max() < 8.0

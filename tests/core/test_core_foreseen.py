"""What a tick works out for the next one: the same bits as if each tick worked out all of its own."""

import numpy as np
import pytest

from hil.lanes.fast import run_block
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Event, Mode

TICKS = 1000
JUMP_TICK, OTHER_TICK = 120, 400
"""From the first on the path has jumped; from the second tick of the run on it is another one, without notice."""
EVENTS = {450: Event.HOLD, 520: Event.TRACK, 525: Event.HOLD, 530: Event.TRACK, 800: Event.LAND}


def ran(controller, *, forgets):
    """Rows (TICKS,), and how many ticks had been foreseen."""
    setup = load_scenario("raster", controller=controller).setup()
    path = reference_rows(setup.trajectory.sample(0, TICKS + 25, setup.bus.period_us))
    path["motion"][JUMP_TICK:, 0:2] += 0.7e-6
    other = path.copy()
    other["motion"][:, 2] += 20e-9
    law, plant, memory, rows = setup.law, setup.new_plant(), cycling.new_memory(Mode.IDLE), np.zeros(TICKS, ROW)
    foreseen = 0
    for k in range(TICKS):
        memory["input"]["event"] = EVENTS.get(k, Event.NONE)
        model = memory["tick"]["set_point_model"]
        foreseen += int(model["foreseen"][0])
        if forgets:
            model["foreseen"] = 0
        at_us = np.array([k * setup.bus.period_us], np.int64)
        reference = path if k < OTHER_TICK else other
        run_block(law, memory, reference, plant.params, plant.state, at_us, rows[k : k + 1], 1)
    return rows, foreseen


@pytest.mark.parametrize("controller", ["lqg", "youla"])
def test_what_was_foreseen_changes_no_bit(controller):
    """Through jumps, another path, holds that are cut short, and the way down."""
    rows, foreseen = ran(controller, forgets=False)
    anew, _ = ran(controller, forgets=True)
    assert foreseen > 500
    assert {Mode.TRACKING, Mode.ENABLED, Mode.LANDING} <= set(rows["mode"].tolist())
    assert np.abs(np.diff(rows["reference_m"][:, 2])).max() > 15e-9  # the other path
    for name in ROW.names or ():
        assert rows[name].tobytes() == anew[name].tobytes(), name

"""Late ticks, in lockstep where lateness can be dosed: counted, recorded, survived, and a fault at the number that the
controller file gives.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import controller, controller_with, setup, shortened

from hil.lanes.blocks import Blocks
from hil.lanes.lockstep import LockstepRig
from hil.lanes.setup import Setup
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import Trip
from pkxyz_ctrl.stage import Stage

TICKS = 1200
ALLOWED = controller().monitors.overrun_count
LEAK_TICKS = controller().monitors.overrun_leak_ticks


class Late:
    """A clock that oversleeps: ``periods`` of them at the ticks that ask for it."""

    def __init__(self, clock, period_us, periods):
        self._clock, self._period_us, self._periods = clock, period_us, dict(periods)
        self._first_us = None
        self.spend = clock.spend

    @property
    def now_us(self):
        return self._clock.now_us

    def wait_until(self, t_us):
        if self._first_us is None:
            self._first_us = t_us
        late = self._periods.pop((t_us - self._first_us) // self._period_us, 0)
        self._clock.wait_until(t_us + late * self._period_us)


def rows_when(late):
    """(n,) of ROW, and what the run says, of a loop that oversleeps; ``late``: periods by the tick's instant."""
    found = []
    rig = LockstepRig(shortened(setup(), TICKS), whole_ticks=False)
    real = rig.clock
    rig.clock = Late(real, rig.setup.bus.period_us, late)
    blocks = Blocks(
        rig.setup.trajectory, rig.setup.bus.period_us, TICKS, lambda b: found.append(b.copy()), lambda done, total: None
    )
    missed, _ = rig.run(blocks)
    return np.concatenate(found), missed, rig.controller


def test_one_fewer_than_allowed_is_survived_and_one_more_is_a_fault():
    survived, missed, quiet = rows_when({500: ALLOWED - 1})
    assert quiet.faults == []
    assert (survived["mode"][500:] == Mode.TRACKING).all()
    assert survived["overrun"][500] == survived["overrun"].sum() == missed == ALLOWED - 1
    tripped, missed, loud = rows_when({500: ALLOWED})
    assert missed == ALLOWED
    assert tripped["trips"][500] == Trip.OVERRUN
    assert (tripped["mode"][500:526] == Mode.LANDING).all()
    assert (tripped["mode"][526:] == Mode.FAULT).all()
    assert not tripped["drive_count"][526:].any()
    (fault,) = loud.faults
    assert "OVERRUN" in fault
    assert fault.startswith("at 0.1052 s: ")


@settings(max_examples=12)
@given(st.dictionaries(st.integers(300, TICKS), st.integers(1, 4), max_size=6))
def test_the_fault_comes_where_the_bucket_is_full(late):
    """Each missed tick adds one, each good one takes 1/leak away; independent bookkeeping in whole leaks."""
    rows, missed, rig = rows_when(late)
    assert missed == rows["overrun"].sum()
    level, expected = 0, None
    for index, overrun in enumerate(rows["overrun"].tolist()):
        level = level + overrun * LEAK_TICKS if overrun else max(0, level - 1)
        if expected is None and level >= ALLOWED * LEAK_TICKS:
            expected = index
    tripped = np.flatnonzero(rows["trips"])
    assert (int(tripped[0]) if len(tripped) else None) == expected
    assert len(rig.faults) == (Mode.FAULT in rows["mode"])


def test_ticks_that_were_skipped_shift_no_other():
    """The trajectory goes on where it was, on instants that are whole periods from the first."""
    rows, _, _ = rows_when({400: 3, 700: 1})
    assert rows["overrun"].nonzero()[0].tolist() == [400, 697]
    assert (np.diff(rows["reference_tick"][300:]) == 1).all()
    assert rows["tick"].tolist() == list(range(TICKS))


@pytest.mark.parametrize("count", [-1, 1])
def test_the_number_is_the_configurations(count, monkeypatch):
    asked = controller_with(monitors={"overrun_count": count})
    law = design_law(Stage(setup().stage), asked, setup().bus, autostart=True)
    monkeypatch.setattr(Setup, "law", law)
    rows, missed, _ = rows_when({600: 12 if count < 0 else 1})
    assert missed == (12 if count < 0 else 1)
    assert (rows["mode"][-1] == Mode.FAULT) == (count > 0)

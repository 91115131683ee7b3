"""The self-test of an exported folder, as this machine goes through it: from sense frame to drive frame."""

import numpy as np
import pytest

from hil.runs.scenario import load_scenario
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.export.selftest import Board, self_test
from pkxyz_ctrl.export.wire import wire_record
from pkxyz_ctrl.loop.cycle import INPUT
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.safety.gate_rules import Reason
from pkxyz_ctrl.safety.monitors import SenseStatus

TICKS = 300


@pytest.fixture(scope="module")
def parts():
    setup = load_scenario("raster").setup()
    reference = reference_rows(setup.trajectory.sample(0, TICKS, setup.bus.period_us))
    return setup.law, wire_record(setup.gate, DriverConfig()), reference, np.zeros(TICKS, INPUT)


def test_the_same_frames_give_the_same_digests_and_others_do_not(parts):
    *settled, inputs = parts
    test = self_test(*settled, inputs)
    assert self_test(*settled, inputs).digests == test.digests
    assert len(test.digests) == TICKS // 100 + 1
    other = inputs.copy()
    other["sense_count"][250, 1] = 1
    changed = self_test(*settled, other)
    assert [a == b for a, b in zip(test.digests, changed.digests, strict=True)] == [True, True, False, False]


def test_frames_reach_the_cycle_and_its_answer_passes_the_gate(parts):
    law, wire, reference, inputs = parts
    inputs = inputs.copy()
    inputs["sense_count"] = np.arange(3 * TICKS).reshape(TICKS, 3) - 400
    test = self_test(law, wire, reference, inputs)
    board = Board(law, wire, reference)
    statuses, tried = [], set()
    for n in range(TICKS):
        row, drive, doubtful = board.tick(n, test.frames, test.tried)
        statuses.append(int(row["sense_status"][0]))
        tried.add(int(doubtful["reason"][0]))
        assert drive["reason"] == 0
        assert drive["can_id"] == 0x30A
        if statuses[-1] == 0:
            assert row["sense_count"].tolist() == [inputs["sense_count"][n].tolist()]
    assert statuses[96] == SenseStatus.CRC | SenseStatus.MISSING
    assert statuses[130] == SenseStatus.MISSING
    assert statuses[97] == statuses[131] == SenseStatus.COUNTER
    assert statuses[:96] == [0] * 96
    assert {0, Reason.UNUSUAL, Reason.IDENTIFIER, Reason.NMT, Reason.SDO_WRITE, Reason.DRIVE_UNKNOWN} <= tried

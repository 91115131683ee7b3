"""The self-test of an exported folder, as this machine goes through it: from start-up to the last drive frame."""

import dataclasses

import numpy as np
import pytest

from hil.faults.fault import Fault
from hil.lanes.blocks import PREVIEW_ROWS, Blocks
from hil.lanes.lockstep import LockstepRig
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.can.driver import bytes_of
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.export.calls import Call, RecordedController
from pkxyz_ctrl.export.selftest import Board, damaged, self_test
from pkxyz_ctrl.export.stored import stored_in_exchange
from pkxyz_ctrl.export.words import canonical
from pkxyz_ctrl.loop.exchange import EXCHANGE, EXCHANGE_MEMORY
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.safety.gate_rules import Reason
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.monitors import SenseStatus

TICKS = 300


class Run:
    """A scenario in lockstep, its calls noted: ``rows`` (n,) as they were recorded, ``sent`` all frames on the wire."""

    def __init__(self, setup):
        self.sent, rows = [], []

        class Noting(RecordedController):
            def __init__(noting, law, bus, gate, send, *others):  # noqa: N805
                def note_and_send(frame):
                    self.sent.append(frame)
                    send(frame)

                super().__init__(law, bus, gate, note_and_send, *others)

        rig = LockstepRig(setup, whole_ticks=False, controller=Noting)
        rig.run(
            Blocks(setup.trajectory, setup.bus.period_us, setup.ticks, lambda b: rows.append(b.copy()), lambda *_: 0)
        )
        self.config, self.calls, self.memory = rig.controller.record, rig.controller.calls, rig.controller.exchange
        self.rows = np.concatenate(rows)
        sampled = setup.trajectory.sample(0, setup.ticks + PREVIEW_ROWS, setup.bus.period_us)
        self.reference = reference_rows(sampled)


def frames_of(board):
    """Those that the last call would send."""
    driver = board.memory["driver"][0, 0]
    out = [o for o in driver["out"][: driver["outgoing"]] if o["reason"] == 0]
    return [Frame._make((int(o["can_id"]), bytes_of(int(o["data"]), int(o["length"])), int(o["flags"]))) for o in out]


@pytest.fixture(scope="module")
def run():
    setup = load_scenario("raster").setup()
    return Run(dataclasses.replace(setup, duration_s=TICKS * setup.bus.period_s))


def test_the_calls_alone_give_the_frames_and_rows_of_the_run(run):
    board, sent, rows = Board(run.config, run.reference), [], []
    for call in run.calls:
        board.play(call)
        if call["kind"] == Call.PERIOD:
            rows.append(board.row.copy())
        elif call["kind"] not in (Call.COME_UP, Call.PREPARE):
            sent += frames_of(board)
    truth = ("position_m", "stroke_m", "comb_voltage_v")
    seen = run.rows.copy()
    for name in truth:
        seen[name] = 0.0
    assert np.array_equal(canonical(np.concatenate(rows)), canonical(seen))
    assert sent == run.sent
    assert len(sent) > 2 * TICKS


def test_calls_of_a_run_that_breaks_and_is_cleared_give_its_frames_as_well():
    setup = load_scenario("faults").setup()
    fault = Fault(target="node", kind="reset", at_s=0.1, duration_s=None)
    run = Run(dataclasses.replace(setup, duration_s=0.3, faults=(fault,), clear_s=0.02))
    board, sent, modes = Board(run.config, run.reference), [], set()
    for call in run.calls:
        board.play(call)
        modes.add(int(board.memory["cycle"]["mode"][0, 0]))
        if call["kind"] not in (Call.PERIOD, Call.COME_UP, Call.CLEAR, Call.PREPARE):
            sent += frames_of(board)
    assert (run.calls["kind"] == Call.CLEAR).any()
    assert {Mode.FAULT, Mode.BOOT, Mode.PRE_OPERATIONAL, Mode.TRACKING} <= modes
    assert sent == run.sent


def test_the_same_calls_give_the_same_digests_and_others_do_not(run):
    test = self_test(run.config, run.reference, run.calls)
    assert self_test(run.config, run.reference, run.calls).digests == test.digests
    assert len(test.digests) == TICKS // 100 + 1
    other = run.calls.copy()
    at = np.flatnonzero(other["kind"] == Call.BEGIN)[250]
    other["data"][at] ^= 1  # which nobody reads
    assert self_test(run.config, run.reference, other).digests == test.digests
    at += np.flatnonzero(other["can_id"][at:] == run.config["driver"]["sense"][0, 0, 0]["pdo"]["cob_id"][0])[0]
    other["data"][at] ^= 1
    changed = self_test(run.config, run.reference, other)
    assert [a == b for a, b in zip(test.digests, changed.digests, strict=True)] == [True, True, False, False]


def test_frames_are_damaged_and_lost_and_the_second_gate_is_asked_about_everything(run):
    test, board = self_test(run.config, run.reference, run.calls), Board(run.config, run.reference)
    doubtful = Board(run.config, run.reference)
    statuses, tried = [], set()
    for call in damaged(run.config, run.calls):
        board.play(call)
        if call["kind"] == Call.PERIOD:
            statuses.append(int(board.row["sense_status"][0]))
            doubtful.play(test.tried[len(statuses) - 1])
            tried.add(int(doubtful.memory["driver"]["out"]["reason"][0, 0, 0]))
            if len(statuses) % 2 == 0:
                doubtful.clear()
    assert SenseStatus.CRC | SenseStatus.MISSING in statuses
    assert SenseStatus.MISSING in statuses
    assert statuses[:80] == [0] * 80
    assert {0, Reason.UNUSUAL, Reason.IDENTIFIER, Reason.NMT, Reason.SDO_WRITE, Reason.DRIVE_UNKNOWN} <= tried


@pytest.mark.parametrize("law", ["lqg", "robust", "youla"])
def test_what_a_board_does_not_hold_is_neither_read_nor_written(law):
    setup = load_scenario("raster", controller=law).setup()
    run = Run(dataclasses.replace(setup, duration_s=TICKS * setup.bus.period_s))
    held = stored_in_exchange(run.config["law"][0])
    assert sum(held) <= 20 << 10
    assert held.settings < EXCHANGE.itemsize
    assert held.memory < EXCHANGE_MEMORY.itemsize
    config = run.config.copy()
    config.view(np.uint8)[held.settings :] = 0xFF  # as numbers, none
    plain, other = Board(run.config, run.reference), Board(config, run.reference)
    other.memory.view(np.uint8)[held.memory :] = 0xFF
    for call in run.calls:
        assert np.array_equal(plain.play(call), other.play(call))
    assert (other.memory.view(np.uint8)[held.memory :] == 0xFF).all()
    assert plain.held().any()

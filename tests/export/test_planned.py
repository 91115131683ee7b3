"""The predictive law as it is exported: where its problem and its plan stand, and that they are those of lockstep."""

import dataclasses

import numpy as np
import pytest

from hil.lanes.blocks import PREVIEW_ROWS, Blocks
from hil.lanes.lockstep import LockstepRig
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.export import planned
from pkxyz_ctrl.export.calls import Call, RecordedController
from pkxyz_ctrl.export.entries import OF_LOOP, entries_for
from pkxyz_ctrl.export.selftest import Board
from pkxyz_ctrl.export.stored import stored, stored_in_exchange
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.exchange import EXCHANGE, EXCHANGE_MEMORY
from pkxyz_ctrl.loop.predictive_problem import Problem
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.trajectory import Hold, Steps, Trajectory

JUMP = [Hold(kind="hold", duration_s=0.02), Steps(kind="steps", by_m=(0.0, 0.0, 20e-6), count=1, dwell_s=0.03)]


@pytest.mark.parametrize(
    ("larger", "record"),
    [
        (planned.PLANNED_LAW, cycling.LAW), (planned.PLANNED_MEMORY, cycling.MEMORY),
        (planned.PLANNED_EXCHANGE, EXCHANGE), (planned.PLANNED_EXCHANGE_MEMORY, EXCHANGE_MEMORY),
    ],
)  # fmt: skip
def test_what_a_planner_has_besides_stands_right_behind_what_every_law_has(larger, record):
    """So C may take one for the other, and the cycle's records for the ends of the exchange's."""
    own, (_, at, *_) = larger.fields.values()
    assert own[0].base == record
    assert own[1] == 0
    assert at == record.itemsize
    assert max(offset + kind.itemsize for kind, offset, *_ in record.fields.values()) == record.itemsize


def test_on_a_board_no_other_law_has_its_kernels_and_the_loop_in_c_has_them_for_any():
    assert not {entry.kernel for entry in entries_for(has_loop=False)} & {planned.cycle, planned.period}
    of_loop = entries_for(has_loop=True)
    assert of_loop == (*entries_for(has_loop=False, is_planned=True), *OF_LOOP)
    for entry in of_loop:
        is_its_own = entry.kernel in (planned.cycle, planned.period)
        assert is_its_own == (entry.name in ("pkxyz_cycle", "pkxyz_period"))
        assert any(argument.whole is not None for argument in entry.arguments) == is_its_own


def setup():
    raster = load_scenario("raster", controller="mpc").setup()
    return dataclasses.replace(raster, trajectory=Trajectory(JUMP), duration_s=0.2)


def test_a_horizon_holds_no_more_than_it_needs():
    law = setup().law.copy()
    short, law["tick"]["predictive"]["horizon"] = stored(law), 20
    full = planned.PLANNED_LAW.itemsize, planned.PLANNED_MEMORY.itemsize
    assert all(0.2 * most < held < 0.8 * most for held, most in zip(short, full, strict=True))
    assert all(0.9 * most < held <= most for held, most in zip(stored(law), full, strict=True))


def test_every_number_of_the_problem_is_held():
    config = np.zeros(1, EXCHANGE)
    config["law"][0] = setup().law
    words = planned.whole(config).view(np.uint64)
    held = stored_in_exchange(config["law"][0]).settings // 8
    assert words[held - 2 : held].any()
    assert not words[held:].any()
    assert planned.whole(planned.whole(config)).view(np.uint64).tolist() == words.tolist()
    assert (planned.whole(config)["problem"][0] == Problem(config["law"][0]).record()).all()


def test_an_exchange_in_which_it_solves_is_gone_through_again_with_the_same_bits():
    run, rows = setup(), []
    rig = LockstepRig(run, whole_ticks=False, controller=RecordedController)
    rig.run(Blocks(run.trajectory, run.bus.period_us, run.ticks, lambda b: rows.append(b.copy()), lambda *_: 0))
    recorded = np.concatenate(rows)
    assert (recorded["solver_iterations"] > 0).sum() > 20
    reference = reference_rows(run.trajectory.sample(0, run.ticks + PREVIEW_ROWS, run.bus.period_us))
    board, ticks = Board(rig.controller.record, reference), 0
    for call in rig.controller.calls:
        board.play(call)
        if call["kind"] == Call.PERIOD:
            for name in ("force_n", "drive_count", "solver_iterations", "mode"):
                assert (board.row[name][0] == recorded[name][ticks]).all()
            ticks += 1
    assert ticks == run.ticks
    held = board.held()  # which raises where more was used
    assert np.count_nonzero(held[EXCHANGE_MEMORY.itemsize // 8 :]) > 1000

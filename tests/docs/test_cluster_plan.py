"""The plan past one machine follows from what was measured on one."""

import cluster_plan
import pytest

from hil.studies.wafer.closed_loop import PART_DEVICES, PARTS_TOGETHER


def test_a_plan_by_hand():
    plan = cluster_plan.Plan(
        1e9, 3600.0, device_s=12e-3, piece_s=4e-3, worker_bytes=300e6, sent_bytes=60e3, back_bytes=40e3
    )
    assert plan.cores == 3334
    assert plan.memory_bytes == pytest.approx(1.0002e12)
    assert plan.fed == 768
    assert plan.schedulers == 5
    assert plan.carried_bytes_per_s == pytest.approx(1e9 / 256 * 100e3 / 3600)


def test_pieces_are_those_of_the_yield():
    assert cluster_plan.DEVICES_A_PIECE == PART_DEVICES * PARTS_TOGETHER


def test_the_table_is_of_the_measured_figures():
    plan = cluster_plan.planned(1e9, 3600.0)
    assert plan.cores * 3600.0 >= 1e9 * plan.device_s > (plan.cores - 1) * 3600.0
    assert plan.schedulers * plan.fed >= plan.cores
    assert any(f"{plan.device_s * 1e3:.1f} ms of a core" in row for row in cluster_plan.rows())
    assert any(f"{plan.cores} cores" in cell for row in cluster_plan.rows() for cell in row)
    assert any(f"{plan.sent_bytes * 1e-3:.0f} kB to a worker" in cell for row in cluster_plan.rows() for cell in row)


def test_a_million_devices_in_one_run_took_little_more_than_was_calculated():
    """The plan has the devices alone; the run compiles, draws them, writes files, and at its end one core waits."""
    taken_s = cluster_plan.million_s()
    assert 1.0 < 2.0 * taken_s / cluster_plan.planned(1e6, 3600.0).core_s < 1.3
    core_hours = f"{taken_s / 60.0:.0f} minutes: {2.0 * taken_s / 3600.0:.1f} core-hours"
    assert any(core_hours in cell for row in cluster_plan.rows() for cell in row)

"""Causes in a closed loop: by the same pick of devices as without one, kept and continued part by part."""

from dataclasses import replace

import numpy as np
import pytest
from process_rig import SHIPPED, STAGE, process

from hil.bench.study import short_scan
from hil.studies.wafer.causes import PLACE, causes_of, independent, indices, mixed
from hil.studies.wafer.closed_loop import PART_DEVICES, ClosedLoops
from hil.studies.wafer.loop_causes import LoopCauses
from hil.studies.wafer.study import WaferStudy, run_study
from hil.studies.wafer.table import Table
from pkxyz_ctrl.fabrication.process import Spread


def asked(of, known=False):
    return LoopCauses(ClosedLoops(WaferStudy(of, STAGE, 1), short_scan(), known))


def two_causes():
    """Sense combs that are off, which the error goes with, and hinges, which it does not."""
    return process(comb_gap_m=Spread(wafer=0.05e-6), hinge_m=Spread(wafer=0.2e-6))


def test_the_error_under_the_shipped_law_is_the_sense_combs_and_its_ms_the_springs(tmp_path):
    causes = asked(two_causes())
    table = Table(tmp_path, causes.digest())
    assert causes.found(table) is None
    run_study(causes, causes.parts_for(64), table, 1)
    found = causes.found(table)
    assert found.names == (PLACE, "comb_gap_m", "hinge_m")
    assert found.figures == (*causes.loops.columns, "ok.shipped")
    place, combs, hinges = (dict(zip(found.figures, row, strict=True)) for row in found.total)
    error = dict(zip(found.figures, found.error[1], strict=True))
    assert (place["shipped.error_nm"], hinges["shipped.error_nm"]) == pytest.approx((0.0, 0.0), abs=0.02)
    assert abs(combs["shipped.error_nm"] - 1.0) < 4.0 * error["shipped.error_nm"]
    assert hinges["shipped.peak_s"] > 0.1
    assert min(combs["shipped.rejection_hz"], hinges["shipped.rejection_hz"]) > 0.0
    assert found.total[:, -1].tolist() == [0.0, 0.0, 0.0]  # all of them work


def test_it_is_what_all_its_devices_say_and_goes_on_where_it_stopped(tmp_path):
    """Two blocks, of which the second is there in part only; then whole."""
    causes = asked(two_causes(), known=True)
    table = Table(tmp_path, causes.digest())
    run_study(causes, causes.parts_for(PART_DEVICES) + 2, table, 1)
    assert (causes.parts_for(1), causes.parts_for(PART_DEVICES + 1)) == (5, 10)
    study = causes.loops.wafers
    a, b = (independent(study, first, PART_DEVICES) for first in (0, 1 << 30))
    sets = [a, b, *(mixed(a, b, name) for name in causes_of(study))]
    each = np.stack([
        [causes.loops.judged(of)[name].astype(float) for name in causes.figures] for of in sets
    ])  # fmt: skip
    by_hand = indices(causes.names, causes.figures, each[0], each[1], each[2:])
    assert np.array_equal(causes.found(table).total, by_hand.total)
    assert np.array_equal(causes.found(table).error, by_hand.error)
    run_study(causes, causes.parts_for(2 * PART_DEVICES), table, 1)
    assert not np.array_equal(causes.found(Table(tmp_path, causes.digest())).total, by_hand.total)


def test_a_loop_that_ended_in_a_fault_counts_as_the_worst_that_did_not(monkeypatch, tmp_path):
    causes, judged = asked(two_causes()), ClosedLoops.judged

    def one_faults(self, sampled):
        found = judged(self, sampled)
        found["shipped.error_nm"][3] = np.inf
        return found

    monkeypatch.setattr(ClosedLoops, "judged", one_faults)
    table = Table(tmp_path, causes.digest())
    run_study(causes, causes.parts_for(1), table, 1)
    assert np.isfinite(causes.found(table).total).all()


def test_its_devices_are_of_no_table_and_its_digest_is_that_of_the_loops():
    causes = asked(SHIPPED)
    assert independent(causes.loops.wafers, 0, 1).device.min() > 1 << 32
    others = [asked(SHIPPED, known=True), asked(process()), replace(causes, loops=replace(causes.loops, per_wafer=2))]
    assert len({each.digest() for each in [causes, *others]}) == 4

"""Every fault of the matrix under the default law: noticed in time, by its cause, within limits, and recovered from."""

from functools import cache

import numpy as np
import pytest
from loop_rig import first_difference, rows_of

from hil.faults.catalogue import KINDS
from hil.faults.matrix import CASES, CLEAR_S
from hil.faults.outcome import run_case, setup_for
from pkxyz_ctrl.controller import StartUpError
from pkxyz_ctrl.safety.modes import Mode


@cache
def scan():
    return setup_for("lqg")


def with_faults(text, **changes):
    import dataclasses

    from hil.faults.fault import parse

    run = dataclasses.replace(scan(), faults=tuple(parse(t) for t in text.split()), **changes)
    vars(run)["law"] = scan().law
    return run


def test_without_a_fault_the_scan_is_clean():
    rows, result = rows_of(scan(), "lockstep")
    assert result.faults == ()
    assert result.missed_ticks == 0
    assert rows["mode"][-1] == Mode.TRACKING


@pytest.mark.parametrize("case", CASES, ids=[case.text for case in CASES])
def test_every_fault_is_noticed_in_time_and_the_stage_is_saved(case):
    outcome = run_case("lqg", scan(), case)
    assert outcome.problems == ()
    if outcome.ticks is None:
        assert case.note  # whoever is not noticed has a reason
    else:
        assert outcome.ticks >= 0
        assert case.within_ticks == 5 or case.within_ticks < 5 or case.note
    # two-sided: the voltages of this scan are known
    assert 135.0 < outcome.voltage_max_v < 175.0
    assert 0.05 < outcome.slew_max_v <= 20.0
    assert outcome.excursion_um < 20.0


def test_the_matrix_has_every_kind_of_fault():
    had = {(case.fault.family, case.fault.kind) for case in CASES}
    assert had == {(family, kind) for family, kinds in KINDS.items() for kind in kinds}


def test_same_seed_same_bits_with_faults():
    text = (
        "sense.2:noise_burst@0.1+0.0004,sigma_m=1e-7 bus.sense:drop@0.15+0.02,probability=0.1 "
        "plant:shock@0.2+0.0002,force_n=1e-4"
    )
    once, first = rows_of(with_faults(text), "lockstep")
    again, second = rows_of(with_faults(text), "lockstep")
    assert first_difference(once, again) is None
    assert first.faults == second.faults
    whole, _ = rows_of(scan(), "lockstep")
    assert first_difference(once, whole) is not None


def test_without_a_clear_a_fault_stays_although_its_cause_is_gone():
    rows, result = rows_of(with_faults("node:silent@0.2+0.01"), "lockstep")
    decided = int(np.flatnonzero(rows["mode"] == Mode.FAULT)[0])
    assert 1000 <= decided <= 1005
    assert (rows["mode"][decided:] == Mode.FAULT).all()
    assert not rows["drive_count"][decided:].any()
    assert len(result.faults) == 1


def test_a_clear_brings_it_back_and_time_goes_on_meanwhile():
    rows, _ = rows_of(with_faults("node:reset@0.2+0.01", clear_s=CLEAR_S), "lockstep")
    assert np.array_equal(rows["tick"], np.arange(len(rows)))
    modes = rows["mode"][np.r_[True, np.diff(rows["mode"]) != 0]].tolist()
    start = [Mode.HOMING, Mode.IDLE, Mode.ENABLED, Mode.TRACKING]
    assert modes == [*start, Mode.FAULT, Mode.BOOT, Mode.PRE_OPERATIONAL, Mode.IDLE, *start]


def test_another_device_in_its_place_is_not_even_started():
    with pytest.raises(StartUpError, match=r"0x1018:0?2|product"):
        rows_of(with_faults("node:wrong_identity@0"), "lockstep")


def test_a_device_that_was_exchanged_meanwhile_is_refused_at_every_clear_and_time_goes_on():
    rows, result = rows_of(with_faults("node:wrong_identity@0.2", clear_s=CLEAR_S), "lockstep")
    assert rows["mode"][-1] == Mode.BOOT
    assert len(result.faults) >= 3  # the decision, and a start-up that was refused after each clear
    assert all("start-up after a clear" in words for words in result.faults[1:])
    decided = int(np.flatnonzero(rows["mode"] == Mode.FAULT)[0])
    assert not rows["drive_count"][decided:].any()
    assert len(rows) == scan().ticks


def test_a_controller_that_is_killed_leaves_0_v_at_the_node_within_its_heartbeat_time():
    outcome = run_case("lqg", scan(), next(case for case in CASES if case.text == "controller:killed"))
    assert outcome.zero_ms is not None
    assert 25.0 < outcome.zero_ms <= 51.0  # the node waits 50 ms from the last heartbeat, which comes every 20 ms


@pytest.mark.parametrize("protection", [True, False])
def test_a_single_late_sense_frame_shifts_none_behind_it(protection):
    """One frame 70 us late, which is after its tick gave up: that tick has none, every other has its own sample."""
    import dataclasses

    late = with_faults("bus.sense:delay@0.2+0.0002,delay_us=70")
    driver = late.bus.can.driver.model_copy(update={"protection": protection})
    changed = late.bus.model_copy(update={"can": late.bus.can.model_copy(update={"driver": driver})})
    run = dataclasses.replace(late, bus=changed)
    rows, result = rows_of(run, "lockstep")
    assert result.faults == ()
    missing = np.flatnonzero(rows["sense_status"][10:] & 1) + 10
    assert len(missing) == 1
    after = rows[missing[0] + 1 : missing[0] + 200]
    apart = np.abs(after["measurement_m"] - after["position_m"]).max()
    assert apart < 30e-9  # noise; a sample of the tick before would be off by 100 nm in a scan of 0.5 mm/s
    assert np.abs(np.diff(after["position_m"], axis=0)).max() > 60e-9

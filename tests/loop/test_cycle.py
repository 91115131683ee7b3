"""One controller period after another, by script: start, homing, lost frames, faults, holds, and the ends of blocks."""

import dataclasses

import numpy as np
import pytest
from cycle_rig import AT_REST, HOMING_TICKS, enabled, homed, in_the_middle, noisy
from loop_rig import MIDDLE, Cycle, bus, counts_at, law, rows_of, setup, stage

from hil.runs.metrics import Metrics
from pkxyz_ctrl.core.adaptation import ROOM
from pkxyz_ctrl.loop.cycle import new_memory
from pkxyz_ctrl.safety.modes import Event, Mode
from pkxyz_ctrl.safety.monitors import NodeEvent, SenseStatus
from pkxyz_ctrl.safety.trips import Trip


def test_the_automatic_start_tick_by_tick():
    c = Cycle(law(), np.zeros((16, 9)))
    rows = [c.tick(noisy(AT_REST, k)) for k in range(HOMING_TICKS + 10)]
    modes = [Mode(int(r["mode"])) for r in rows]
    n = HOMING_TICKS
    assert modes == [Mode.HOMING] * (n - 1) + [Mode.IDLE, Mode.ENABLED] + [Mode.TRACKING] * 9
    events = {k: Event(int(r["event"])) for k, r in enumerate(rows) if r["event"]}
    assert events == {0: Event.HOME, n - 1: Event.HOMED, n: Event.ENABLE, n + 1: Event.TRACK}
    assert [int(r["tick"]) for r in rows] == list(range(n + 10))
    assert [int(r["t_us"]) for r in rows] == [200 * k for k in range(n + 10)]
    assert [int(r["reference_tick"]) for r in rows] == [-1] * (n + 1) + list(range(9))
    assert not any(r["trips"] for r in rows)
    assert not any(r["drive_count"].any() for r in rows[: n - 1])  # 0 V while homing


def test_rows_that_every_tick_goes_through_begin_with_a_line_of_the_cache():
    """Wherever the memory lies: a vector in two lines takes as long as two."""
    kept = [new_memory(Mode.IDLE) for _ in range(50)]
    for memory in kept:
        learnt = memory["tick"]["adaptation"]
        rows = [learnt[name] for name in learnt.dtype.names if learnt[name].shape[-1] == ROOM]
        assert len(rows) == 8
        assert [row.ctypes.data % 64 for row in rows] == [0] * 8
        assert memory["mode"] == Mode.IDLE
        assert not memory["tick"].tobytes().strip(b"\0")


def test_homing_finds_the_offsets_and_takes_them_away():
    """A few fF off on each channel, in noise: found to a hundredth of a count, and from then on the strokes are 0."""
    offset_counts = np.array([30, -22, 41])
    c = Cycle(law(autostart=False))
    for k in range(HOMING_TICKS):
        row = c.tick(noisy(AT_REST + offset_counts, k), event=Event.HOME if k == 0 else Event.NONE)
    assert c.mode is Mode.IDLE
    analog = bus().analog
    exact = analog.sense_offset_f + (AT_REST + offset_counts) * analog.sense_farad_per_count - stage().sense_rest_f
    found = c.memory["tick"]["sense_zero_f"][0]
    assert found == pytest.approx(exact, rel=0, abs=0.01 * analog.sense_farad_per_count)
    assert np.abs(row["measurement_m"]).max() < 4e-9  # of this one noisy sample: 3 counts of 0.53 nm, through J^-1
    assert np.abs(row["estimate_m"]).max() < 4e-9
    row = c.tick(AT_REST + offset_counts)
    assert np.abs(row["measurement_m"]).max() < 0.02e-9


def test_homing_averages_only_frames_that_came():
    c = Cycle(law(autostart=False))
    ticks, wild = 0, np.array([30_000, -30_000, 30_000])
    c.tick(noisy(AT_REST, 0), event=Event.HOME)
    while c.mode is Mode.HOMING:
        ticks += 1
        missing = ticks % 100 == 50
        c.tick(wild if missing else noisy(AT_REST, ticks), status=SenseStatus.MISSING if missing else 0)
    assert ticks == HOMING_TICKS - 1 + 3  # the three that were missing are made up for
    assert np.abs(c.memory["tick"]["sense_zero_f"]).max() < 0.51 * bus().analog.sense_farad_per_count


def test_homing_again_starts_from_nothing():
    """The old offset is not in the strokes that the monitors see meanwhile, nor in the new one."""
    c, analog = homed(), bus().analog
    c.memory["tick"]["sense_zero_f"] = 1e-12
    for k in range(HOMING_TICKS):
        row = c.tick(noisy(AT_REST + 100, k), event=Event.HOME if k == 0 else Event.NONE)
        if c.mode is Mode.HOMING:
            raw_f = analog.sense_offset_f + row["sense_count"] * analog.sense_farad_per_count
            assert row["sense_f"] == pytest.approx(raw_f, rel=1e-12)
    zero = c.memory["tick"]["sense_zero_f"][0] / bus().analog.sense_farad_per_count
    assert zero == pytest.approx(np.full(3, 100.0), abs=0.51)


def test_nobody_enables_after_a_homing_that_was_broken_off():
    """HOME, HOMED, HOME, DISABLE, ENABLE closed the loop with offsets of zero."""
    c = Cycle(law(autostart=False))
    for k in range(HOMING_TICKS):
        c.tick(noisy(AT_REST + 100, k), event=Event.HOME if k == 0 else Event.NONE)
    assert c.memory["tick"]["sense_zero_f"].all()
    c.tick(noisy(AT_REST + 100, 0), event=Event.HOME)
    assert not c.memory["tick"]["sense_zero_f"].any()
    c.tick(noisy(AT_REST + 100, 1), event=Event.DISABLE)
    for k in range(20):
        row = c.tick(noisy(AT_REST + 100, k), event=Event.ENABLE)
        assert c.mode is Mode.IDLE
        assert row["event"] == Event.ENABLE_UNHOMED
    for k in range(HOMING_TICKS):
        c.tick(noisy(AT_REST + 100, k), event=Event.HOME if k == 0 else Event.NONE)
    c.tick(noisy(AT_REST + 100, 0), event=Event.ENABLE)
    assert c.mode is Mode.ENABLED


def test_nobody_enables_before_homing():
    c = Cycle(law(autostart=False))
    for k in range(5):
        row = c.tick(noisy(AT_REST, k), event=Event.ENABLE)
        assert c.mode is Mode.IDLE
        assert row["event"] == Event.ENABLE_UNHOMED
        assert not row["drive_count"].any()


@pytest.mark.parametrize("mode", [Mode.BOOT, Mode.PRE_OPERATIONAL, Mode.FAULT])
def test_the_estimate_rests_where_no_node_is_expected(mode):
    """Frames that are anything leave no trace: what ran away with them would outlive the clear."""
    c = Cycle(law(autostart=False), mode=mode)
    for k in range(200):
        row = c.tick(AT_REST + np.array([9000, -4000, 15_000]) * (-1) ** k)
    assert c.mode is mode
    at_rest = Cycle(law(autostart=False), mode=mode)
    resting = at_rest.tick(AT_REST + np.array([9000, -4000, 15_000]) * (-1) ** 199)
    for field in ("estimate_m", "estimate_m_per_s", "disturbance_n"):
        assert np.array_equal(row[field], resting[field]), field


def test_a_missing_frame_is_bridged_by_the_prediction():
    """Up to four in a row: no innovation, the filter follows its own prediction, the loop stays closed."""
    c = enabled()
    for k in range(4):
        predicted = c.memory["tick"]["estimate"]["predicted"][0].copy()
        measured = c.memory["tick"]["measurement_m"][0].copy()
        row = c.tick((0, 0, 0), status=SenseStatus.MISSING)
        origin = c.law["tick"]["estimator"]["operating_point_m"][0]
        assert np.array_equal(row["estimate_m"], origin + predicted[:3]), k
        assert np.array_equal(row["measurement_m"], measured)
        assert not row["innovation_m"].any()
        assert c.mode is Mode.ENABLED
        assert row["trips"] == 0
    row = c.tick(noisy(AT_REST, 9))
    assert c.mode is Mode.ENABLED
    assert row["innovation_m"].any()
    c.memory["monitors"]["sequence_level"] = 0  # which counts them all
    for _ in range(4):  # the good one between them starts the count anew
        c.tick((0, 0, 0), status=SenseStatus.MISSING)
        assert c.mode is Mode.ENABLED


@pytest.mark.parametrize("status", [SenseStatus.MISSING, SenseStatus.CRC | SenseStatus.MISSING, SenseStatus.DUPLICATE])
def test_the_fifth_stale_frame_is_a_fault_with_0_v_in_that_tick(status):
    c = in_the_middle()
    rows = [c.tick((1, 2, 3), status=int(status)) for _ in range(6)]
    assert all(r["mode"] == Mode.TRACKING and (r["drive_count"] > 20_000).all() for r in rows[:4])
    assert rows[4]["mode"] == rows[5]["mode"] == Mode.FAULT
    assert rows[4]["trips"] & Trip.SENSE_STALE
    assert rows[4]["event"] == Event.TRIP
    for row in rows[4:]:
        assert not row["drive_count"].any()
        assert not any(row[name].any() for name in ("voltage_v", "force_n", "demand_n", "slack_n"))


@pytest.mark.parametrize("mode", [Mode.IDLE, Mode.ENABLED, Mode.TRACKING])
@pytest.mark.parametrize("trip", [Trip.GATE_BLOCKED, Trip.GATE_BLOCKED | Trip.OPERATOR, Trip.COMB_FORCE_2])
def test_a_trip_from_outside_acts_in_that_tick(mode, trip):
    c = {Mode.IDLE: homed, Mode.ENABLED: enabled, Mode.TRACKING: in_the_middle}[mode]()
    assert c.mode is mode
    row = c.tick(noisy(AT_REST if mode is not Mode.TRACKING else counts_at(MIDDLE), 1), trips=int(trip))
    assert row["mode"] == Mode.FAULT
    assert row["trips"] == trip
    assert not row["drive_count"].any()
    row = c.tick(noisy(AT_REST, 2))  # latched, and told once
    assert row["mode"] == Mode.FAULT
    assert row["trips"] == 0
    assert row["event"] == Event.NONE


@pytest.mark.parametrize("event", [e for e in Event if e not in (Event.CLEAR, Event.NONE)])
def test_a_fault_stays_whatever_is_asked(event):
    c = in_the_middle()
    c.tick(noisy(AT_REST, 0), trips=int(Trip.GATE_BLOCKED))
    row = c.tick(noisy(AT_REST, 1), event=event)
    assert row["mode"] == Mode.FAULT
    assert not row["drive_count"].any()


def test_clear_begins_again_and_forgets_the_offsets():
    c = homed(autostart=True)
    c.tick(noisy(AT_REST, 0), trips=int(Trip.GATE_BLOCKED))
    assert c.tick(noisy(AT_REST, 1), event=Event.CLEAR)["mode"] == Mode.BOOT
    assert not c.memory["homed"][0]
    for k in range(3):  # the automatic start waits for the node
        assert c.tick(noisy(AT_REST, k))["mode"] == Mode.BOOT
    assert c.tick(noisy(AT_REST, 2), event=Event.NODE_FOUND)["mode"] == Mode.PRE_OPERATIONAL
    assert c.tick(noisy(AT_REST, 3), event=Event.NODE_READY)["mode"] == Mode.IDLE
    assert c.tick(noisy(AT_REST, 4))["mode"] == Mode.HOMING


def test_node_events_and_numbers_that_are_none():
    for event, trip in (
        (NodeEvent.HEARTBEAT_LOST, Trip.HEARTBEAT_LOST),
        (NodeEvent.EMERGENCY, Trip.NODE_EMERGENCY),
        (NodeEvent.REBOOTED, Trip.NODE_REBOOTED),
    ):
        row = enabled().tick(noisy(AT_REST, 3), node_events=int(event))
        assert row["mode"] == Mode.FAULT
        assert row["trips"] == trip
    c = in_the_middle()
    c.reference["motion"] = np.nan
    row = c.tick(noisy(counts_at(MIDDLE), 1))
    assert row["mode"] == Mode.FAULT
    assert row["trips"] & Trip.NOT_FINITE
    assert not row["drive_count"].any()


def test_a_stage_that_is_not_where_it_should_be_trips_on_innovation():
    """Three samples in which all strokes jump by 2 um: none is believed, and the third is a fault along z."""
    c = in_the_middle()
    for k in range(2):  # back and forth, which no disturbance explains
        row = c.tick(noisy(counts_at(MIDDLE + (2e-6 if k % 2 else -2e-6)), k))
        assert row["mode"] == Mode.TRACKING
        assert row["sense_status"] == SenseStatus.IMPLAUSIBLE
        assert abs(row["innovation_m"][2]) > 2e-6
    row = c.tick(noisy(counts_at(MIDDLE - 2e-6), 5))
    assert row["mode"] == Mode.FAULT
    assert row["trips"] == Trip.INNOVATION_Z


@pytest.mark.parametrize("comb", [0, 1, 2])
def test_a_wild_sample_of_one_comb_reaches_no_voltage_and_too_many_name_the_comb(comb):
    """Against the same ticks with a lost frame in place of the wild sample: bit for bit the same voltages."""
    wild, without = in_the_middle(), in_the_middle()
    strokes = MIDDLE.copy()
    strokes[comb] += 4e-6
    for k in range(6):
        good = noisy(counts_at(MIDDLE), k)
        bad = k in (1, 4)
        row = wild.tick(counts_at(strokes) if bad else good)
        other = without.tick(good, status=int(SenseStatus.MISSING) if bad else 0)
        assert np.array_equal(row["drive_count"], other["drive_count"])
        assert np.array_equal(row["estimate_m"], other["estimate_m"])
        assert row["sense_status"] == (SenseStatus.IMPLAUSIBLE if bad else 0)
        assert row["mode"] == Mode.TRACKING
    assert wild.tick(counts_at(strokes))["mode"] == Mode.TRACKING  # good ticks between them took a little away
    row = wild.tick(counts_at(strokes))
    assert row["mode"] == Mode.FAULT
    assert row["trips"] == Trip.COMB_MISFIT_1 << comb
    assert not row["drive_count"].any()


def test_a_fault_is_cleared_only_on_request_and_after_safe_cycles():
    c = in_the_middle()
    row = c.tick(noisy(counts_at(MIDDLE), 1), trips=int(Trip.GATE_BLOCKED))
    for k in range(60):
        row = c.tick(noisy(AT_REST, k))
        assert row["mode"] == Mode.FAULT
    row = c.tick(noisy(AT_REST, 1), event=Event.CLEAR)
    assert (row["event"], row["mode"]) == (Event.CLEAR, Mode.BOOT)
    again = in_the_middle()
    again.tick(noisy(counts_at(MIDDLE), 1), trips=int(Trip.GATE_BLOCKED))
    for k in range(9):  # the tick of the fault was the first at 0 V
        row = again.tick(noisy(AT_REST, k), event=Event.CLEAR)
        assert (row["event"], row["mode"]) == (Event.CLEAR_UNSETTLED, Mode.FAULT)
    assert again.tick(noisy(AT_REST, 1), event=Event.CLEAR)["mode"] == Mode.BOOT


def test_disable_leads_down_and_opens_the_loop_and_enable_begins_at_rest():
    c = in_the_middle()
    for k in range(25):  # 5 ms
        row = c.tick(noisy(counts_at(MIDDLE), k), event=Event.DISABLE if k == 0 else Event.NONE)
        assert c.mode is Mode.LANDING
    row = c.tick(noisy(AT_REST, 1))
    assert c.mode is Mode.IDLE
    assert not row["drive_count"].any()
    assert row["trips"] == 0
    for k in range(12):  # an operator who asks at every tick: refused until the combs were at 0 V for 10 good ones
        row = c.tick(noisy(AT_REST, k), event=Event.ENABLE, status=int(SenseStatus.MISSING) if k == 0 else 0)
        assert row["event"] == (Event.ENABLE_UNSETTLED if k < 11 else Event.ENABLE)
    assert c.mode is Mode.ENABLED
    assert not row["reference_m"].any()  # the set-point is rest, not where it was
    c.tick(noisy(AT_REST, 2), event=Event.TRACK)
    assert c.memory["reference_tick"][0] == 1  # and the trajectory starts anew


def test_voltages_never_change_faster_than_the_slew_limit_but_for_a_release():
    """A reference that jumps by 12 um asks for everything at once and gets 20 V a tick; a fault gets 160 V at once."""
    c = in_the_middle()
    c.reference["motion"][:, 2] -= 12e-6
    last, steps = c.memory["tick"]["count"][0, 0].copy(), []
    for k in range(4):
        row = c.tick(noisy(counts_at(MIDDLE), k + 1))
        steps.append(np.abs(row["drive_count"] - last).max())
        last = row["drive_count"].copy()
        assert row["saturated"] == (np.abs(row["slack_n"]).max() > 1e-9)
    slew = c.law["tick"]["drive"]["count_slew_max"][0]
    assert slew == int(20 / (200 / 32767))
    assert steps[0] == max(steps) == slew
    assert not c.tick(noisy(counts_at(MIDDLE), 9), trips=int(Trip.GATE_BLOCKED))["drive_count"].any()
    assert last.min() > 14_000


def test_an_event_and_a_trip_are_taken_once():
    c = homed()
    c.tick(noisy(AT_REST, 0), event=Event.ENABLE)
    assert c.memory["input"]["event"][0] == Event.NONE
    c.tick(noisy(AT_REST, 1), trips=int(Trip.GATE_BLOCKED))
    assert c.memory["input"]["trips"][0] == 0


def test_two_periods_of_delay_in_closed_loop():
    """The same scan on the same plant with a law that knows of the second period: as good as with one."""
    slow = dataclasses.replace(setup(), bus=bus("fd_5k", 2))
    rows, result = rows_of(slow, "fast")
    assert result.faults == ()
    metrics = Metrics(slow.trajectory, slow.bus.period_us)
    metrics.update(rows)
    figures = metrics.figures()
    assert figures.saturated_ticks == 0
    assert all(0.2 < v < 2.0 for v in figures.rms_error_nm.values())
    assert all(0.2 < v < 2.0 for v in figures.hold_noise_nm.values())
    # counts of a tick reach the combs two ticks later, through an amplifier that is there within a period
    live = np.flatnonzero(rows["mode"] == Mode.TRACKING)[1000:-4]
    assert np.abs(rows["comb_voltage_v"][live + 3] - rows["voltage_v"][live]).max() < 1e-6
    assert np.abs(rows["comb_voltage_v"][live + 2] - rows["voltage_v"][live]).max() > 1e-3

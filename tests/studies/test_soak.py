"""Five seconds of what `pkxyz soak` does for half an hour, and what it says of a run a little beyond a bound."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from hil.bus.endpoint import Endpoint
from hil.faults.catalogue import KINDS
from hil.faults.fault import parse
from hil.faults.injection import Injection
from hil.lanes.lockstep import LockstepRig
from hil.node.amplifier import AmplifierNode
from hil.node.drive import DriveReceiver
from hil.recording.recording import Recording
from hil.runs.scenario import load_scenario
from hil.studies.faults.matrix import CASES
from hil.studies.faults.outcome import RISE_V
from hil.studies.soak import AFTER_US, Soaked, _judge, _Voltages, random_faults, soak, soaked_scenario
from hil.studies.soaks import decisions_in_words, totals
from hil.whole_ticks.stretches import Stretches
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode


@pytest.fixture(scope="module")
def soaked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("soak")
    return soak(5.0, 3, soaked_scenario("lqg"), folder, keep=True, rows_each=8192), folder


def test_nothing_is_lost_and_nothing_breaks(soaked):
    found, folder = soaked
    assert found.problems == []
    assert found.ticks == found.recorded_ticks == 25_000
    assert found.faults >= 8
    assert found.decisions >= 4
    assert found.returns >= 4
    assert sum(found.reasons.values()) >= found.decisions
    assert 135.0 < found.voltage_max_v < 145.0  # the scan's own voltages, as without a fault
    assert 0.9 < found.slew_max_v < 5.0
    assert found.rise_max_v < RISE_V
    assert 1 <= found.zero_ticks <= 106  # 20 ms where no frame reaches the node
    assert found.unprovoked == 0
    assert 0 <= found.latest_us < AFTER_US
    assert sum(found.faults_by_case.values()) == found.faults
    assert set(found.faults_by_case) <= {case.text.replace("0.2e-6", "2e-07") for case in CASES}
    assert found.decisions - found.misled >= found.faults - sum(found.undecided.values())
    parts = sorted(folder.glob("*.parquet"))
    assert len(parts) == len(found.memory_mb) == 3
    for total, each in (
        (found.faults, found.faults_each),
        (found.decisions, found.decisions_each),
        (found.returns, found.returns_each),
    ):
        assert len(each) == 3
        assert sum(each) == total
    ticks = np.concatenate([Recording.open(part)["tick"] for part in parts])
    assert np.array_equal(ticks, np.arange(25_000))


def test_a_reference_that_begins_anew_begins_at_its_beginning(soaked):
    """A block of rows reaches 0.8 s ahead, and not back: where a fault is cleared in its middle, it ends there."""
    _, folder = soaked
    trajectory = load_scenario("faults").trajectory
    anew = 0
    for part in sorted(folder.glob("*.parquet")):
        recording = Recording.open(part)
        index, reference = recording["reference_tick"], recording.vector("reference_m")
        tracking = np.flatnonzero(index >= 0)
        anew += int(np.count_nonzero(index[tracking] == 0))
        rows = trajectory.sample(0, int(index.max()) + 1, 200)[index[tracking], 0:3]
        assert np.array_equal(reference[tracking], rows)
    assert anew >= 4


def test_time_is_that_of_the_ticks_whatever_failed(soaked):
    _, folder = soaked
    t_us = np.concatenate([Recording.open(part)["t_us"] for part in sorted(folder.glob("*.parquet"))])
    assert np.array_equal(np.diff(t_us), np.full(24_999, 200))


def test_faults_are_those_of_the_seed_and_of_every_family():
    faults = random_faults(600.0, 1)
    assert [str(f) for f in faults] == [str(f) for f in random_faults(600.0, 1)]
    assert [str(f) for f in faults] != [str(f) for f in random_faults(600.0, 2)]
    assert {f.family for f in faults} == set(KINDS)
    assert all(f.end_us is not None and f.end_us < 600e6 for f in faults)
    assert not any(f.kind == "killed" for f in faults)


@pytest.mark.parametrize("missing", ["nothing", "the controller's part", "the node's part"])
def test_no_voltage_of_before_follows_a_blocked_bus(tmp_path, monkeypatch, missing):
    """Frames that waited while somebody babbled would come after the fault decision: the controller drops them, and the
    node takes none before one with 0 V. Either is enough; without both a comb goes from 0 to 135 V in a tick.
    """
    if missing == "the controller's part":
        monkeypatch.setattr(Endpoint, "flush", lambda self: None)
    if missing == "the node's part":
        monkeypatch.setattr(DriveReceiver, "demand_zero", lambda self: None)
    found = soak(3.2, 1, soaked_scenario("lqg"), tmp_path)
    assert found.decisions >= 3
    assert found.problems == []
    assert 135.0 < found.voltage_max_v < 145.0
    assert 0.9 < found.slew_max_v < 5.0


def steps_now_and_then(self, counts, t_us):
    """25 V too much at comb 1, in one of 500 SYNCs."""
    self.applied = getattr(self, "applied", 0) + 1
    a, b, c = counts
    return applied_as_shipped(self, (a + 4096, b, c) if a and self.applied % 500 == 0 else counts, t_us)


def exceeds(self, counts, t_us):
    a, b, c = counts
    return applied_as_shipped(self, (40_000, b, c) if a > 20_000 else counts, t_us)


def applied_as_shipped(self, counts, t_us):
    self._drive.pending, self._silent_syncs, self.outputs = None, 0, counts
    return counts


def test_a_voltage_that_rises_while_none_is_allowed_is_found(tmp_path, monkeypatch):
    """Channel 1 gains an offset of 0.3 V in FAULT: less than what counts as driven, and three times what may be."""
    shipped = Injection.arm

    def arm_and_lift(self):
        clock, params = shipped(self), self._plant.plant.params
        self._clock.call_at(self.origin_us + 400_000, lambda: params["amplifier_offset_v"].__setitem__((0, 0), 0.3))
        return clock

    monkeypatch.setattr(Injection, "arm", arm_and_lift)
    monkeypatch.setattr("hil.studies.soak.random_faults", lambda *_: (parse("sense.1:off@0.3"),))
    monkeypatch.setattr("hil.studies.soak.CLEAR_S", 10.0)
    found = soak(0.5, 1, soaked_scenario("lqg"), tmp_path)
    assert "a comb's voltage rose by 0.3 V while none was allowed" in found.problems


SHIFTED = "sense.1:offset@{}+0.01,offset_m=3e-7"


@pytest.mark.parametrize(
    ("fault", "trips_s", "unprovoked"),
    [
        ("sense.1:off@0.29+0.01", 0.45, 1),
        ("sense.1:off@0.29+0.01", 0.2, 1),
        ("sense.1:off@0.29+0.01", 0.04, 1),
        (SHIFTED.format(0.06), 0.14, 1),
        (SHIFTED.format(0.045), 0.14, 0),
        (SHIFTED.format(0.001), 0.14, 0),
        (SHIFTED.format(0.045), 0.16, 1),
        (SHIFTED.format(0.001), 0.16, 1),
    ],
)
def test_a_decision_without_a_fault_is_found(tmp_path, monkeypatch, fault, trips_s, unprovoked):
    """An amplifier that trips by itself, long after the only fault that was planned. Homing takes the first 50 ms, and
    what was shifted then may show within 100 ms more, in which the zero that was found is first used.
    """
    shipped = Injection.arm

    def arm_and_trip(self):
        clock = shipped(self)
        self._clock.call_at(
            self.origin_us + round(1e6 * trips_s), lambda: self.wire_faults._node.amplifier_fault(0x2310)
        )
        return clock

    monkeypatch.setattr(Injection, "arm", arm_and_trip)
    monkeypatch.setattr("hil.studies.soak.random_faults", lambda *_: (parse(fault),))
    found = soak(0.6, 1, soaked_scenario("lqg"), tmp_path)
    decided = fault.startswith("sense.1:off@")
    assert found.decisions == 1 + decided
    assert found.unprovoked == unprovoked
    assert found.misled == 1 - unprovoked
    assert sum(found.undecided.values()) == (unprovoked and not decided)  # one that misled led to a decision, too
    assert ("1 decisions without a fault in the 50 ms before" in found.problems) == unprovoked


def test_faults_without_a_decision_are_counted_by_their_case(tmp_path, monkeypatch):
    """Too small; between two SYNCs; decided again as it goes on; and one that meets what is stopped already."""
    texts = (
        "sense.1:offset@0.2+0.02,offset_m=2e-7", "bus.sync:drop@0.25005+0.0001",
        "sense.1:offset@0.3+0.02,offset_m=2e-7", "sense.1:off@0.32+0.06", "amplifier.2:dead@0.39+0.0005",
    )  # fmt: skip
    monkeypatch.setattr("hil.studies.soak.random_faults", lambda *_: tuple(map(parse, texts)))
    found = soak(0.6, 1, soaked_scenario("lqg"), tmp_path)
    assert found.decisions >= 1
    assert found.misled == found.unprovoked == 0
    assert found.faults_by_case == {
        "sense.1:offset,offset_m=2e-07": 2, "bus.sync:drop": 1, "sense.1:off": 1, "amplifier.2:dead": 1,
    }  # fmt: skip
    assert found.undecided == {"sense.1:offset,offset_m=2e-07": 2, "bus.sync:drop": 1, "amplifier.2:dead": 1}
    words = decisions_in_words(found.faults, found.undecided, found.decisions, found.misled)
    assert words.startswith("5 faults, 4 without a decision; ")
    both = totals([found, found])
    assert both["undecided"] == {case: 2 * count for case, count in found.undecided.items()}
    assert sum(both["faults_by_case"].values()) == both["faults"] == 10


def test_a_defect_within_whole_ticks_is_found(tmp_path, monkeypatch):
    """Combs that keep 30 V more than they are told, in the plant itself: the compiled ticks have it, too."""
    whole, run = [], Stretches.run

    def counted(self, *arguments):
        self._plant.plant.params["amplifier_offset_v"][0, 0] = 30.0
        whole.append(run(self, *arguments))
        return whole[-1]

    monkeypatch.setattr(Stretches, "run", counted)
    monkeypatch.setattr("hil.studies.soak.random_faults", lambda *_: (parse("bus.sync:drop@0.3+0.01"),))
    found = soak(0.5, 1, soaked_scenario("lqg"), tmp_path)
    assert sum(whole) > 1_500
    assert any("ticks after the end of a mode with voltages" in problem for problem in found.problems), found.problems


@pytest.mark.parametrize(
    ("part", "defect", "words"),
    [
        ("_apply", steps_now_and_then, "changed by 25"),
        ("_apply", exceeds, "V at a comb"),
        ("_outputs_to_error_value", lambda self: None, "ticks after the end of a mode with voltages"),
    ],
)
def test_a_soak_sees_what_a_node_does_that_it_must_not(tmp_path, monkeypatch, part, defect, words):
    """Its verdicts are no wider than the limits: each of these passed while an amplifier's offset was allowed for."""
    monkeypatch.setattr(AmplifierNode, part, defect)
    monkeypatch.setattr(LockstepRig, "_stretches_of", lambda _: None)  # which call the node's compiled rules
    monkeypatch.setattr("hil.studies.soak.random_faults", lambda *_: (parse("bus.sync:drop@0.3"),))
    monkeypatch.setattr("hil.studies.soak.CLEAR_S", 10.0)
    found = soak(0.5, 1, soaked_scenario("lqg"), tmp_path)
    assert any(words in problem for problem in found.problems), found.problems


@cache
def setup():
    return soaked_scenario("lqg").setup()


AT_ITS_BOUNDS = Soaked(
    seed=1, law="lqg", ticks=1000, recorded_ticks=1000, decisions=1, returns=1, voltage_max_v=200.0, slew_max_v=20.0,
    rise_max_v=RISE_V, zero_ticks=106, memory_mb=[50.0, 100.0, 130.0, 110.0, 120.0],
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("recorded_ticks", 999, "999 ticks recorded of 1000"),
        ("damaged", True, "the stage is damaged"),
        ("voltage_max_v", 200.1, "200.1 V at a comb"),
        ("slew_max_v", 20.1, "a comb's voltage changed by 20.1 V in a tick"),
        ("rise_max_v", 0.11, "a comb's voltage rose by 0.1 V while none was allowed"),
        ("zero_ticks", 107, "a voltage 107 ticks after the end of a mode with voltages"),
        ("unprovoked", 1, "1 decisions without a fault in the 50 ms before"),
        ("decisions", 0, "no fault was decided, or none recovered from"),
        ("returns", 0, "no fault was decided, or none recovered from"),
        ("memory_mb", [50.0, 100.0, 110.0, 130.0, 120.1], "memory grew from 100 to 120 MB"),
    ],
)
def test_at_a_bound_all_is_well_and_beyond_it_that_is_told(name, value, words):
    """200 V and 20 V a tick are the controller's, 106 ticks the node's 20 ms without a frame, with the look behind."""
    for changes, problems in (({}, []), ({name: value}, [words])):
        soaked = dataclasses.replace(AT_ITS_BOUNDS, **changes, problems=[])
        _judge(soaked, setup())
        assert soaked.problems == problems


def looked_at(volts, mode, overrun=(), fault="amplifier.2:stuck@0.02+0.01", rows_each=1000):
    """Figures of the combs' voltages (n, 3), looked at in blocks."""
    rows = np.zeros(len(volts), ROW)
    rows["tick"], rows["comb_voltage_v"], rows["mode"] = np.arange(len(rows)), volts, mode
    for at, ticks in overrun:
        rows["overrun"][at] = ticks
    soaked = Soaked(seed=1, law="lqg")
    voltages = _Voltages(soaked, dataclasses.replace(setup(), faults=(parse(fault),)))
    for first in range(0, len(rows), rows_each):
        voltages.look_at(rows[first : first + rows_each])
    return soaked


def driven_up():
    """Volts (300, 3): to 100 V in 10 V steps, and there."""
    return np.tile(np.minimum(10.0 * np.arange(300), 100.0)[:, np.newaxis], 3)


@pytest.mark.parametrize("rows_each", [1000, 7, 1])
@pytest.mark.parametrize(
    ("comb", "tick", "is_asked"),
    [(1, 97, True), (1, 99, False), (1, 125, False), (1, 154, False), (1, 156, True), (1, 298, True), (0, 125, True)],
)
def test_only_a_comb_whose_channel_fails_is_not_asked_and_only_so_long(comb, tick, is_asked, rows_each):
    """From the tick before the fault, which lasts from 100 to 150, to four behind it. A spike of 30 V for a tick."""
    volts = driven_up()
    volts[tick, comb] = 130.0
    found = looked_at(volts, Mode.TRACKING, rows_each=rows_each)
    assert (found.slew_max_v, found.voltage_max_v) == ((30.0, 130.0) if is_asked else (10.0, 100.0))


def test_ticks_that_the_controller_skipped_count_for_when_a_channel_fails():
    """18 of them: the fault's 100 to 150 of the bus are the rows 82 to 132."""
    for tick, slew_v in ((79, 30.0), (84, 10.0), (110, 10.0), (138, 30.0)):
        volts = driven_up()
        volts[tick, 1] = 130.0
        assert looked_at(volts, Mode.TRACKING, overrun=[(20, 9), (40, 9)], rows_each=7).slew_max_v == slew_v


@pytest.mark.parametrize("rows_each", [1000, 7, 1])
def test_how_long_a_voltage_stays_and_what_rises_is_found_to_the_end_of_the_run(rows_each):
    """A comb is let go 40 ticks after the others, another rises a little, much later."""
    volts, mode = driven_up(), np.full(300, Mode.TRACKING)
    mode[200:] = Mode.FAULT
    volts[200:] = 0.0
    volts[200:240, 2] = 60.0
    volts[299, 0] = 0.3
    found = looked_at(volts, mode, rows_each=rows_each)
    assert found.zero_ticks == 40
    assert found.rise_max_v == 0.3
    assert found.slew_max_v == 40.0

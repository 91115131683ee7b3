"""Whole ticks in one compiled call, and event by event: the same rows, the same frame log, the same state behind them,
whatever happens and whenever.
"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from loop_rig import first_difference, setup

from hil.bus.clock import Lockstep
from hil.bus.frame_log import FrameLog
from hil.bus.frame_time import to_end_ns
from hil.bus.log_lines import LINE_MOST, write_line
from hil.bus.wire import Wire
from hil.bus.wire_rules import NEVER_US, WIRE, arbitrate, clear, end, received, send
from hil.faults.fault import parse
from hil.lanes.blocks import Blocks
from hil.lanes.lockstep import LockstepRig
from hil.lanes.setup import Setup
from hil.runs.scenario import load_scenario
from hil.studies.faults.matrix import CASES
from hil.studies.faults.outcome import setup_for
from hil.whole_ticks.stretches import Stretches
from pkxyz_ctrl.can.driver import word_of
from pkxyz_ctrl.can.frame import BIT_RATE_SWITCH, FD, Frame
from pkxyz_ctrl.loop.row import ROW

TEXTS = tuple(dict.fromkeys(case.text for case in CASES if case.text != "controller:killed"))
"""Every kind of fault, as the matrix has it; a controller that is killed leaves no more ticks."""
FAULTS = (
    "sense.1:intermittent@{t}+0.02,probability=0.1", "sense.2:slow@{t}+0.04", "amplifier.1:slew_collapse@{t}+0.03",
    "bus:drop@{t}+0.02,probability=0.05", "controller:late_tick@{t}+0.01,late_us=30",
    "bus.sense:drop@{t},probability=0.02", "bus.drive:corrupt@{t}+0.01,probability=0.3", "bus.sync:drop@{t}+0.002",
    "bus.drive:delay@{t}+0.004,delay_us=190", "bus:error_frames@{t}+0.01,probability=0.2", "bus:babbling@{t}+0.003",
    "bus.heartbeat:drop@{t}+0.08", "bus.drive:forged@{t}+0.01,interval_s=0.003", "node:reset@{t}",
    "node:silent@{t}+0.03", "node:wrong_configuration@{t}+0.02", "amplifier.1:trip@{t}+0.02",
    "controller:late_tick@{t}+0.003,late_us=90", "controller:lost_tick@{t}+0.02,ticks=3",
)  # fmt: skip
RATES = (1_000_000, 5_000_000)


def run(made: Setup, folder: Path, whole: bool) -> tuple[LockstepRig, tuple[int, float], np.ndarray, bytes]:
    """The rig behind its run, missed ticks and load, all rows, the log."""
    rig = LockstepRig(made, folder / "frames.log", whole_ticks=whole)
    taken = [np.zeros(0, ROW)]
    blocks = Blocks(
        made.trajectory, made.bus.period_us, made.ticks, lambda block: taken.append(block.copy()), lambda *_: None
    )
    result = rig.run(blocks)
    return rig, result, np.concatenate(taken), (folder / "frames.log").read_bytes()


def same_both_ways(made: Setup, folder: Path) -> LockstepRig:
    """The run in both ways is one: rows, log, words, and the state of all that takes part."""
    one, result, rows, log = run(made, folder, True)
    other, *expected = run(made, folder, False)
    assert first_difference(rows, expected[1]) is None
    assert len(rows) == made.ticks
    assert log == expected[2]
    assert result == expected[0]
    assert one.controller.faults == other.controller.faults
    assert one.clock.now_us == other.clock.now_us
    assert one.wire.statistics() == other.wire.statistics()
    assert one.controller.exchange.tobytes() == other.controller.exchange.tobytes()
    assert one.plant.plant.state.tobytes() == other.plant.plant.state.tobytes()
    assert (one.node.outputs, one.node.state, one.node._sync_expected) == (
        other.node.outputs, other.node.state, other.node._sync_expected,
    )  # fmt: skip
    assert [alarm.due_us for alarm in one.node.work_alarms] == [alarm.due_us for alarm in other.node.work_alarms]
    assert one.log is not None
    assert one.log.frames == log.count(b"\n")
    return one


@pytest.fixture
def whole(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many ticks each stretch had."""
    found: list[int] = []
    shipped = Stretches.run

    def counted(self: Stretches, *arguments: object) -> int:
        found.append(shipped(self, *arguments))  # type: ignore[arg-type]
        return found[-1]

    monkeypatch.setattr(Stretches, "run", counted)
    return found


@pytest.mark.parametrize(
    ("plant", "bus_name"),
    [("nominal", "fd_5k"), ("mild", "classic_2k"), ("harsh", "unix_1k"), ("lab", "fd_5k"), ("nominal", "unix_2k")],
)
def test_a_run_is_the_same_both_ways(plant: str, bus_name: str, tmp_path: Path, whole: list[int]) -> None:
    made = dataclasses.replace(setup(plant, bus_name), duration_s=0.4)
    same_both_ways(made, tmp_path)
    assert sum(whole) > 0.9 * made.ticks


@pytest.mark.parametrize("name", ["raster", "steps", "path", "sweep"])
def test_a_scenario_is_the_same_both_ways(name: str, tmp_path: Path, whole: list[int]) -> None:
    """Several blocks of it, under the default law, which learns."""
    made = dataclasses.replace(load_scenario(name).setup(), duration_s=1.0)
    same_both_ways(made, tmp_path)
    assert sum(whole) > 0.98 * made.ticks


@given(
    faults=st.lists(st.tuples(st.sampled_from(FAULTS), st.integers(0, 1_500)), max_size=2),
    clear_s=st.sampled_from([None, 0.02]),
)
@example(faults=[(FAULTS[0], 700)], clear_s=0.02)
@example(faults=[(FAULTS[8], 650)], clear_s=0.02)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_fault_at_any_time_is_the_same_both_ways(
    faults: list[tuple[str, int]], clear_s: float | None, tmp_path: Path, whole: list[int]
) -> None:
    """Instants of any tenth of a millisecond; what it leads to, and the way back after somebody has cleared it."""
    made = dataclasses.replace(
        setup("nominal"), duration_s=0.2, clear_s=clear_s,
        faults=tuple(parse(text.format(t=at / 1e4)) for text, at in faults),
    )  # fmt: skip
    same_both_ways(made, tmp_path)
    assert sum(whole) > 0 or any(at < 700 for _, at in faults)


@pytest.mark.parametrize("text", TEXTS)
def test_every_fault_of_the_matrix_is_the_same_both_ways(text: str, tmp_path: Path, whole: list[int]) -> None:
    """Its onset, what is decided and when, 20 ms of it, the clear and the start-up behind it."""
    head, comma, rest = text.partition(",")
    fault = parse(f"{head}@0.11+0.02{comma}{rest}")
    made = dataclasses.replace(setup("nominal"), duration_s=0.35, clear_s=0.02, faults=(fault,))
    same_both_ways(made, tmp_path)
    assert sum(whole) > 0.75 * made.ticks


@pytest.mark.parametrize(
    ("text", "share"),
    [
        ("sense.2:slow,corner_hz=2000", 0.99), ("sense.1:offset,offset_m=0.2e-6", 0.99),
        ("plant:stiffness,factor=1.02", 0.99),
        ("amplifier.1:stuck", 0.5), ("bus.sense:drop,probability=0.01", 0.95), ("bus.heartbeat:drop", 0.9),
        ("controller:late_tick,late_us=30", 0.98),
    ],
)  # fmt: skip
def test_ticks_under_a_lasting_fault_are_whole(text: str, share: float, tmp_path: Path, whole: list[int]) -> None:
    """Channels that do what they should not, frames that are lost now and then, ticks that are late: all compiled."""
    head, comma, rest = text.partition(",")
    made = dataclasses.replace(setup("nominal"), duration_s=0.25, faults=(parse(f"{head}@0.11+0.13{comma}{rest}"),))
    rig = same_both_ways(made, tmp_path)
    assert sum(whole) > share * made.ticks, rig.controller.faults


@pytest.mark.parametrize("text", ["sense.1:off", "node:reset", "bus:error_frames", "bus:drop"])
def test_a_start_up_is_played_whole(text: str, tmp_path: Path, whole: list[int]) -> None:
    """What it reads of the node, and a node that stands there meanwhile, errors still counted against it."""
    made = dataclasses.replace(setup("nominal"), duration_s=0.35, clear_s=0.02, faults=(parse(f"{text}@0.11+0.004"),))
    rig = same_both_ways(made, tmp_path)
    assert rig.controller.faults
    assert sum(whole) > 0.95 * made.ticks


@pytest.mark.parametrize("text", ["sense.1:off", "amplifier.2:slew_collapse", "bus.drive:drop", "node:silent"])
def test_combs_that_are_watched_are_the_same_both_ways(text: str, whole: list[int]) -> None:
    """What ``pkxyz faults`` judges by: the voltages behind each tick."""
    case = next(case for case in CASES if case.text == text)
    made = dataclasses.replace(setup_for("lqg"), faults=(case.fault,), clear_s=0.05, duration_s=0.4)
    seen = []
    for whole_ticks in (True, False):
        rig = LockstepRig(made, whole_ticks=whole_ticks)
        assert rig.injection is not None
        rig.injection.watched = []
        rig.run(Blocks(made.trajectory, made.bus.period_us, made.ticks, lambda block: None, lambda *_: None))
        seen.append((rig.injection.watched, rig.controller.faults))
    assert seen[0] == seen[1]
    assert len(seen[0][0]) == made.ticks
    assert sum(whole) > 0.75 * made.ticks


def test_who_else_is_on_the_bus_meets_every_frame(tmp_path: Path, whole: list[int]) -> None:
    """An endpoint of somebody's, as python-can makes one: every tick then runs event by event."""
    made = dataclasses.replace(setup("nominal"), duration_s=0.05)
    rig = LockstepRig(made, tmp_path / "frames.log")
    heard: list[Frame] = []
    runs = Blocks(made.trajectory, made.bus.period_us, made.ticks, lambda block: None, lambda *_: None)
    rig.clock.call_at(40_000, lambda: rig.wire.attach("guest", lambda frame, t_us: heard.append(frame)))
    rig.run(runs)
    assert heard
    lines = (tmp_path / "frames.log").read_text().splitlines()
    assert len(heard) == sum(float(line[1 : line.index(")")]) > 0.04 for line in lines)
    assert whole == []


# -- its parts, beside those that they stand for ----------------------------------------------------------------


@given(
    t_us=st.integers(0, 10**13), can_id=st.integers(0, 0x7FF), data=st.binary(max_size=8),
    flags=st.sampled_from([0, FD, FD | BIT_RATE_SWITCH]), channel=st.sampled_from(["pkxyz", "can", "a-name.of_15ch"]),
)  # fmt: skip
def test_a_compiled_line_is_the_log_s_own(
    t_us: int, can_id: int, data: bytes, flags: int, channel: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    with FrameLog(tmp_path_factory.mktemp("log") / "frames.log", channel) as log:
        log.record(Frame._make((can_id, data, flags)), t_us)
    text, name = np.zeros(LINE_MOST + 5, np.uint8), np.frombuffer(log.channel.encode(), np.uint8)
    size = write_line(text, 5, name, t_us, can_id, flags, len(data), word_of(data))
    assert text[5:size].tobytes() == log.path.read_bytes()


FRAMES = st.tuples(
    st.integers(0, 400), st.sampled_from([0x080, 0x28A, 0x30A, 0x70A, 0x77F]), st.binary(max_size=8), st.booleans()
)


@given(
    planned=st.lists(FRAMES, min_size=1, max_size=12), flags=st.sampled_from([0, FD, FD | BIT_RATE_SWITCH]),
    errors=st.lists(st.sampled_from([0, 1, 5, 127]), min_size=4, max_size=4),
)  # fmt: skip
@settings(max_examples=200, deadline=None)
def test_the_compiled_wire_is_the_wire(
    planned: list[tuple[int, int, bytes, bool]], flags: int, errors: list[int]
) -> None:
    """Frames of two senders at any instants, by both wires: the same ends, in the same order, and the same books, those
    of errors that were counted before, too.
    """
    planned.sort(key=lambda frame: frame[0])
    clock, ended = Lockstep(), []
    medium = Wire(clock, *RATES)
    ends = [medium.attach(str(n)) for n in range(2)]
    medium.attach("log", lambda frame, t_us: ended.append((t_us, frame.can_id, frame.data)))
    compiled, found, now_us = np.zeros(1, WIRE), [], 0
    compiled["nominal_bitrate"], compiled["data_bitrate"] = RATES
    compiled["to_end_ns"] = to_end_ns(RATES[0])
    clear(compiled)
    wire = compiled[0]
    for place, one in enumerate(ends):
        one.transmit_errors, one.receive_errors = errors[place], errors[2 + place]
    wire["transmit_errors"], wire["receive_errors"] = errors[:2], errors[2:]

    def pass_time(until_us: int) -> None:
        while wire["end_us"] <= until_us:
            at_us = int(wire["end_us"])
            end(wire)
            done = wire["done"][0]
            data = (int(done["word"]) & (1 << 64) - 1).to_bytes(8, "little")[: done["length"]]
            found.append((at_us, int(done["can_id"]), data))
            received(wire)
            arbitrate(wire, at_us)

    for gap_us, can_id, data, is_second in planned:
        now_us += gap_us
        pass_time(now_us)
        clock.run_until(now_us)
        if wire["waiting"] < 4 and can_id not in wire["queue"]["can_id"]:
            assert send(wire, int(is_second), can_id, flags, len(data), word_of(data), now_us)
            assert ends[is_second].send(Frame._make((can_id, data, flags)))
    pass_time(now_us + 10_000)
    clock.run_until(now_us + 10_000)
    assert found == ended
    assert wire["end_us"] == NEVER_US
    assert (int(wire["free_ns"]), int(wire["busy_ns"]), int(wire["frames"])) == medium.carried
    assert wire["transmit_errors"].tolist() == [one.transmit_errors for one in ends]
    assert wire["receive_errors"].tolist() == [one.receive_errors for one in ends]

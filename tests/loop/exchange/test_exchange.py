"""One period on the bus, each rule of it alone: no bus, no law; what is to be sent is read from the records."""

import numpy as np
import pytest
from loop_rig import law

from pkxyz_ctrl.can import driver_rules, sense_input
from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.driver import AmplifierDriver, bytes_of, word_of
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import NEVER_US, DriverState
from pkxyz_ctrl.loop import exchange
from pkxyz_ctrl.loop.controller import part
from pkxyz_ctrl.loop.exchange import BLOCKED, EXCHANGE, EXCHANGE_MEMORY, NOT_RESTARTED, RESTARTED
from pkxyz_ctrl.loop.reference import standing_still
from pkxyz_ctrl.safety.gate import GateConfig, TransmitGate
from pkxyz_ctrl.safety.modes import Event, Mode
from pkxyz_ctrl.safety.trips import Trip

PERIOD_US, SHORT_US = 200, 30
SYNC, NMT, DRIVE, OUTPUT, OURS, NODE, REQUEST, SENSE = 0x080, 0x000, 0x30A, 0x20A, 0x77F, 0x70A, 0x60A, 0x28A
UNTIL_US = 10_000  # far behind any frame
AT_WORK = [Mode.IDLE, Mode.HOMING, Mode.ENABLED, Mode.TRACKING, Mode.LANDING]


class Bench:
    """The two records of a controller whose node is at work, in ``mode``."""

    def __init__(self, mode: Mode = Mode.TRACKING, state: DriverState = DriverState.OPERATIONAL) -> None:
        self.config, self.all = np.zeros(1, EXCHANGE), np.zeros(1, EXCHANGE_MEMORY)
        AmplifierDriver(
            DriverConfig(digital_outputs=True, signature_syncs=240), record=part(self.config, "driver"),
            memory=part(self.all, "driver"), period_us=PERIOD_US, short_frame_us=SHORT_US,
        )  # fmt: skip
        gate = GateConfig(count_max=30000, count_slew_max=1000, period_us=PERIOD_US, digital_outputs=True)
        TransmitGate(gate, part(self.config, "gate"), part(self.all, "gate"))
        exchange.switch_on(self.all)
        self.memory, self.driver = self.all[0], self.all[0]["driver"][0]
        self.cycle = self.memory["cycle"][0]
        self.cycle["mode"] = mode
        self.driver["state"], self.driver["has_outputs"] = state.value, 1
        self.now_us = 0
        if mode not in (Mode.BOOT, Mode.PRE_OPERATIONAL, Mode.FAULT):
            self.finish()  # 0 V, so that the gate knows what the combs hold
            self.begin()

    def begin(self) -> int:
        self.now_us += PERIOD_US
        return int(exchange.begin(self.config, self.all, self.now_us))

    def finish(self, until_us: int = UNTIL_US) -> int:
        return int(exchange.finish(self.config, self.all, self.now_us, self.now_us + until_us))

    def voltages(self, *counts: int) -> None:
        self.cycle["tick"]["count"][0] = counts

    @property
    def sent(self) -> list[tuple[int, bytes]]:
        """What may go out, in its order."""
        out = self.driver["out"][: int(self.driver["outgoing"])]
        return [(int(o["can_id"]), bytes_of(int(o["data"]), int(o["length"]))) for o in out if o["reason"] == 0]

    @property
    def ids(self) -> list[int]:
        return [can_id for can_id, _ in self.sent]

    def hear(self, can_id: int, data: bytes) -> int:
        return int(exchange.on_frame(self.config, self.all, can_id, 3, len(data), word_of(data), self.now_us))


# -- what begins a period ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", Mode)
def test_a_period_begins_with_a_sync_and_in_fault_the_node_is_taken_out_of_operation(mode: Mode) -> None:
    bench = Bench(mode)
    told = bench.begin()
    assert bench.ids == ([SYNC, NMT] if mode == Mode.FAULT else [SYNC])
    assert told == len(bench.sent)
    assert bench.memory["begun_us"] == bench.now_us
    if mode == Mode.FAULT:
        assert bench.sent[1][1] == b"\x80\x0a"


def test_a_node_whose_objects_were_changed_stays_operational_for_its_0_v() -> None:
    """What it does outside of that state may be no longer what was read back."""
    bench = Bench(Mode.FAULT)
    bench.cycle["row"]["trips"] = Trip.SAFETY_OBJECTS | Trip.SENSE_STALE
    bench.begin()
    assert bench.ids == [SYNC]
    bench.cycle["row"]["trips"] = Trip.SENSE_STALE
    bench.begin()
    assert bench.ids == [SYNC, NMT]


@pytest.mark.parametrize(
    ("mode", "state", "asked"),
    [
        (Mode.BOOT, DriverState.RESETTING, Event.NONE),
        (Mode.BOOT, DriverState.IDENTIFYING, Event.NONE),
        (Mode.BOOT, DriverState.CONFIGURING, Event.NODE_FOUND),
        (Mode.PRE_OPERATIONAL, DriverState.CONFIGURING, Event.NODE_FOUND),
        (Mode.PRE_OPERATIONAL, DriverState.STARTING, Event.NONE),
        (Mode.BOOT, DriverState.OPERATIONAL, Event.NODE_FOUND),
        (Mode.PRE_OPERATIONAL, DriverState.OPERATIONAL, Event.NODE_READY),
        (Mode.IDLE, DriverState.OPERATIONAL, Event.NONE),
        (Mode.IDLE, DriverState.CONFIGURING, Event.NONE),
    ],
)
def test_the_start_up_asks_for_its_modes_while_there_is_none_at_work(
    mode: Mode, state: DriverState, asked: Event
) -> None:
    bench = Bench(mode)
    bench.driver["state"] = state.value
    bench.driver["start"][0]["deadline_us"] = bench.driver["start"][0]["answer_due_us"] = NEVER_US
    assert bench.begin() & (RESTARTED | NOT_RESTARTED) == 0
    assert bench.memory["event"] == asked


@pytest.mark.parametrize(
    ("due", "clearing", "state", "restarts"),
    [
        (1, 0, DriverState.OPERATIONAL, True),
        (0, 1, DriverState.FAILED, True),
        (0, 1, DriverState.OPERATIONAL, False),
        (0, 0, DriverState.FAILED, False),
    ],
)
def test_after_a_clear_gate_driver_and_node_start_anew(
    due: int, clearing: int, state: DriverState, restarts: bool
) -> None:
    bench = Bench(Mode.BOOT, state)
    bench.memory["restart_due"], bench.memory["clearing"], bench.memory["gate"][0]["latched"] = due, clearing, 5
    told = bench.begin()
    assert bool(told & RESTARTED) == restarts
    assert not told & NOT_RESTARTED
    assert ((NMT, b"\x81\x0a") in bench.sent) == restarts
    assert bench.memory["is_restarting"] == restarts
    if restarts:
        assert (bench.memory["restart_due"], bench.memory["clearing"], bench.memory["gate"][0]["latched"]) == (0, 0, 0)
        assert told == RESTARTED | 2
        assert bench.memory["event"] == Event.NONE
        assert not bench.begin() & RESTARTED


def test_a_start_anew_that_fails_is_said_once_and_loses_the_node() -> None:
    bench = Bench(Mode.BOOT, DriverState.FAILED)
    bench.memory["is_restarting"] = 1
    assert bench.begin() == NOT_RESTARTED | 1
    assert (bench.memory["event"], bench.memory["is_restarting"]) == (Event.NODE_LOST, 0)
    bench.memory["event"] = Event.NONE
    assert bench.begin() == 1
    assert bench.memory["event"] == Event.NONE


def test_a_start_up_that_goes_well_is_no_failure() -> None:
    bench = Bench(Mode.PRE_OPERATIONAL)
    bench.memory["is_restarting"] = 1
    assert bench.begin() == 1
    assert (bench.memory["event"], bench.memory["is_restarting"]) == (Event.NODE_READY, 1)


def test_the_start_up_goes_on_by_time() -> None:
    bench = Bench(Mode.BOOT, DriverState.RESETTING)
    start = bench.driver["start"][0]
    start["deadline_us"], start["repeats_left"] = PERIOD_US, 1
    assert bench.begin() == 2
    assert bench.sent[:1] == [(NMT, b"\x81\x0a")]
    assert bench.ids == [NMT, SYNC]
    bench.begin()
    assert bench.ids == [SYNC]


@pytest.mark.parametrize("call", ["begin", "start", "wait", "stop"])
def test_whatever_is_sent_the_gate_has_seen(call: str) -> None:
    """In a mode that there is not, it lets nothing pass."""
    bench = Bench(Mode.BOOT, DriverState.RESETTING)
    bench.cycle["mode"] = 99
    bench.driver["start"][0]["repeats_left"] = 1
    assert getattr(exchange, call)(bench.config, bench.all, 10**7) == BLOCKED | (2 if call == "stop" else 1)
    assert bench.sent == []
    assert bench.memory["blocked"] == 1


def test_what_is_switched_on_has_sent_and_received_nothing() -> None:
    """Whatever stood in its memory."""
    bench = Bench()
    driver, others = bench.driver, bench.memory["others"][0]
    for name in (
        "state",
        "outgoing",
        "node_events",
        "foreign_id",
        "signature",
        "heartbeat_next_us",
        "node_heartbeat_us",
    ):
        driver[name] = 3
    others["frames"], others["since_us"], bench.memory["gate"][0]["known"] = 4, 5, 1
    exchange.switch_on(bench.all)
    assert (driver["state"], driver["outgoing"], driver["node_events"]) == (DriverState.OFF.value, 0, 0)
    assert (driver["foreign_id"], driver["signature"], driver["node_heartbeat_us"]) == (-1, -1, 0)
    assert driver["heartbeat_next_us"] == driver["node_deadline_us"] == NEVER_US
    assert (others["frames"], others["since_us"], bench.memory["gate"][0]["known"]) == (0, 0, 0)


def test_what_is_told_besides_the_number_of_frames() -> None:
    """Whoever runs the exported controller reads these bits."""
    assert (BLOCKED, RESTARTED, NOT_RESTARTED) == (256, 512, 1024)


# -- before there are periods ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "state", "blocked", "answer", "after"),
    [
        (Mode.BOOT, DriverState.RESETTING, 0, 0, Mode.BOOT),
        (Mode.BOOT, DriverState.CONFIGURING, 0, 0, Mode.PRE_OPERATIONAL),
        (Mode.PRE_OPERATIONAL, DriverState.CONFIGURING, 0, 0, Mode.PRE_OPERATIONAL),
        (Mode.PRE_OPERATIONAL, DriverState.TRYING, 0, 0, Mode.PRE_OPERATIONAL),
        (Mode.PRE_OPERATIONAL, DriverState.OPERATIONAL, 0, 1, Mode.IDLE),
        (Mode.PRE_OPERATIONAL, DriverState.FAILED, 0, -1, Mode.PRE_OPERATIONAL),
        (Mode.PRE_OPERATIONAL, DriverState.OPERATIONAL, 1, -1, Mode.PRE_OPERATIONAL),
    ],
)
def test_coming_up(mode: Mode, state: DriverState, blocked: int, answer: int, after: Mode) -> None:
    bench = Bench(mode)
    bench.driver["state"], bench.memory["blocked"] = state.value, blocked
    assert exchange.come_up(bench.all) == answer
    assert bench.cycle["mode"] == after


def test_start_wait_and_stop_send_what_the_driver_wants() -> None:
    bench = Bench(Mode.BOOT, DriverState.OFF)
    bench.driver["outgoing"], bench.memory["others"][0]["frames"] = 3, 7
    assert exchange.start(bench.config, bench.all, 50) == 1
    assert bench.sent == [(NMT, b"\x81\x0a")]
    assert (bench.memory["others"][0]["frames"], bench.memory["others"][0]["since_us"]) == (0, 50)
    assert exchange.wait(bench.config, bench.all, 60) == 0
    assert exchange.wait(bench.config, bench.all, 10**7) == 1
    assert bench.sent == [(NMT, b"\x81\x0a")]
    assert exchange.stop(bench.config, bench.all, 10**7) == 2
    assert bench.ids == [DRIVE, NMT]
    assert bench.sent[1][1] == b"\x80\x0a"


# -- what comes --------------------------------------------------------------------------------------------------------


def test_a_frame_of_the_start_up_is_answered_and_the_answer_judged() -> None:
    bench = Bench(Mode.BOOT, DriverState.OFF)
    exchange.start(bench.config, bench.all, 50)
    assert bench.hear(NODE, b"\0") == driver_rules.START_UP
    assert bench.ids == [NMT, REQUEST]
    bench = Bench(Mode.BOOT, DriverState.OFF)
    exchange.start(bench.config, bench.all, 50)
    bench.cycle["mode"] = 99
    assert bench.hear(NODE, b"\0") == driver_rules.START_UP
    assert (bench.sent, bench.memory["blocked"]) == ([], 1), "in a mode that there is not nothing goes out"


def test_frames_of_others_are_counted_until_the_node_is_heard() -> None:
    bench = Bench()
    others = bench.memory["others"][0]
    for _ in range(3):
        assert bench.hear(0x123, b"\1") == 0
    assert (others["frames"], others["can_id"], others["last_us"]) == (3, 0x123, bench.now_us)
    for can_id in (NODE, 0x08A, 0x58A):
        bench.hear(can_id, b"\5")
    assert others["frames"] == 3
    assert bench.hear(SENSE, ProcessCodec(SENSE, True).encode((1, -2, 3), 9)) == driver_rules.FRESH
    assert others["frames"] == 3
    bench.hear(0x123, b"\1")
    assert others["frames"] == 3, "behind this period's sample nobody is in its way"
    exchange.hand_over(bench.all, 0)
    assert (others["frames"], others["since_us"]) == (0, bench.memory["begun_us"])


def test_what_came_is_handed_to_the_cycle() -> None:
    bench = Bench(Mode.ENABLED)
    seen = bench.cycle["input"]
    bench.hear(SENSE, ProcessCodec(SENSE, True).encode((1, -2, 3), 9))
    bench.driver["node_events"], bench.driver["output"], bench.memory["event"] = 5, 3, Event.TRACK
    assert exchange.hand_over(bench.all, 2) == Mode.ENABLED
    assert (seen["event"], seen["sense_status"], seen["node_events"], seen["overrun"]) == (Event.TRACK, 0, 5, 2)
    assert (seen["output_acting"], seen["sense_count"].tolist(), seen["trips"]) == (3, [1, -2, 3], 0)
    assert bench.memory["missed_ticks"] == 2


@pytest.mark.parametrize(("mode", "missed"), [(Mode.FAULT, 0), (Mode.BOOT, 0), (Mode.IDLE, 1), (Mode.TRACKING, 1)])
def test_a_sample_that_is_owed_is_missed(mode: Mode, missed: int) -> None:
    bench = Bench(mode)
    bench.memory["others"][0]["frames"] = 4
    exchange.hand_over(bench.all, 0)
    assert bench.cycle["input"]["sense_status"] == sense_input.SENSE_MISSING
    assert bench.memory["missed_ticks"] == missed
    assert bench.memory["others"][0]["frames"] == 4


def test_a_blocked_frame_trips_the_next_period_once() -> None:
    bench = Bench()
    bench.memory["blocked"] = 1
    exchange.hand_over(bench.all, 0)
    assert (bench.cycle["input"]["trips"], bench.memory["blocked"]) == (Trip.GATE_BLOCKED, 0)
    bench.cycle["input"]["trips"] = 0
    exchange.hand_over(bench.all, 0)
    assert bench.cycle["input"]["trips"] == 0


@pytest.mark.parametrize(
    ("mode", "clearing", "event"),
    [(Mode.FAULT, 1, Event.CLEAR), (Mode.FAULT, 0, Event.HOLD), (Mode.BOOT, 1, Event.HOLD)],
)
def test_a_clear_is_asked_for_until_the_fault_is_left(mode: Mode, clearing: int, event: Event) -> None:
    bench = Bench(mode)
    bench.memory["clearing"], bench.memory["event"] = clearing, Event.HOLD
    exchange.hand_over(bench.all, 0)
    assert bench.cycle["input"]["event"] == event


@pytest.mark.parametrize(
    ("was", "now", "left", "due"),
    [(Mode.IDLE, Mode.IDLE, -1, 0), (Mode.IDLE, Mode.HOMING, Mode.IDLE, 0), (Mode.FAULT, Mode.BOOT, Mode.FAULT, 1)],
)
def test_after_the_cycle_a_mode_that_was_left_is_told(was: Mode, now: Mode, left: int, due: int) -> None:
    bench = Bench(now)
    bench.memory["event"] = Event.HOLD
    assert exchange.take_over(bench.all, was) == left
    assert (bench.memory["event"], bench.memory["restart_due"]) == (Event.NONE, due)


@pytest.mark.parametrize(
    ("mode", "state", "clearing"),
    [
        (Mode.FAULT, DriverState.OPERATIONAL, 1),
        (Mode.BOOT, DriverState.FAILED, 1),
        (Mode.PRE_OPERATIONAL, DriverState.FAILED, 1),
        (Mode.BOOT, DriverState.RESETTING, 0),
        (Mode.IDLE, DriverState.FAILED, 0),
        (Mode.TRACKING, DriverState.OPERATIONAL, 0),
    ],
)
def test_only_a_fault_or_a_failed_start_is_cleared(mode: Mode, state: DriverState, clearing: int) -> None:
    bench = Bench(mode)
    bench.driver["state"], bench.memory["clearing"] = state.value, 1 - clearing
    exchange.ask_to_clear(bench.all)
    assert bench.memory["clearing"] == clearing


# -- the whole of it ---------------------------------------------------------------------------------------------------


def test_a_period_is_what_came_then_the_cycle_and_its_outputs() -> None:
    bench = Bench(Mode.IDLE)
    bench.config["law"][0] = law(autostart=False)[0]
    bench.memory["outputs"][0]["bits"] = 7
    bench.hear(SENSE, ProcessCodec(SENSE, True).encode((1, -2, 3), 9))
    reference = standing_still()
    assert exchange.period(bench.config, bench.all, reference, 2) == -1
    row = bench.cycle["row"]
    assert (row["mode"], row["overrun"], row["sense_count"].tolist()) == (Mode.IDLE, 2, [1, -2, 3])
    assert bench.memory["outputs"][0]["bits"] == 0
    bench.memory["event"] = Event.HOME
    assert exchange.period(bench.config, bench.all, reference, 0) == Mode.IDLE
    assert bench.cycle["mode"] == Mode.HOMING
    assert bench.memory["missed_ticks"] == 2

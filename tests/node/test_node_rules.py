"""The compiled rules of a node at work beside the node: what they do it does, and what they leave is untouched."""

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from node_rig import CONTROLLER, DRIVE, EMCY, SENSE, SYNC, Rig, protected, sample_at

from hil.node import rules
from hil.node.amplifier import NmtState
from hil.whole_ticks.node_at_work import NodeAtWork
from pkxyz_ctrl.can.driver import bytes_of, word_of

CONSUMER = 0x1016, 1, 0x7F_0032, 4  # the controller's heartbeat, 50 ms
STEP = 0x2011, 0, 500, 2
STATE = ("output", "pending", "is_pending", "drive_counter", "drive_crc", "sync_expected", "drive_deadline_us")
CASES = (
    "sync", "sync", "sync", "drive", "drive", "drive", "zero", "far", "negative", "counter", "crc", "short", "long",
    "odd sync", "long sync", "beat", "boot", "nothing",
)  # fmt: skip


class Twin:
    """Two nodes that get the same frames: one through the rules wherever they take them, the other as shipped."""

    def __init__(self) -> None:
        self.rigs = Rig(), Rig()
        for rig in self.rigs:
            assert rig.write(*CONSUMER) == rig.write(*STEP) == 0
            rig.start()
            rig.cycle((0, 0, 0))
            rig.cycle((0, 0, 0))
            rig.forget()
        self.work = NodeAtWork(self.rigs[0].node)
        self.counts = (0, 0, 0)
        self.taken = 0

    def give(self, cob_id: int, data: bytes) -> None:
        ours, shipped = self.rigs
        shipped.give(cob_id, data)
        if not self.by_rule(cob_id, data):
            ours.give(cob_id, data)

    def by_rule(self, cob_id: int, data: bytes) -> bool:
        work, rig = self.work, self.rigs[0]
        if not work.take():
            return False
        rule = {SYNC: rules.on_sync, DRIVE: rules.on_drive, CONTROLLER: rules.on_heartbeat}[cob_id]
        before = work.memory.tobytes()
        if not rule(work.record[0], work.memory[0], len(data), word_of(data), rig.now_us):
            assert work.memory.tobytes() == before
            return False
        if cob_id == SYNC:
            self.answer()
        work.put()
        self.taken += 1
        return True

    def answer(self) -> None:
        """What surrounds the rules at a SYNC: the plant, and the response time."""
        work, rig, memory = self.work, self.rigs[0], self.work.memory[0]
        a, b, c = memory["output"].tolist()
        memory["count"] = rig.plant.exchange(rig.now_us, (a, b, c), sample=True)
        assert memory["due_us"] == rig.now_us + 7
        counts, t_us = sample_at(rig.now_us), rig.now_us
        word = int(rules.answer(work.record[0], memory))
        data = bytes_of(word, rules.LENGTH)
        assert data == protected(SENSE, counts, int(memory["sense_counter"]))

        def send() -> None:
            rig.node._transmit(SENSE, data)

        rig.clock.call_at(t_us + 7, send)

    def happen(self, case: str) -> None:
        rig = self.rigs[1]
        match case:
            case "sync":
                self.give(SYNC, bytes((rig._sync % 240 + 1,)))
                rig._sync = rig._sync % 240 + 1
            case "odd sync":
                self.give(SYNC, bytes((rig._sync % 240 + 2,)))
            case "long sync":
                self.give(SYNC, bytes((rig._sync % 240 + 1, 0)))
            case "beat" | "boot":
                self.give(CONTROLLER, b"\x05" if case == "beat" else b"\x00")
            case "nothing":
                pass
            case _:
                self.give(DRIVE, self.drive(case))
        for each in self.rigs:
            each.run(100)

    def drive(self, case: str) -> bytes:
        rig = self.rigs[1]
        a, b, c = self.counts = {"zero": (0, 0, 0), "far": (20_000, 0, 0)}.get(
            case, tuple(min(count + 100, 32_000) for count in self.counts)
        )  # type: ignore[assignment]
        rig._counter = (rig._counter + (2 if case == "counter" else 1)) % 256
        data = protected(DRIVE, (-a - 1, b, c) if case == "negative" else (a, b, c), (rig._counter - 1) % 256)
        if case == "crc":
            return data[:7] + bytes((data[7] ^ 1,))
        return data[:7] if case == "short" else data + b"\0" if case == "long" else data

    def same(self) -> None:
        ours, shipped = self.rigs
        assert [frame for frame in ours.sent if frame[1].can_id in (SENSE, EMCY)] == [
            frame for frame in shipped.sent if frame[1].can_id in (SENSE, EMCY)
        ]
        assert ours.plant.driven == shipped.plant.driven
        assert (ours.node.state, ours.node.outputs) == (shipped.node.state, shipped.node.outputs)
        assert ours.node._drive.pending == shipped.node._drive.pending
        assert ours.node._drive.counter == shipped.node._drive.counter
        assert ours.node._drive.crc == shipped.node._drive.crc
        assert ours.node._sync_expected == shipped.node._sync_expected
        assert ours.node.emergency.active == shipped.node.emergency.active
        dues = [[alarm.due_us for alarm in rig.node.work_alarms] for rig in self.rigs]
        assert dues[0][::2] == dues[1][::2]  # heartbeats do not ride here


@given(cases=st.lists(st.sampled_from(CASES), max_size=40))
@example(cases=["drive", "sync"] * 12)
@example(cases=["beat", "drive", "sync", "sync", "drive", "sync", "drive", "sync"])
@settings(max_examples=150, deadline=None)
def test_a_rule_does_what_the_node_does_or_nothing(cases: list[str]) -> None:
    twin = Twin()
    for case in cases:
        twin.happen(case)
        twin.same()
    assert twin.taken <= len(cases)


def test_a_quiet_cycle_is_all_by_rule() -> None:
    twin = Twin()
    for case in ["drive", "sync"] * 20:
        twin.happen(case)
    twin.same()
    assert twin.taken == 40
    assert twin.rigs[0].node.outputs == (2000, 2000, 2000)


# -- each condition of the rules alone -------------------------------------------------------------------------------

T_US = 10_000


def at_work(**memory: object) -> NodeAtWork:
    """A node in its daily work at ``T_US``, SYNC 7 expected, 100 counts at each comb and 200 pending."""
    twin = Twin()
    assert twin.work.take()
    values = {"pending": 200, "output": 100, "is_pending": 1, "sync_expected": 7, "due_us": rules.NEVER_US}
    for name, value in (values | memory).items():
        twin.work.memory[name] = value
    return twin.work


def synced(work: NodeAtWork, length: int = 1, word: int = 7) -> bool:
    return bool(rules.on_sync(work.record[0], work.memory[0], length, word, T_US))


@pytest.mark.parametrize(
    ("memory", "taken"),
    [
        ({}, True),
        ({"is_pending": 0}, False),
        ({"good_us": T_US}, False),
        ({"good_us": T_US + 1}, True),
        ({"due_us": T_US + 5}, False),
        ({"sync_expected": 8}, False),
        ({"pending": (0, 0, 0), "output": 32_000}, True),
        *(({"pending": [600 if n == comb else 0 for n in range(3)], "output": 0}, False) for comb in range(3)),
        *(({"pending": [500 if n == comb else 0 for n in range(3)], "output": 0}, True) for comb in range(3)),
        *(
            ({"pending": [100 if n == comb else 1 for n in range(3)], "output": [600, 1, 1]}, comb == 0)
            for comb in (0, 1)
        ),
        ({"pending": (99, 100, 100), "output": (600, 100, 100)}, False),
    ],
)
def test_a_sync_is_taken_if_all_is_as_it_should_be(memory: dict[str, object], taken: bool) -> None:
    work = at_work(**memory)
    before = work.memory.tobytes()
    assert synced(work) == taken
    assert (work.memory.tobytes() == before) != taken


def test_a_sync_of_another_length_is_left_alone() -> None:
    assert not synced(at_work(), length=0)
    assert not synced(at_work(), length=2)
    work = at_work(sync_expected=0)
    work.record["sync_overflow"] = 0
    assert not synced(work)
    assert synced(work, length=0, word=0)
    assert work.memory["sync_expected"][0] == 0


def test_what_a_sync_leaves_behind() -> None:
    work = at_work(sync_us=T_US - 190)
    work.record["drive_timeout_us"], work.record["turnaround_us"] = 20_000, 7
    assert synced(work)
    m = work.memory[0]
    assert (m["sync_us"], m["cycle_us"], m["due_us"]) == (T_US, 190, T_US + 7)
    assert (m["drive_deadline_us"], m["is_pending"], m["output"].tolist()) == (T_US + 20_000, 0, [200, 200, 200])


@pytest.mark.parametrize("comb", [0, 1, 2])
@pytest.mark.parametrize(("count", "taken"), [(32_767, True), (-32_768, False), (-1, False)])
def test_counts_go_to_the_limit_and_no_further(comb: int, count: int, taken: bool) -> None:
    work = at_work(drive_counter=6, is_pending=0)
    counts = [0, 0, 0]
    counts[comb] = count
    word = word_of(protected(DRIVE, (counts[0], counts[1], counts[2]), 7))
    assert rules.on_drive(work.record[0], work.memory[0], 8, word, T_US) == taken
    assert work.memory["is_pending"][0] == taken
    assert (work.memory["pending"][0].tolist() == counts) == taken


def test_the_counter_of_syncs_goes_round() -> None:
    work = at_work(sync_expected=240)
    assert synced(work, word=240)
    assert work.memory["sync_expected"][0] == 1


@pytest.mark.parametrize(("good_us", "taken"), [(T_US, False), (T_US + 1, True), (rules.NEVER_US, True)])
def test_a_good_drive_frame_that_ends_an_error_is_the_nodes_own(good_us: int, taken: bool) -> None:
    work = at_work(good_us=good_us, drive_counter=255)
    word = word_of(protected(DRIVE, (1, 2, 3), 0))
    assert rules.on_drive(work.record[0], work.memory[0], 8, word, T_US) == taken
    assert (work.memory["pending"][0].tolist() == [1, 2, 3]) == taken


@pytest.mark.parametrize(("length", "state", "taken"), [(1, 5, True), (1, 0, False), (2, 5, False), (0, 5, False)])
def test_the_controllers_heartbeat(length: int, state: int, taken: bool) -> None:
    work = at_work(consumer_us=T_US + 1)
    assert rules.on_heartbeat(work.record[0], work.memory[0], length, state, T_US) == taken
    assert work.memory["consumer_us"][0] == (T_US + 50_000 if taken else T_US + 1)


def test_the_next_alarm_is_the_first_of_three() -> None:
    for first in ("drive_deadline_us", "beat_us", "consumer_us"):
        others = dict.fromkeys(("drive_deadline_us", "beat_us", "consumer_us"), T_US + 2)
        assert rules.next_alarm_us(at_work(**others | {first: T_US + 1}).memory[0]) == T_US + 1


@pytest.mark.parametrize(("beat_us", "rides"), [(T_US + 200, True), (T_US + 201, False)])
def test_a_heartbeat_rides_where_the_next_sense_frame_would_take_it_too_late(beat_us: int, rides: bool) -> None:
    work = at_work(beat_us=beat_us, cycle_us=200)
    work.record["beat_period_us"] = 20_000
    assert rules.rides(work.record[0], work.memory[0], T_US) == rides
    assert work.memory["beat_us"][0] == (T_US + 20_000 if rides else beat_us)


def test_who_does_something_else_than_its_daily_work_is_left_to_itself() -> None:
    """Another mapping; outputs that act on reception; no frame yet; one that is owed; a zero that is due."""
    assert Twin().work.take()
    for odd in ("_is_owed", "_is_zero_due"):
        twin = Twin()
        setattr(twin.rigs[0].node._drive, odd, True)
        assert not twin.work.take()
    twin = Twin()
    twin.rigs[0].node._drive.counter = None
    assert not twin.work.take()
    rig = Rig()
    assert rig.write(0x1401, 2, 240, 1) == 0  # at each SYNC, as well
    rig.start()
    rig.cycle((0, 0, 0))
    rig.cycle((0, 0, 0))
    assert rig.node._drive.is_usual is True
    for index, subindex, value, size in ((0x1401, 2, 255, 1), (0x1601, 1, 0x64110310, 4)):
        rig = Rig()
        assert rig.write(0x1401, 1, 0x80000000 | DRIVE, 4) == 0
        if index == 0x1601:
            assert rig.write(0x1601, 0, 0, 1) == rig.write(0x1601, 3, 0x64110110, 4) == 0
        assert rig.write(index, subindex, value, size) == 0
        if index == 0x1601:
            assert rig.write(0x1601, 0, 5, 1) == 0
        assert rig.write(0x1401, 1, DRIVE, 4) == 0
        rig.start()
        rig.cycle((0, 0, 0))
        rig.cycle((0, 0, 0))
        assert not NodeAtWork(rig.node).take()


def request(key: int, command: int = 0x40) -> int:
    """The word of an SDO request."""
    return word_of(bytes((command,)) + key.to_bytes(3, "little") + bytes(4))


def test_what_a_start_up_reads_is_answered_as_the_node_answers_it() -> None:
    """Every object of the dictionary, again after one was written; what is looked up when it is asked for is not."""
    rig = Rig()
    rig.start()
    rig.nmt(128)
    work = NodeAtWork(rig.node)
    for value in (500, 700):
        assert rig.write(0x2011, 0, value, 2) == 0
        assert work.take_at_rest() == 127
        answered = set()
        for entry in rig.node.od:
            word = request(entry.index | entry.subindex << 16)
            if (reply := rules.read(work.record[0], work.memory[0], 8, word)) != 0:
                answered.add(entry.index)
                assert bytes_of(reply, 8) == rig.node._sdo.serve(bytes_of(word, 8))
        assert {0x1000, 0x1018, 0x1401, 0x1601, 0x1A01, 0x2011, 0x2012, 0x6444} <= answered
        assert not {0x1003, 0x1008, 0x2000, 0x2001, 0x2020, 0x6401, 0x6411} & answered
    assert bytes_of(rules.read(work.record[0], work.memory[0], 8, request(0x2011)), 8)[4:6] == (700).to_bytes(
        2, "little"
    )
    odd = request(0x2011, 0x4F)  # bits that CiA 301 keeps for later
    assert bytes_of(rules.read(work.record[0], work.memory[0], 8, odd), 8) == rig.node._sdo.serve(bytes_of(odd, 8))
    rig.node._sdo._multiplexer = bytes(3)
    work.put_at_rest()
    assert rig.node._sdo._multiplexer == b"\x11\x20\x00"


@pytest.mark.parametrize(
    ("length", "word"),
    [(7, request(0x1000)), (8, request(0x1000, 0x23)), (8, request(0x1000, 0x60)), (8, request(0x1000, 0x80)),
     (8, request(0x7777)), (8, request(0x011000)), (8, request(0x1008))],
)  # fmt: skip
def test_a_request_that_is_no_read_of_a_few_bytes_is_the_nodes_own(length: int, word: int) -> None:
    work = NodeAtWork(Rig().node)
    work.node.state = NmtState.PRE_OPERATIONAL
    assert work.take_at_rest() == 127
    assert rules.read(work.record[0], work.memory[0], 8, request(0x1000)) != 0
    work.memory["served_key"] = -1
    assert rules.read(work.record[0], work.memory[0], length, word) == 0
    assert work.memory["served_key"][0] == -1


def test_a_stopped_node_takes_heartbeats_and_leaves_nmt_to_itself() -> None:
    twin = Twin()
    rig, work = twin.rigs[0], twin.work
    rig.give(CONTROLLER, b"\x05")
    rig.nmt(2)
    assert work.take_at_rest() == rules.STOPPED
    node, memory = work.record[0], work.memory[0]
    for can_id in (SYNC, DRIVE, 0x600 + rig.node.node_id):
        assert rules.on_frame_stopped(node, memory, can_id, 8, 0, T_US)
    assert not rules.on_frame_stopped(node, memory, 0, 2, 1, T_US)
    assert rules.on_frame_stopped(node, memory, CONTROLLER, 1, 5, T_US)
    assert memory["consumer_us"] == T_US + 50_000
    assert not rules.on_frame_stopped(node, memory, CONTROLLER, 1, 0, T_US + 1), "it has restarted: the node's own"
    assert memory["consumer_us"] == T_US + 50_000
    memory["consumer_us"] = rules.NEVER_US  # it was missed, and has come again
    assert not rules.on_frame_stopped(node, memory, CONTROLLER, 1, 5, T_US)

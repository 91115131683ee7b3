"""The medium without faults: who goes first, when frames start and end, and what the load is.

The oracle is a schedule worked out by hand from frame durations, which have their own tests.
"""

import gc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.bus.clock import Lockstep
from hil.bus.frame_time import FrameFormatError, frame_duration_ns
from hil.bus.published_wires import find_wire, publish
from hil.bus.wire import Wire
from pkxyz_ctrl.can.frame import Frame

NOMINAL, FAST = 1_000_000, 5_000_000
INTERFRAME_NS = 3000
Seen = list[tuple[int, Frame]]


def wire_with(*names: str, fast: int | None = FAST) -> tuple[Lockstep, Wire, dict[str, Seen], list]:
    clock = Lockstep()
    wire = Wire(clock, NOMINAL, fast)
    seen: dict[str, Seen] = {name: [] for name in names}
    ends = [wire.attach(n, lambda frame, t_us, n=n: seen[n].append((t_us, frame))) for n in names]
    return clock, wire, seen, ends


def duration_ns(frame: Frame) -> int:
    return frame_duration_ns(frame, NOMINAL, FAST)


def ceil_us(t_ns: int) -> int:
    return -(-t_ns // 1000)


def test_a_frame_arrives_at_the_end_of_its_eof_at_all_others() -> None:
    clock, _, seen, (a, _, _) = wire_with("a", "b", "c")
    frame = Frame(0x30A, b"12345678", True, True)
    confirmed: Seen = []
    a.on_sent = lambda frame, t_us: confirmed.append((t_us, frame))
    clock.run_until(1000)
    assert a.send(frame)
    end_us = ceil_us(1_000_000 + duration_ns(frame) - INTERFRAME_NS)
    clock.run_until(end_us - 1)
    assert seen == {"a": [], "b": [], "c": []}
    assert a.pending() == 1
    clock.run_until(end_us)
    assert seen == {"a": [], "b": [(end_us, frame)], "c": [(end_us, frame)]}
    assert confirmed == [(end_us, frame)]
    assert a.pending() == 0


frames = st.tuples(st.integers(0, 2047), st.binary(max_size=8), st.booleans(), st.booleans()).map(
    lambda f: Frame(f[0], f[1], f[2], f[2] and f[3])
)


@given(queue=st.lists(st.tuples(st.integers(0, 2), frames), min_size=1, max_size=12, unique_by=lambda q: q[1].can_id))
@settings(max_examples=100)
def test_all_queued_frames_pass_lowest_identifier_first_and_back_to_back(queue: list[tuple[int, Frame]]) -> None:
    clock, _, seen, ends = wire_with("0", "1", "2")
    clock.run_until(50)
    for sender, frame in queue:
        ends[sender].send(frame)
    clock.run_until(100_000)
    start_ns, expected = 50_000, {"0": [], "1": [], "2": []}
    for sender, frame in sorted(queue, key=lambda q: q[1].can_id):
        start_ns += duration_ns(frame)
        for name in expected:
            if name != str(sender):
                expected[name].append((ceil_us(start_ns - INTERFRAME_NS), frame))
    assert seen == expected


@given(
    plan=st.lists(st.tuples(st.integers(0, 600), st.integers(0, 2), frames), min_size=1, max_size=12).filter(
        lambda plan: len({p[2].can_id for p in plan}) == len(plan)
    ),
    sent_before=st.booleans(),
)
@settings(max_examples=200)
def test_frames_queued_at_any_time_follow_the_reference_schedule(
    plan: list[tuple[int, int, Frame]], sent_before: bool
) -> None:
    """Reference: whenever the wire is free, the lowest identifier among all that wait by then starts.

    What was sent before takes a shorter way through the code, and must not take a shorter one through time.
    """
    clock, wire, _, ends = wire_with("0", "1", "2")
    if sent_before:
        for _, sender, frame in plan:
            ends[sender].send(frame)
        clock.run_until(20_000)
    log: Seen = []
    begin_us = clock.now_us
    plan = [(begin_us + t_us, sender, frame) for t_us, sender, frame in plan]
    listener = wire.attach("log", lambda frame, t_us: log.append((t_us, frame)), listen_only=True)
    for t_us, sender, frame in plan:
        clock.call_at(t_us, lambda sender=sender, frame=frame: ends[sender].send(frame))
    clock.run_until(begin_us + 20_000)
    waiting, free_ns, expected = sorted(plan, key=lambda p: p[0]), 0, []
    while waiting:
        start_ns = max(free_ns, waiting[0][0] * 1000)
        best = min((p for p in waiting if p[0] * 1000 <= start_ns), key=lambda p: p[2].can_id)
        waiting.remove(best)
        free_ns = start_ns + duration_ns(best[2])
        expected.append((ceil_us(free_ns - INTERFRAME_NS), best[2]))
    assert log == expected
    listener.detach()


def test_a_later_but_lower_identifier_wins_only_until_the_start_of_frame() -> None:
    slow, urgent = Frame(0x600, b"slow"), Frame(0x080, b"\x01")
    clock, _, seen, (a, b, _) = wire_with("a", "b", "c")
    clock.call_at(10, lambda: a.send(slow))
    clock.call_at(10, lambda: b.send(urgent))  # the same microsecond: both compete
    clock.call_at(500, lambda: a.send(slow))
    clock.call_at(501, lambda: b.send(urgent))  # too late
    clock.run_until(2000)
    assert [frame for _, frame in seen["c"]] == [urgent, slow, slow, urgent]


def test_one_endpoint_sends_its_lowest_identifier_first_and_equal_ones_in_order() -> None:
    clock, _, seen, (a, _) = wire_with("a", "b")
    queued = [Frame(5, b"x"), Frame(7, b"1"), Frame(3, b"y"), Frame(7, b"2"), Frame(7, b"3")]
    clock.call_at(0, lambda: [a.send(f) for f in queued])
    clock.run_until(5000)
    assert [f.data for _, f in seen["b"]] == [b"y", b"x", b"1", b"2", b"3"]


@pytest.mark.parametrize(
    ("loser", "winner"),
    [
        (Frame(5, b"", is_remote=True), Frame(5, b"\x00")),  # RTR
        (Frame(5 << 18, b"\x00", is_extended=True), Frame(5, b"\x00")),  # SRR and IDE
        (Frame(5 << 18, b"\x00", is_extended=True), Frame(5, b"", is_remote=True)),  # IDE
        (Frame(5 << 18, b"", is_extended=True, is_remote=True), Frame(5 << 18, b"\x00", is_extended=True)),
        (Frame(6, b"\x00"), Frame(5 << 18 | 0x3FFFF, b"\x00", is_extended=True)),  # base identifier before all else
        (Frame(0x123_4568, b"", is_extended=True), Frame(0x123_4567, b"", is_extended=True)),
    ],
)
def test_arbitration_compares_the_bits_on_the_wire(loser: Frame, winner: Frame) -> None:
    clock, wire, seen, (a, b, _) = wire_with("a", "b", "c")
    clock.call_at(0, lambda: (a.send(loser), b.send(winner)))
    clock.run_until(1000)
    assert [f for _, f in seen["c"]] == [winner, loser]
    assert wire.statistics().error_frames == 0


def test_the_nanoseconds_do_not_drift() -> None:
    """1000 frames back to back with a fractional duration end where their sum says, rounded once."""
    clock, wire, seen, (a, b) = wire_with("a", "b")
    frame = Frame(0x123, b"\x01", True, True)
    assert duration_ns(frame) % 1000 != 0
    a.on_sent = lambda f, t_us: a.send(frame) if len(seen["b"]) < 999 else None
    a.send(frame)
    clock.run_until(100_000)
    assert len(seen["b"]) == 1000
    assert seen["b"][-1][0] == ceil_us(1000 * duration_ns(frame) - INTERFRAME_NS)
    assert wire.statistics().busy_ns == 1000 * duration_ns(frame)
    assert b.pending() == 0


@given(checkpoints=st.lists(st.integers(1, 3000), min_size=1, max_size=10))
@settings(max_examples=50)
def test_bus_load_is_the_fraction_of_time_taken_over_any_window(checkpoints: list[int]) -> None:
    clock, wire, _, (a, _) = wire_with("a", "b")
    frame = Frame(0x30A, b"12345678")
    taken_us = duration_ns(frame) // 1000
    for k in range(40):
        clock.call_at(200 * k, lambda: a.send(frame))
    then, busy_at = wire.statistics(), lambda t: sum(min(max(t - 200 * k, 0), taken_us) for k in range(40))
    for step in checkpoints:
        t0 = clock.now_us
        clock.run_until(t0 + step)
        load = wire.bus_load(then)
        assert load == pytest.approx((busy_at(clock.now_us) - busy_at(t0)) / step, abs=1e-12)
        assert 0.0 <= load <= 1.0
        then = wire.statistics()
    assert wire.bus_load() == pytest.approx(busy_at(clock.now_us) / clock.now_us, abs=1e-12)


def test_queues_have_limits_and_count_what_they_lose() -> None:
    clock = Lockstep()
    wire = Wire(clock, NOMINAL)
    a, b = wire.attach("a", queue_limit=3), wire.attach("b", queue_limit=2)
    assert [a.send(Frame(1, bytes([k]))) for k in range(4)] == [True, True, True, False]
    assert a.send_drops == 1
    clock.run_until(1000)
    assert [b.receive_nowait()[0].data for _ in range(2)] == [b"\x00", b"\x01"]
    assert b.receive_nowait() is None
    assert b.overruns == 1


def test_a_full_queue_may_be_emptied_before_anything_is_lost() -> None:
    clock = Lockstep()
    wire = Wire(clock, NOMINAL)
    a, kept = wire.attach("a"), []
    patient = wire.attach("patient", queue_limit=2, on_full=lambda: kept.append(patient.receive_all()))
    helpless = wire.attach("helpless", queue_limit=2, on_full=lambda: None)
    for k in range(5):
        a.send(Frame(k, b""))
    clock.run_until(1000)
    assert [[frame.can_id for frame, _ in block] for block in [*kept, patient.receive_all()]] == [[0, 1], [2, 3], [4]]
    assert [frame.can_id for frame, _ in helpless.receive_all()] == [0, 1]
    assert (patient.overruns, helpless.overruns) == (0, 3)


@pytest.mark.parametrize("by_queue", [False, True])
def test_whoever_is_unplugged_during_a_delivery_gets_no_more_of_it(by_queue: bool) -> None:
    clock, wire, _, (a, b) = wire_with("a", "b")
    late: Seen = []
    c = wire.attach("c", None if by_queue else lambda frame, t_us: late.append((t_us, frame)))
    wire.attach("d")  # so that enough of them stay
    a.send(Frame(1, b""))
    clock.run_until(1000)
    assert len(late) + len(c.receive_all()) == 1
    late.clear()
    b.on_frame = lambda frame, t_us: c.detach()
    a.send(Frame(1, b""))
    clock.run_until(2000)
    assert late == []
    assert c.receive_all() == []
    assert c.overruns == 0


def test_what_a_wire_cannot_carry_is_refused_at_send() -> None:
    _, _, _, (a, _) = wire_with("a", "b", fast=None)
    with pytest.raises(FrameFormatError, match="FD frame on a classic wire"):
        a.send(Frame(1, b"", True))
    with pytest.raises(FrameFormatError, match="11 bits"):
        a.send(Frame(2048, b""))
    with pytest.raises(FrameFormatError, match="error frame"):
        a.send(Frame(1, b"", is_error=True))
    assert a.pending() == 0


def test_endpoints_come_and_go() -> None:
    clock, wire, seen, (a, b, c) = wire_with("a", "b", "c")
    with pytest.raises(ValueError, match="'a' is attached already"):
        wire.attach("a")
    b.detach()
    b.detach()
    with pytest.raises(RuntimeError, match="detached"):
        b.send(Frame(1, b""))
    c.send(Frame(9, b""))
    a.send(Frame(1, b""))
    a.detach()  # before anything was on the wire: its frame is gone, and the other's wins
    d = wire.attach("d")
    clock.run_until(1000)
    assert d.receive_nowait()[0] == Frame(9, b"")
    assert seen == {"a": [], "b": [], "c": []}
    listener = wire.attach("listener", listen_only=True)
    with pytest.raises(RuntimeError, match="listen-only"):
        listener.send(Frame(1, b""))


def test_a_send_that_was_kept_from_before_is_refused_after_detaching() -> None:
    """As a port keeps it; also where the short way would be open: calm wire, frame of a kind that was sent before."""
    clock, _, seen, (_, b, _) = wire_with("a", "b", "c")
    send, frame = b.send, Frame(1, b"")
    for _ in range(3):
        assert send(frame)
        clock.run_until(clock.now_us + 1000)
    b.detach()
    with pytest.raises(RuntimeError, match="detached"):
        send(frame)
    assert [len(seen[name]) for name in "abc"] == [3, 0, 3]


def test_flush_leaves_the_frame_on_the_wire_alone() -> None:
    clock, _, seen, (a, _) = wire_with("a", "b")
    for data in (b"1", b"2", b"3"):
        a.send(Frame(1, data))
    clock.run_until(20)
    a.flush()
    clock.run_until(1000)
    assert [f.data for _, f in seen["b"]] == [b"1"]
    a.send(Frame(1, b"4"))
    a.flush()  # its start of frame is this very microsecond: not yet on the wire
    clock.run_until(2000)
    assert [f.data for _, f in seen["b"]] == [b"1"]
    assert a.send_drops == 3


def test_published_wires_are_found_while_they_live() -> None:
    wire = Wire(Lockstep(), NOMINAL)
    publish(wire, "test-wire")
    publish(wire, "test-wire")
    assert find_wire("test-wire") is wire
    with pytest.raises(ValueError, match="another wire"):
        publish(Wire(Lockstep(), NOMINAL), "test-wire")
    del wire
    gc.collect()  # a wire and what hangs on it know each other
    assert find_wire("test-wire") is None


@pytest.mark.parametrize(("nominal", "fast"), [(0, None), (-1, None), (1_000_000, 500_000)])
def test_impossible_bit_rates(nominal: int, fast: int | None) -> None:
    with pytest.raises(ValueError, match="bit rates"):
        Wire(Lockstep(), nominal, fast)

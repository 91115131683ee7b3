"""Destroyed frames, error counters, bus-off and recovery, against the rules of ISO 11898-1, 12.1.4."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.bus.clock import Lockstep
from hil.bus.disturbance import CORRUPTED, DROPPED, FrameFate
from hil.bus.endpoint import ErrorState
from hil.bus.fault_confinement import ERROR_ACK, ERROR_BUS, ERROR_BUS_OFF, ERROR_PROTOCOL, ERROR_RESTARTED
from hil.bus.frame_time import frame_duration_ns
from hil.bus.wire import Wire
from pkxyz_ctrl.can.frame import Frame

BITRATE = 1_000_000
FRAME = Frame(0x28A, b"12345678")
FRAME_US = frame_duration_ns(FRAME, BITRATE, BITRATE) // 1000
ERROR_US = 8  # the error delimiter comes on top: the flags lie where EOF would have been


def two(**options: bool) -> tuple[Lockstep, Wire, list]:
    clock = Lockstep()
    wire = Wire(clock, BITRATE, seed=1)
    return clock, wire, [wire.attach("a", **options), wire.attach("b", **options)]


def received(endpoint) -> list[tuple[Frame, int]]:
    return list(iter(endpoint.receive_nowait, None))


@given(count=st.integers(0, 15))
@settings(max_examples=16)
def test_a_destroyed_frame_is_sent_again_and_counted(count: int) -> None:
    clock, wire, (a, b) = two()
    if count:
        wire.disturbance.corrupt_next(lambda frame: frame.can_id == FRAME.can_id, count)
    wire.disturbance.corrupt_next(lambda frame: frame.can_id == 1)
    a.send(FRAME)
    clock.run_until(20_000)
    assert received(b) == [(FRAME, count * (FRAME_US + ERROR_US) + FRAME_US - 3)]
    assert wire.statistics()[1:] == (((count + 1) * FRAME_US + count * ERROR_US) * 1000, 1, count)
    assert (a.transmit_errors, a.receive_errors) == (max(0, 8 * count - 1), 0)
    assert (b.transmit_errors, b.receive_errors) == (0, max(0, count - 1))
    for _ in range(8 * count):  # each success takes one off, to zero and no further
        a.send(FRAME)
        clock.run_until(clock.now_us + 200)
    assert (a.transmit_errors, b.receive_errors) == (0, 0)
    assert a.state == b.state == ErrorState.ACTIVE


def test_sixteen_errors_make_passive_and_passive_waits_eight_bits() -> None:
    clock, wire, (a, b) = two()
    wire.disturbance.corrupt_next(count=16)
    a.send(FRAME)
    while a.transmit_errors < 128:
        clock.run_until_event()
    assert a.state == ErrorState.PASSIVE
    assert wire.statistics().error_frames == 16
    free_us = 16 * (FRAME_US + ERROR_US)
    clock.run_until(free_us + 8 + FRAME_US - 3)
    assert received(b) == [(FRAME, free_us + 8 + FRAME_US - 3)]
    assert a.transmit_errors == 127
    assert a.state == ErrorState.ACTIVE


def test_during_its_suspension_another_goes_first_even_with_a_higher_identifier() -> None:
    clock, wire, (a, b) = two()
    c = wire.attach("c")
    wire.disturbance.corrupt_next(lambda frame: frame == FRAME, 16)
    a.send(FRAME)
    while a.transmit_errors < 128:
        clock.run_until_event()
    late = Frame(0x700, b"z")
    clock.run_until(16 * (FRAME_US + ERROR_US) + 4)  # within the 8 bits
    b.send(late)
    clock.run_until(10_000)
    assert [f for f, _ in received(c)] == [late, FRAME]


def test_receivers_go_passive_but_never_off() -> None:
    clock, wire, (a, b) = two()
    for _ in range(40):
        wire.disturbance.corrupt_next(count=14)
        a.transmit_errors = 0  # keeps the sender active: only the receiver is looked at here
        a.send(FRAME)
        clock.run_until(clock.now_us + 20 * (FRAME_US + ERROR_US))
    # +14 - 1 each time up to 128, whence a success leads to 127
    assert b.receive_errors == 127
    assert not b.bus_off
    wire.disturbance.corrupt_next()
    a.send(FRAME)
    clock.run_until(clock.now_us + FRAME_US)
    assert (b.receive_errors, b.state) == (128, ErrorState.PASSIVE)


def test_thirty_two_errors_mean_bus_off_and_what_waited_is_discarded() -> None:
    clock, wire, (a, b) = two(error_frames=True, auto_recover=False)
    wire.disturbance.corrupt_next(count=10_000)
    for k in range(3):
        a.send(Frame(0x28A, bytes([k])))
    clock.run_until(100_000)
    assert wire.statistics().error_frames == 32
    assert (a.state, a.transmit_errors, a.pending(), a.send_drops) == (ErrorState.BUS_OFF, 256, 0, 3)
    assert not a.send(FRAME)
    kinds = [f.can_id for f, _ in received(b)]
    assert kinds == [ERROR_PROTOCOL | ERROR_BUS] * 31 + [ERROR_BUS_OFF, ERROR_PROTOCOL | ERROR_BUS]
    # without automatic recovery it stays off
    clock.run_until(1_000_000)
    assert a.bus_off


def bus_off(clock: Lockstep, wire: Wire, endpoint) -> int:
    """Drive ``endpoint`` bus-off; the time in us at which the wire is free again."""
    wire.disturbance.corrupt_next(count=32)
    endpoint.send(FRAME)
    while not endpoint.bus_off:
        clock.run_until_event()
    return wire._free_ns // 1000


def test_recovery_takes_128_times_11_recessive_bits_of_an_idle_wire() -> None:
    clock, wire, (a, b) = two(error_frames=True)
    free_us = bus_off(clock, wire, a)
    clock.run_until(free_us + 128 * 11 - 1)
    assert a.bus_off
    clock.run_until(free_us + 128 * 11)
    assert (a.state, a.transmit_errors, a.receive_errors) == (ErrorState.ACTIVE, 0, 0)
    assert received(b)[-1][0].can_id == ERROR_RESTARTED
    received(b)
    assert a.send(FRAME)
    clock.run_until(clock.now_us + 200)
    assert received(b)[0][0] == FRAME


def test_recovery_on_a_busy_wire_counts_one_run_per_frame() -> None:
    clock, wire, (a, b) = two()
    wire.attach("c")
    bus_off(clock, wire, a)
    sent_before = wire.statistics().frames
    b.on_sent = lambda frame, t_us: b.send(FRAME)  # back to back, so there is never an idle bit
    b.send(FRAME)
    while a.bus_off:
        clock.run_until_event()
    assert wire.statistics().frames - sent_before == 128
    assert received(a) == []


def test_recovery_on_request() -> None:
    clock, wire, (a, _) = two(auto_recover=False)
    free_us = bus_off(clock, wire, a)
    clock.run_until(free_us + 5000)
    a.recover()
    a.recover()
    clock.run_until(free_us + 5000 + 1407)
    assert a.bus_off
    clock.run_until(free_us + 5000 + 1408)
    assert not a.bus_off


def test_alone_nobody_acknowledges_and_it_never_goes_bus_off() -> None:
    clock = Lockstep()
    wire = Wire(clock, BITRATE)
    lonely = wire.attach("lonely", error_frames=True)
    log = wire.attach("log", listen_only=True)
    lonely.send(FRAME)
    clock.run_until(50_000)
    assert (lonely.state, lonely.transmit_errors) == (ErrorState.PASSIVE, 128)
    assert {f.can_id for f, _ in received(lonely)} == {ERROR_ACK | ERROR_BUS}
    assert received(log) == []
    wire.attach("company")
    clock.run_until(51_000)
    assert [f for f, _ in received(log)] == [FRAME]


def test_equal_frames_at_once_pass_as_one() -> None:
    clock, wire, (a, b) = two()
    c = wire.attach("c")
    a.send(FRAME)
    b.send(FRAME)
    clock.run_until(1000)
    assert received(c) == [(FRAME, FRAME_US - 3)]
    assert (received(a), received(b), a.pending(), b.pending()) == ([], [], 0, 0)
    assert wire.statistics().error_frames == 0


def test_one_identifier_from_two_senders_with_different_data_is_an_error_until_they_are_passive() -> None:
    clock, wire, (a, b) = two()
    c = wire.attach("c")
    dominant = FRAME._replace(data=b"02345678")
    b.send(dominant)
    a.send(FRAME)
    clock.run_until(1000)
    assert received(c) == []
    assert a.transmit_errors == b.transmit_errors == 8 * wire.statistics().error_frames > 0
    clock.run_until(100_000)
    # after 16 collisions both are passive: flags of theirs disturb nobody, so the dominant bit's owner gets through
    assert [f for f, _ in received(c)] == [dominant, FRAME]
    assert wire.statistics().error_frames == 16


def test_unplugging_in_the_middle_of_a_frame_cuts_it_off() -> None:
    clock, wire, (a, b) = two()
    c = wire.attach("c")
    a.send(FRAME)
    b.send(Frame(0x700, b"z"))
    clock.run_until(30)
    a.detach()
    clock.run_until(1000)
    assert [f.can_id for f, _ in received(c)] == [0x700]
    assert wire.statistics().error_frames == 1
    assert c.receive_errors == 0  # +1 and -1


@pytest.mark.parametrize(
    ("outcome", "expected"),
    [
        (None, [(0, FRAME)]),
        (DROPPED, []),
        (FrameFate(deliveries=((0, FRAME), (0, FRAME))), [(0, FRAME), (0, FRAME)]),
        (FrameFate(deliveries=((70, FRAME),)), [(70, FRAME)]),
        (FrameFate(deliveries=((0, FRAME._replace(data=b"garbage!")),)), [(0, FRAME._replace(data=b"garbage!"))]),
        (CORRUPTED, []),
    ],
)
def test_a_fault_tap_decides_what_receivers_get(outcome: FrameFate | None, expected: list[tuple[int, Frame]]) -> None:
    clock, wire, (a, b) = two()
    asked = []

    def tap(frame: Frame, sender: str, t_us: int) -> FrameFate | None:
        asked.append((frame, sender, t_us))
        return outcome

    wire.disturbance.set_tap(tap)
    a.send(FRAME)
    clock.run_until(FRAME_US)  # one frame, no retransmission yet
    assert asked == [(FRAME, "a", FRAME_US - 3)]
    clock.run_until(FRAME_US + 75)
    wire.disturbance.set_tap(None)
    assert not wire.disturbance.armed
    assert received(b) == [(frame, FRAME_US - 3 + delay) for delay, frame in expected]
    assert a.pending() == (outcome is CORRUPTED)


def test_bit_errors_come_at_their_rate_and_by_their_seed() -> None:
    def errors(seed: int) -> list[int]:
        clock = Lockstep()
        wire = Wire(clock, BITRATE, seed=seed)
        a, seen = wire.attach("a"), []
        wire.attach("b", lambda frame, t_us: seen.append(t_us))
        wire.disturbance.set_bit_error_rate(1e-3)
        for k in range(2000):
            a.send(FRAME)
            clock.run_until((k + 1) * 1000)
        return [*seen, wire.statistics().error_frames]

    first = errors(1)
    assert errors(1) == first
    assert errors(2) != first
    # P(frame) = 1 - (1 - 1e-3)^bits; the tries are 2000 successes and as many failures as happen: mean p/(1-p)
    p = 1 - (1 - 1e-3) ** FRAME_US
    mean, sigma = 2000 * p / (1 - p), (2000 * p) ** 0.5 / (1 - p)
    assert abs(first[-1] - mean) < 4 * sigma
    with pytest.raises(ValueError, match="not within"):
        Wire(Lockstep()).disturbance.set_bit_error_rate(2.0)


@given(
    seed=st.integers(0, 2**16),
    plan=st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 2), st.integers(1, 6)), max_size=40),
)
@settings(max_examples=60)
def test_nothing_is_lost_doubled_or_reordered_by_bit_errors(seed: int, plan: list[tuple[int, int, int]]) -> None:
    """As long as nobody goes bus-off, every frame arrives exactly once, and those of one identifier in order."""
    clock = Lockstep()
    wire = Wire(clock, BITRATE, seed=seed)
    log: list[Frame] = []
    ends = [wire.attach(str(k)) for k in range(3)]
    wire.attach("log", lambda frame, t_us: log.append(frame), listen_only=True)
    wire.disturbance.set_bit_error_rate(5e-4)
    sent: list[Frame] = []

    def send(sender: int, can_id: int) -> None:
        frame = Frame(can_id * 3 + sender, len(sent).to_bytes(2, "big"))
        sent.append(frame)
        ends[sender].send(frame)

    for t_us, sender, can_id in sorted(plan):
        clock.call_at(t_us, lambda sender=sender, can_id=can_id: send(sender, can_id))
    clock.run_until(60_000)
    assert not any(e.bus_off for e in ends)
    assert sorted(log) == sorted(sent)
    for can_id in {f.can_id for f in sent}:
        assert [f for f in log if f.can_id == can_id] == [f for f in sent if f.can_id == can_id]

"""When the amplifier node takes its combs to 0 V by itself, and what it wants before it gives them a voltage again."""

from collections.abc import Callable

import pytest
from node_rig import EMCY, SYNC, Rig, emergencies, operational

ZERO = (0, 0, 0)
LATE, STEP, MISSING = 0xFF13, 0xFF14, 0x8250


@pytest.mark.parametrize("syncs", [0, 1, 5, 255])
def test_combs_are_released_when_no_drive_pdo_comes(syncs: int) -> None:
    rig = Rig()
    rig.write(0x2010, 0, syncs, 1)
    rig.write(0x2012, 0, 1000, 2)  # the time-out that does not need SYNC
    rig.start()
    rig.forget()
    rig.cycle((4, 5, 6))
    applied_us = rig.now_us
    for _ in range(600):
        rig.cycle()
    if syncs == 0:
        assert rig.plant.driven == [(applied_us, (4, 5, 6))]
        return
    assert rig.plant.driven == [(applied_us, (4, 5, 6)), (applied_us + 200 * syncs, ZERO)]
    assert emergencies(rig) == [MISSING]
    for _ in range(3):  # what was queued while the bus was blocked
        rig.cycle((7, 7, 7))
        rig.sync()
        assert rig.node.outputs == ZERO
    rig.cycle(ZERO)
    rig.cycle((7, 7, 7))
    rig.sync()
    assert rig.node.outputs == (7, 7, 7)


@pytest.mark.parametrize(
    ("step_max", "change", "applied"), [(9, 9, True), (9, -9, True), (9, 10, False), (9, -10, False)]
)
@pytest.mark.parametrize("comb", [0, 1, 2])
def test_a_step_at_a_sync_is_limited_whatever_the_frame_says(
    step_max: int, change: int, applied: bool, comb: int
) -> None:
    rig = Rig()
    rig.write(0x2011, 0, step_max, 2)
    rig.start()
    rig.forget()
    held = [9, 9, 9]
    rig.cycle((9, 9, 9))
    rig.cycle((9 + 9, 9 + 9, 9 + 9))
    rig.cycle((18, 18, 18))
    rig.forget()
    held = [18, 18, 18]
    held[comb] += change
    a, b, c = held
    rig.cycle((a, b, c))
    rig.sync()
    rig.run(2000)
    assert rig.node.outputs == ((a, b, c) if applied else ZERO)
    assert emergencies(rig) == ([] if applied else [STEP])
    if not applied:
        assert rig.of(EMCY)[0][3] == 1 << comb
        rig.cycle((1, 1, 1))
        rig.sync()
        assert rig.node.outputs == ZERO  # nothing before 0 V
    else:
        rig.cycle(ZERO)
        rig.sync()
        assert rig.node.outputs == ZERO  # which is no step too far from anywhere


@pytest.mark.parametrize("timeout_ms", [1, 20, 1000])
def test_combs_are_released_in_time_when_no_sync_comes(timeout_ms: int) -> None:
    """Drive frames, even with 0 V, act at a SYNC: where none comes, the node has a time of its own."""
    rig = Rig()
    rig.write(0x2012, 0, timeout_ms, 2)
    rig.start()
    rig.forget()
    rig.cycle((4, 5, 6))
    applied_us = rig.now_us
    rig.sync()
    while rig.now_us < applied_us + 1000 * timeout_ms + 500:
        rig.drive(ZERO)
        rig.run(100)
    assert rig.plant.driven == [(applied_us, (4, 5, 6)), (applied_us + 1000 * timeout_ms, ZERO)]
    assert emergencies(rig) == [MISSING]


def released_by_silence(rig: Rig) -> None:
    for _ in range(7):
        rig.cycle()


def released_by_a_step(rig: Rig) -> None:
    rig.cycle((5000, 5, 5))
    rig.cycle((5, 5, 5))


def released_by_a_missed_sync(rig: Rig) -> None:
    rig._sync += 1
    rig.cycle((5, 5, 5))


def released_by_a_sync_that_was_missed_while_nothing_waited(rig: Rig) -> None:
    rig.cycle()
    rig._sync += 1
    rig.cycle()


def released_by_time(rig: Rig) -> None:
    rig.run(21_000)


@pytest.mark.parametrize(
    "release",
    [
        released_by_silence, released_by_a_step, released_by_a_missed_sync,
        released_by_a_sync_that_was_missed_while_nothing_waited, released_by_time,
    ],
)  # fmt: skip
def test_what_the_node_has_released_is_energised_by_nothing_but_0_v_first(release: Callable[[Rig], None]) -> None:
    """A second frame in sequence is no longer late, and would be taken: one with 0 V is owed."""
    rig = Rig()
    rig.write(0x2011, 0, 100, 2)
    rig.energise((5, 5, 5))
    release(rig)
    assert rig.node.outputs == ZERO
    for _ in range(5):
        rig.cycle((5, 5, 5))
        assert rig.node.outputs == ZERO
    rig.forget()
    rig.cycle(ZERO)
    rig.cycle((5, 5, 5))
    rig.sync()
    assert rig.node.outputs == (5, 5, 5)
    assert LATE not in emergencies(rig)  # what was refused for want of 0 V makes the next one no later


@pytest.mark.parametrize("again", [(128, 1), (129, 1)])
def test_a_new_start_owes_nothing_and_takes_any_counter(again: tuple[int, int]) -> None:
    rig = Rig()
    rig.energise((5, 5, 5))
    for _ in range(3):
        rig.cycle()  # SYNCs without a frame: the next one would be late
    released_by_silence(rig)  # and 0 V would be due
    rig.nmt(again[0])
    rig.run(10_000)
    if again[0] == 128:
        rig.drive(ZERO)  # not heard, and so no counter to follow
    rig._counter = (rig._counter + 77) % 256
    rig.forget()
    rig.start()
    if again[0] == 128:
        rig.cycle(ZERO)
    rig.cycle((6, 6, 6))
    rig.sync()
    rig.run(2000)
    assert rig.node.outputs == (6, 6, 6)
    assert emergencies(rig) in ([], [0])  # at most the end of what was before


def test_a_frame_that_was_refused_for_want_of_0_v_makes_the_next_one_no_later() -> None:
    rig = Rig()
    rig.write(0x2011, 0, 100, 2)
    rig.energise((5, 5, 5))
    released_by_a_step(rig)
    for _ in range(3):
        rig.cycle((5, 5, 5))
    rig.cycle(ZERO)
    rig.run(2000)
    assert emergencies(rig) == [STEP]


def test_a_frame_before_the_first_sync_of_a_new_start_is_not_late_for_one_of_before() -> None:
    rig = Rig()
    rig.energise((5, 5, 5))
    rig.cycle()
    rig.cycle()  # a SYNC without a frame
    rig.nmt(128)
    rig.start()
    rig.forget()
    rig.drive((6, 6, 6))
    rig.sync()
    rig.run(2000)
    assert (rig.node.outputs, emergencies(rig)) == ((6, 6, 6), [])


def test_that_none_arrives_is_said_at_zero_volts_too_and_nothing_else_comes_of_it() -> None:
    """Or a controller that commands 0 V would never hear that its drive PDOs do not arrive."""
    rig = operational()
    for cycle in range(1, 50):
        rig.cycle()
        assert bool(rig.of(EMCY)) == (cycle >= rig.node.od[0x2010, 0])
    assert (rig.plant.driven, emergencies(rig)) == ([], [0x8250])
    rig.drive((5, 5, 5))  # no combs were released, so no 0 V is asked for first; it is the first, so it is not late
    rig.sync()
    assert rig.node.outputs == (5, 5, 5)


def test_at_zero_volts_the_time_without_a_drive_pdo_is_watched_once_one_has_come() -> None:
    rig = operational()
    limit_us = 1000 * rig.node.od[0x2012, 0]
    rig.run(3 * limit_us)
    assert rig.of(EMCY) == []
    rig.drive(ZERO)
    rig.sync()
    rig.run(limit_us - 1000)
    assert rig.of(EMCY) == []
    rig.run(2000)
    assert emergencies(rig) == [0x8250]
    rig.forget()
    rig.cycle(ZERO)
    rig.cycle(ZERO)
    rig.nmt(128)
    rig.run(200_000)
    assert 0x8250 not in emergencies(rig)  # outside operational nobody sends any


def test_error_mode_and_value_of_each_comb() -> None:
    rig = Rig()
    assert rig.write(0x6443, 2, 0, 1) == rig.write(0x6444, 3, 55, 4) == 0
    rig.energise((100, 200, 300))
    rig.nmt(128)
    assert rig.plant.driven[-1] == (rig.now_us, (0, 200, 55))
    assert [rig.read(0x6411, i) for i in (1, 2, 3)] == [0, 200, 55]


def test_silence_is_counted_from_the_start() -> None:
    rig = Rig()
    for _ in range(3):  # five in a row is what is told
        rig.start()
        for _ in range(4):
            rig.cycle()
        rig.nmt(128)
    assert emergencies(rig) == []


def test_a_sync_that_is_none_is_a_cycle_without_a_drive_frame_too() -> None:
    """Or a controller whose SYNC is spoilt would hold its last voltage for as long as 0x2012 says."""
    rig = Rig()
    assert rig.write(0x2012, 0, 65535, 2) == 0
    rig.energise((5, 5, 5))
    rig.cycle((5, 5, 5))
    for left in (4, 3, 2, 1, 0):
        rig.give(SYNC, b"\xf1")
        assert rig.node.outputs == ((5, 5, 5) if left else ZERO)


def test_what_was_sent_while_a_fault_held_the_combs_is_no_counter_to_follow() -> None:
    """The controller goes on, unheard: its next frame with 0 V is the one that ends it."""
    rig = Rig()
    rig.energise((5, 5, 5))
    rig.node.amplifier_fault(0x2310)
    for _ in range(3):
        rig.cycle((5, 5, 5))
    rig.node.clear_amplifier_fault(0x2310)
    rig.cycle(ZERO)
    rig.cycle((6, 6, 6))
    rig.sync()
    rig.run(5_000)
    assert (rig.node.outputs, emergencies(rig)) == ((6, 6, 6), [0x2310, 0])


def test_of_a_step_too_far_only_the_combs_that_make_it_are_named() -> None:
    rig = Rig()
    assert rig.write(0x2011, 0, 9, 2) == 0
    rig.energise((9, 9, 9))
    rig.cycle((18, 0, 19))  # as far as it may, back as far, one further
    rig.sync()
    rig.run(2_000)
    assert rig.node.outputs == ZERO
    assert rig.of(EMCY)[0][3] == 0b100

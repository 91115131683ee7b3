"""What goes out at the end of a period: voltages, and behind them as many short frames as there is room for."""

import pytest
from test_exchange import AT_WORK, DRIVE, OURS, OUTPUT, PERIOD_US, SHORT_US, Bench

from pkxyz_ctrl.can.driver_rules import NEVER_US, DriverState
from pkxyz_ctrl.loop import exchange
from pkxyz_ctrl.loop.exchange import BLOCKED
from pkxyz_ctrl.safety.modes import Mode

WAIT_US = 5_000  # how long our heartbeat may be put off


def drive_data(*counts: int) -> bytes:
    return b"".join(count.to_bytes(2, "little", signed=True) for count in counts)


def test_the_voltages_of_the_cycle_go_out() -> None:
    bench = Bench()
    bench.voltages(1, 2, 3)
    assert bench.finish() == 1
    ((can_id, data),) = bench.sent
    assert (can_id, data[:7]) == (DRIVE, drive_data(1, 2, 3) + b"\1")
    assert bench.memory["blocked"] == 0


def test_a_blocked_voltage_becomes_0_v_under_its_counter_and_nothing_follows() -> None:
    bench = Bench()
    bench.voltages(5, 6, 7)
    bench.finish()
    bench.begin()
    bench.voltages(1, 32_000, 3)
    bench.driver["heartbeat_next_us"], bench.memory["outputs"][0]["bits"] = bench.now_us, 3
    assert bench.finish() == BLOCKED | 3
    blocked = bench.driver["out"][0]
    assert (blocked["can_id"], blocked["reason"] != 0) == (DRIVE, True)
    assert bench.ids == [DRIVE, OURS]
    assert bench.sent[0][1][:7] == drive_data(0, 0, 0) + b"\2"
    assert bench.memory["blocked"] == 1
    held, gate = bench.memory["held_against"][0], bench.memory["gate"][0]
    assert (held["count"].tolist(), held["counter_next"], held["time_us"]) == ([5, 6, 7], 2, bench.now_us - PERIOD_US)
    assert gate["count"].tolist() == [0, 0, 0]


def test_where_0_v_does_not_pass_either_only_the_first_frame_is_told() -> None:
    """Held back twice in a tick: the node has it already."""
    bench = Bench()
    bench.finish()
    bench.voltages(1, 32_000, 3)
    assert bench.finish() == BLOCKED | 1
    assert bench.sent == []


@pytest.mark.parametrize("mode", Mode)
def test_outputs_go_out_at_work_and_our_heartbeat_always(mode: Mode) -> None:
    bench = Bench(mode)
    bench.memory["outputs"][0]["bits"], bench.driver["heartbeat_next_us"] = 5, bench.now_us
    told = bench.finish()
    expected = [DRIVE, OUTPUT, OURS] if mode in AT_WORK else [DRIVE, OURS]
    assert bench.ids == expected
    assert told == len(expected)
    if mode in AT_WORK:
        assert bench.sent[1][1] == b"\5"
        assert bench.driver["output"] == 5


@pytest.mark.parametrize(
    ("late_us", "until_us", "sent"), [(-1, 100, False), (0, 0, True), (1, 0, True), (0, -1, False)]
)
def test_our_heartbeat_goes_out_when_it_is_due_and_there_is_room(late_us: int, until_us: int, sent: bool) -> None:
    bench = Bench()
    bench.driver["heartbeat_next_us"] = bench.now_us - late_us
    bench.finish(until_us)
    assert (bench.ids == [DRIVE, OURS]) == sent


def test_outputs_that_the_gate_holds_back_do_not_go_out() -> None:
    bench = Bench()
    bench.memory["outputs"][0]["bits"] = 0x20
    assert bench.finish() == BLOCKED | 2
    assert bench.ids == [DRIVE]
    assert bench.memory["blocked"] == 1


@pytest.mark.parametrize("mode", [Mode.BOOT, Mode.FAULT])
def test_where_there_are_no_outputs_our_heartbeat_has_their_room(mode: Mode) -> None:
    bench = Bench(mode)
    bench.driver["heartbeat_next_us"] = bench.now_us
    bench.finish(0)
    assert bench.ids == [DRIVE, OURS]


@pytest.mark.parametrize(("until_us", "ids"), [(SHORT_US, [DRIVE, OUTPUT, OURS]), (SHORT_US - 1, [DRIVE, OUTPUT])])
def test_behind_outputs_there_has_to_be_room_for_it_as_well(until_us: int, ids: list[int]) -> None:
    bench = Bench()
    bench.memory["outputs"][0]["bits"], bench.driver["heartbeat_next_us"] = 1, bench.now_us
    bench.finish(until_us)
    assert bench.ids == ids


@pytest.mark.parametrize(("near", "until_us", "sent"), [(0, 0, True), (1, SHORT_US - 1, False), (1, SHORT_US, True)])
def test_the_nodes_signature_needs_its_room(near: int, until_us: int, sent: bool) -> None:
    bench = Bench()
    bench.driver["signature"], bench.driver["signature_age"] = 9, 240 if near else 100
    bench.driver["heartbeat_next_us"] = bench.now_us
    bench.finish(until_us)
    assert (bench.ids == [DRIVE, OURS]) == sent


@pytest.mark.parametrize("signature", [-1, 0, 9])
def test_when_the_signature_is_near(signature: int) -> None:
    """From the period on in which it is due, for four, and once more; a third is not waited for."""
    bench = Bench()
    bench.driver["signature"] = signature
    near = []
    for age in range(3 * 240 + 10):
        bench.driver["signature_age"] = age
        found = exchange._is_signature_near(bench.config[0]["driver"][0], bench.driver)
        assert found in (True, False)
        if found:
            near.append(age + 1)
    assert near == ([] if signature < 0 else [*range(240, 244), *range(480, 484)])


@pytest.mark.parametrize(
    ("left_us", "room"),
    [(-1, 0), (0, 1), (SHORT_US - 1, 1), (SHORT_US, 2), (2 * SHORT_US - 1, 2), (2 * SHORT_US, 3), (9 * SHORT_US, 3)],
)
def test_how_many_short_frames_fit(left_us: int, room: int) -> None:
    """One may begin as late as is said, each more needs its length before."""
    bench = Bench()
    bench.driver["node_heartbeat_us"] = -NEVER_US
    config = bench.config[0]["driver"][0]
    assert exchange._short_frames(config, bench.driver, 900, 1000, 1000 + left_us) == room


@pytest.mark.parametrize(
    ("ahead_us", "room"),
    [(-PERIOD_US, 3), (1 - PERIOD_US, 2), (0, 2), (2 * PERIOD_US, 2), (2 * PERIOD_US + 1, 3), (9 * PERIOD_US, 3)],
)
def test_the_nodes_heartbeat_takes_the_room_of_one(ahead_us: int, room: int) -> None:
    bench = Bench()
    config = bench.config[0]["driver"][0]
    begun_us = 7_000
    bench.driver["node_heartbeat_us"] = begun_us + ahead_us - int(config["node_period_us"])
    assert exchange._short_frames(config, bench.driver, begun_us, begun_us + 50, begun_us + 1000) == room


def put(bench: Bench, bits: int, room: int) -> int:
    bench.driver["outgoing"] = 0
    config, memory = bench.config["driver"][0], bench.all["driver"][0]
    return int(exchange._put_outputs(config, memory, bits, bench.now_us, room))


def test_outputs_are_sent_when_they_change_and_where_there_are_any() -> None:
    bench = Bench()
    assert put(bench, 3, 1) == 1
    assert bench.sent == [(OUTPUT, b"\3")]
    assert put(bench, 3, 1) == 0
    assert put(bench, 0, 1) == 1
    bench.driver["has_outputs"] = 0
    assert put(bench, 3, 1) == 0
    bench.driver["has_outputs"], bench.driver["state"] = 1, DriverState.FAILED.value
    assert put(bench, 3, 1) == 0
    assert bench.sent == []


def test_a_bit_that_rose_without_room_goes_out_later_and_one_that_fell_is_forgotten() -> None:
    bench = Bench()
    assert put(bench, 0b011, 1) == 1
    assert put(bench, 0b110, 0) == 0
    assert (bench.driver["output"], bench.driver["output_owed"]) == (0b011, 0b100)
    assert put(bench, 0b1000, 0) == 0
    assert bench.driver["output_owed"] == 0b1100
    assert put(bench, 0, 1) == 1
    assert bench.sent == [(OUTPUT, b"\x0c")]
    assert (bench.driver["output"], bench.driver["output_owed"]) == (0b1100, 0)
    assert put(bench, 0, 1) == 1
    assert bench.sent == [(OUTPUT, b"\0")]


@pytest.mark.parametrize(
    ("late_us", "room", "sent"),
    [(WAIT_US - 1, 1, 1), (WAIT_US, 1, 0), (WAIT_US, 2, 1), (WAIT_US - 1, 0, 0), (WAIT_US + 1, 1, 0)],
)
def test_our_heartbeat_waits_for_outputs_only_so_long(late_us: int, room: int, sent: int) -> None:
    bench = Bench()
    assert bench.config["driver"]["heartbeat_wait_us"][0, 0] == WAIT_US
    bench.driver["heartbeat_next_us"] = bench.now_us - late_us
    assert put(bench, 1, room) == sent

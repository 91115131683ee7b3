"""What the driver does at work beside voltages: outputs, the node's signature, a release; each condition alone."""

from binascii import crc_hqx
from random import Random

import pytest
from scripted_node import (
    BOOT_UP,
    OPERATIONAL,
    OUR_HEARTBEAT,
    PRE_OP,
    PRE_OPERATIONAL,
    RESET,
    START,
    ObedientServer,
    frame,
    heartbeat,
    run_dialogue,
    started,
    text,
    try_out,
)

from pkxyz_ctrl.can import driver_rules, start_plan
from pkxyz_ctrl.can.driver import FOREIGN_FRAME, SAFETY_OBJECTS, AmplifierDriver, word_of
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import NEVER_US, DriverState
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.can.startup import table
from pkxyz_ctrl.safety.monitors import NodeEvent

NODE_EVENTS = ("HEARTBEAT_LOST", "NOT_OPERATIONAL", "REBOOTED", "EMERGENCY")
SYNCS = 10  # from one signature to the next
ALL: dict[str, object] = {"digital_outputs": True, "signature_syncs": SYNCS}
OFF, ON = "23 00 14 01 0a 02 00 80", "23 00 14 01 0a 02 00 00"  # RPDO 1
READ_OVERFLOW, WRITE_OVERFLOW = "40 19 10 00 00 00 00 00", "2f 19 10 00 f0 00 00 00"


def place_of(index: int, subindex: int) -> str:
    return f"{index & 0xFF:02x} {index >> 8:02x} {subindex:02x}"


def signed(store: dict[str, str]) -> int:
    """CRC-16-CCITT from 0xFFFF, by Python's own function, of all that keeps the combs safe."""
    crc = 0xFFFF
    for setting in sorted(table(DriverConfig()), key=lambda setting: setting.key):
        place = place_of(*setting.key)
        if setting.part >= start_plan.COB_ID and place in store:
            crc = crc_hqx(bytes.fromhex(place) + bytes.fromhex(store[place])[: setting.size], crc)
    return crc


class Whole(ObedientServer):
    """It has digital outputs, and signs what it holds."""

    def __init__(self, answers: dict[str, str] | None = None) -> None:
        super().__init__(answers)
        self.store |= {"00 62 01": "00 00 00 00", "20 20 01": "00 00 00 00"}
        self.commands |= {"00 62 01": "2f", "20 20 01": "2b"}

    def answer(self, sent: Frame) -> Frame:
        self.store["20 20 01"] = signed(self.store).to_bytes(4, "little").hex(" ")
        return super().answer(sent)


def whole(server: ObedientServer) -> AmplifierDriver:
    """An operational driver that asked for outputs and signature."""
    driver = AmplifierDriver(DriverConfig(**ALL))
    driver.start(0)
    assert run_dialogue(driver, server, driver.receive(heartbeat(BOOT_UP), 0)) == [OUR_HEARTBEAT, START]
    try_out(driver, 0)
    assert driver.state is DriverState.OPERATIONAL
    return driver


def told(driver: AmplifierDriver, sent: str) -> int:
    """What the rules say of a frame."""
    can_id, data, flags = frame(sent)
    return int(driver_rules.receive(driver.record, driver.memory, can_id, flags, len(data), word_of(data), 9))


# -- what the node has -------------------------------------------------------------------------------------------------


def test_outputs_and_signature_are_there_where_the_node_has_them_and_they_were_asked_for() -> None:
    server = Whole()
    driver = whole(server)
    assert driver.lost == ()
    assert driver.memory["has_outputs"][0] == 1
    assert driver.memory["signature"][0] == signed(server.store)
    plain = started()
    assert (plain.memory["has_outputs"][0], plain.memory["signature"][0]) == (0, -1)


def test_outputs_whose_pdo_stays_off_are_none() -> None:
    """It is off, and cannot be written; all else is as it should be."""
    server = Whole(dict.fromkeys((OFF, ON), "80 00 14 01 02 00 01 06"))
    server.store["00 14 01"] = "0a 02 00 80"
    driver = whole(server)
    assert driver.memory["has_outputs"][0] == 0
    assert "no digital outputs" in driver.lost[0]


def test_of_a_pdo_that_is_not_there_nothing_is_asked_twice() -> None:
    server = Whole({"40 00 14 01 00 00 00 00": "80 00 14 01 11 00 09 06"})
    driver = whole(server)
    assert driver.memory["has_outputs"][0] == 0
    assert server.requests.count("40 00 14 02 00 00 00 00") == 1


def test_a_node_without_outputs_and_signature_is_told_its_drive_pdo_all_the_same() -> None:
    absent = {
        f"40 {place} 00 00 00 00": f"80 {place} 00 00 02 06" for place in (place_of(0x6200, 1), place_of(0x2020, 1))
    }
    server = Whole(absent)
    driver = whole(server)
    assert server.store[place_of(0x1401, 1)] == "0a 03 00 00"
    assert (driver.memory["has_outputs"][0], driver.memory["signature"][0]) == (0, -1)
    assert place_of(0x1400, 1) not in server.store


# -- the signature -----------------------------------------------------------------------------------------------------


def signature_frame(driver: AmplifierDriver, value: int, length: int = 2) -> str:
    return f"{int(driver.record['signature_id'][0]):03x} {value.to_bytes(length, 'little').hex(' ')}"


@pytest.mark.parametrize("value", [None, 0])
def test_a_signature_that_stays_away_is_a_changed_node(value: int | None) -> None:
    """Two may be missed, and two ticks. 0 is one like any other."""
    driver = whole(Whole())
    if value is not None:
        driver.memory["signature"] = value
    own = int(driver.memory["signature"][0])
    for _ in range(2):
        for _ in range(2 * SYNCS + 2):
            driver.sync(10)
            assert driver.node_events == 0
        assert told(driver, signature_frame(driver, own)) == 0
    for _ in range(2 * SYNCS + 2):
        driver.sync(10)
    assert driver.node_events == 0
    driver.sync(10)
    assert driver.node_events == SAFETY_OBJECTS
    assert driver.state is DriverState.OPERATIONAL


@pytest.mark.parametrize(("change", "length"), [(1, 2), (0x8000, 2), (0, 3), (0, 4)])
@pytest.mark.parametrize("own", [0, 0x1234])
def test_another_signature_is_a_changed_node(change: int, length: int, own: int) -> None:
    driver = whole(Whole())
    driver.memory["signature"] = own
    assert told(driver, signature_frame(driver, own)) == 0
    assert driver.node_events == 0
    assert told(driver, signature_frame(driver, own ^ change, length)) == 0
    assert driver.node_events == SAFETY_OBJECTS


def test_whose_signature_nobody_waits_for_may_send_any() -> None:
    """One that was not relied on at the start; one that is released."""
    driver = whole(Whole())
    driver.memory["signature"] = -1
    told(driver, signature_frame(driver, 7))
    for _ in range(3 * SYNCS):
        driver.sync(10)
    assert driver.node_events == 0
    driver = whole(Whole())
    driver.release(10)
    told(driver, signature_frame(driver, int(driver.memory["signature"][0]) ^ 1))
    for _ in range(3 * SYNCS):
        driver.sync(20)
    assert driver.node_events == 0


# -- release -----------------------------------------------------------------------------------------------------------


def test_a_node_whose_safety_objects_were_changed_is_reset_and_then_kept_out_of_operational() -> None:
    """Its error values may be voltages by now; a reset takes them away."""
    driver = whole(Whole())
    driver.memory["node_events"] |= SAFETY_OBJECTS
    assert text(driver.release(10)) == [RESET]
    assert text(driver.release(20)) == [PRE_OP]
    failed = whole(Whole())
    failed.receive(heartbeat(PRE_OPERATIONAL), 5)
    failed.memory["node_events"] |= SAFETY_OBJECTS
    assert text(failed.release(10)) == [PRE_OP]


def test_from_a_release_on_nobody_is_watched_and_nothing_heard_of_us() -> None:
    driver = started()
    driver.release(100)
    assert driver.heartbeat_due(10**9) is None
    driver.sync(10**9)
    assert (driver.node_events, driver.state) == (0, DriverState.RELEASING)


def test_a_release_forgets_what_the_outputs_are_to_be() -> None:
    driver = whole(Whole())
    driver.memory["output"], driver.memory["output_owed"] = 3, 4
    driver.release(10)
    assert (driver.memory["output"][0], driver.memory["output_owed"][0]) == (0, 0)


def test_a_released_node_that_is_operational_again_hears_nothing_more_of_us() -> None:
    """So that its consumer misses us, until it is told once more."""
    driver = started()
    driver.release(0)
    driver.receive(heartbeat(PRE_OPERATIONAL), 100)
    assert driver.heartbeat_due(100) is not None
    driver.receive(heartbeat(OPERATIONAL), 200)
    assert driver.state is DriverState.RELEASING
    assert driver.heartbeat_due(10**9) is None


# -- what the rules say ------------------------------------------------------------------------------------------------


def test_the_rules_tell_what_a_frame_was_and_nothing_else() -> None:
    driver = started()
    for sent in ("58a 60 17 10 00 00 00 00 00", "080 05", "000 80 0b", "70a 05", "70a 05 05", "123 00"):
        assert told(driver, sent) == 0
    assert told(driver, "08a 10 23 03 00 00 00 00 00") == driver_rules.EMERGENCY
    assert told(driver, "08a 10 23") == 0
    driver.stop(10)
    assert told(driver, "080 05") == 0
    driver.release(20)
    for state in (OPERATIONAL, PRE_OPERATIONAL, PRE_OPERATIONAL):
        assert told(driver, f"70a {state}") == 0
    trial = AmplifierDriver(DriverConfig())
    trial.start(0)
    run_dialogue(trial, ObedientServer(), trial.receive(heartbeat(BOOT_UP), 0))
    assert told(trial, "08a 30 81 11 00 00 00 00 00") == 0
    assert told(trial, "08a 00 01 00 00 00 00 00 00") == driver_rules.EMERGENCY
    assert told(trial, "08a ff 00 00 00 00 00 00 00") == 0
    assert told(trial, "000 01 0b") == 0
    assert told(trial, "58a 60 17 10 00 00 00 00 00") == driver_rules.START_UP
    assert told(trial, "70a 05") == driver_rules.START_UP
    assert told(trial, "000 01 0a") == driver_rules.START_UP


@pytest.mark.parametrize("sent", ["20a 01", "20a"])
def test_a_frame_for_the_outputs_that_is_not_ours_is_noticed(sent: str) -> None:
    driver = whole(Whole())
    told(driver, sent)
    assert driver.node_events == FOREIGN_FRAME
    assert ", an RPDO 1 that this controller did not send" in driver.foreign
    plain = started()
    told(plain, sent)
    assert plain.node_events == 0


def test_a_node_that_does_not_count_syncs_gets_empty_ones() -> None:
    server = ObedientServer({READ_OVERFLOW: "4f 19 10 00 00 00 00 00", WRITE_OVERFLOW: "80 19 10 00 02 00 01 06"})
    driver = AmplifierDriver(DriverConfig())
    driver.start(0)
    run_dialogue(driver, server, driver.receive(heartbeat(BOOT_UP), 0))
    assert text((driver.sync(0), driver.sync(0))) == ["080 ", "080 "]


def test_a_frame_to_send_has_not_been_judged_yet() -> None:
    driver = started()
    driver.memory["out"]["reason"] = 9
    driver_rules.put(driver.record[0], driver.memory[0], 0x123, 1, 5)
    assert driver.memory["out"]["reason"][0, 0] == 0


@pytest.mark.parametrize(("counter", "before"), [(5, 4), (1, 0), (0, 255), (255, 254)])
def test_a_counter_that_is_taken_back(counter: int, before: int) -> None:
    driver = started()
    driver.memory["drive_counter"] = counter
    driver.revoke_drive()
    assert driver.drive((0, 0, 0), 0).data[6] == before


def test_before_it_is_started_a_driver_is_silent_and_watches_nobody() -> None:
    driver = AmplifierDriver(DriverConfig())
    assert driver.heartbeat_due(10**9) is None
    assert driver.poll(10**9) == ()
    driver.sync(10**9)
    assert (driver.node_events, driver.state) == (0, DriverState.OFF)


def test_what_is_switched_on_has_nothing_to_send_and_heard_of_nobody() -> None:
    driver = whole(Whole())
    driver.memory["outgoing"], driver.memory["node_heartbeat_us"] = 3, 4
    driver_rules.switch_on(driver.memory)
    assert (driver.memory["outgoing"][0], driver.memory["node_heartbeat_us"][0]) == (0, 0)
    assert driver.state is DriverState.OFF


# -- where heartbeats would meet ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("due_us", "sent_us", "next_us"),
    [
        (998, 998, 19_000),  # 1 ms behind the node's, which comes at 20 000: before it
        (999, 999, 19_000),
        (1_000, 1_000, 21_000),  # far enough
        (1_500, 1_500, 21_500),
        (19_000, 19_000, 39_000),  # far enough before
        (19_001, 19_001, 39_000),
        (500, 19_000, 20_500),  # it would be now
        (500, 18_999, 19_000),
    ],
)
def test_ours_is_put_before_the_nodes_where_they_would_meet(due_us: int, sent_us: int, next_us: int) -> None:
    driver = started()
    driver.memory["heartbeat_next_us"], driver.memory["node_heartbeat_us"] = due_us, 0
    driver.heartbeat_sent(sent_us)
    assert driver.memory["heartbeat_next_us"][0] == next_us


def divided(due_us: int, node_us: int, sent_us: int, ours_us: int, theirs_us: int) -> int:
    """When ours is due after one that was sent, by whole periods in Python's own numbers."""
    if sent_us < due_us:
        return due_us
    due_us += ((sent_us - due_us) // ours_us + 1) * ours_us
    after_us = (due_us - node_us + 1000) % theirs_us
    return due_us - after_us if after_us < 2000 < theirs_us and due_us - after_us > sent_us else due_us


def test_ours_is_due_where_whole_periods_put_it_however_late_and_silent_remains_silent() -> None:
    draw, driver = Random(3), started()
    for _ in range(20_000):
        ours_us, theirs_us = (1000 * draw.choice((1, 2, 3, 20, 65_535)) for _ in range(2))
        sent_us = draw.randint(0, 1 << draw.randint(1, 45))
        due_us = draw.choice((NEVER_US, sent_us - draw.randint(-3, draw.choice((5, 80, 10**9))) * ours_us // 2))
        node_us = sent_us - draw.randint(-1, draw.choice((3, 10**6))) * theirs_us // 2 + draw.randint(-1, 1)
        driver.record["heartbeat_period_us"], driver.record["node_period_us"] = ours_us, theirs_us
        driver.memory["heartbeat_next_us"], driver.memory["node_heartbeat_us"] = due_us, node_us
        driver.heartbeat_sent(sent_us)
        assert driver.memory["heartbeat_next_us"][0] == divided(due_us, node_us, sent_us, ours_us, theirs_us)


def test_how_long_ours_may_be_put_off_is_the_configurations() -> None:
    """One that is lost is survived all the same."""
    record = started().record[0]
    assert (record["heartbeat_wait_us"], record["period_us"], record["short_frame_us"]) == (5_000, 1_000, 65)
    assert started(controller_heartbeat_timeout_ms=80).record["heartbeat_wait_us"][0] == 20_000


def test_a_node_that_beats_every_two_milliseconds_leaves_no_room_to_keep_away() -> None:
    for period_ms, next_us in ((2, 20_500), (3, 20_000)):
        driver = started(node_heartbeat_period_ms=period_ms)
        driver.memory["heartbeat_next_us"], driver.memory["node_heartbeat_us"] = 500, 0
        driver.heartbeat_sent(500)
        assert driver.memory["heartbeat_next_us"][0] == next_us


def test_where_the_nodes_comes_at_another_time_ours_goes_out_of_its_way() -> None:
    driver = started()
    driver.memory["heartbeat_next_us"] = 40_500
    driver.receive(heartbeat(OPERATIONAL), 20_800)
    assert driver.memory["heartbeat_next_us"][0] == 39_800


def test_what_happened_to_the_node_is_told_in_the_bits_that_the_monitors_know() -> None:
    bits = {name: getattr(driver_rules, name) for name in ("FOREIGN_FRAME", "SAFETY_OBJECTS")}
    bits |= {name: getattr(driver_rules, f"NODE_{name}") for name in NODE_EVENTS}
    assert bits == {event.name: event.value for event in NodeEvent}

"""The start-up's conditions, each met alone: what a node lacks, holds or says at the wrong moment, and what follows."""

import pytest
from scripted_node import (
    BOOT_UP,
    OPERATIONAL,
    OUR_HEARTBEAT,
    PRE_OP,
    PRE_OPERATIONAL,
    START,
    ObedientServer,
    frame,
    heartbeat,
    run_dialogue,
    text,
    try_out,
)

from pkxyz_ctrl.can import driver_rules, start_sequence
from pkxyz_ctrl.can.driver import FOREIGN_FRAME, NODE_EMERGENCY, NODE_REBOOTED, AmplifierDriver
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.frame import Frame

READ_OVERFLOW, WRITE_OVERFLOW = "40 19 10 00 00 00 00 00", "2f 19 10 00 f0 00 00 00"
READ_SERIAL, NO_SUBINDEX = "40 18 10 04 00 00 00 00", "80 18 10 04 11 00 09 06"


def booted(server: ObedientServer, **config: object) -> tuple[AmplifierDriver, list[str]]:
    """A driver after the dialogue, and what it sent then."""
    driver = AmplifierDriver(DriverConfig(**config))
    driver.start(0)
    return driver, run_dialogue(driver, server, driver.receive(heartbeat(BOOT_UP), 0))


def test_nothing_is_lost_before_it_was_looked_for() -> None:
    driver = AmplifierDriver(DriverConfig(vendor_id=None))
    assert driver.lost == ()
    assert driver.node_state is None
    driver, _ = booted(ObedientServer(), vendor_id=None)
    assert 'identity "any"' in driver.lost[0]
    assert driver.node_state == 0
    driver.start(100)
    assert driver.lost == ()


# -- answers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("overflow", "starts"), [(0, True), (1, False), (2, True), (240, True), (241, False)])
def test_the_sync_counter_runs_as_the_node_says_within_what_the_standard_permits(overflow: int, starts: bool) -> None:
    server = ObedientServer({
        READ_OVERFLOW: f"4f 19 10 00 {overflow:02x} 00 00 00",
        WRITE_OVERFLOW: "80 19 10 00 02 00 01 06",  # read only: what is there is taken
    })  # fmt: skip
    driver, sent = booted(server)
    assert sent == ([OUR_HEARTBEAT, START] if starts else [])
    refusal = f"counts SYNCs to {overflow} (0x1019), CiA 301 permits 2 to 240"
    assert (refusal in driver.failure) != starts
    assert driver.memory["sync_overflow"][0] == (overflow if starts else 240)


def test_a_read_only_object_that_no_one_insists_on_may_also_be_long_but_a_write_is_not_ended_by_it() -> None:
    server = ObedientServer({READ_OVERFLOW: "41 19 10 00 20 00 00 00"})
    driver, sent = booted(server)
    assert sent == [OUR_HEARTBEAT, START]
    server = ObedientServer({WRITE_OVERFLOW: "41 19 10 00 20 00 00 00"})
    driver, sent = booted(server)
    assert (sent, driver.state) == ([], DriverState.CONFIGURING)
    server.answers.clear()
    assert run_dialogue(driver, server, driver.poll(50_000), 50_000) == [OUR_HEARTBEAT, START]


@pytest.mark.parametrize(
    ("code", "lacks"),
    [
        ("00 00 02 06", True),
        ("11 00 09 06", True),
        ("01 00 02 06", False),
        ("12 00 09 06", False),
        ("00 00 00 08", False),
    ],
)
def test_two_codes_say_that_there_is_no_such_object(code: str, lacks: bool) -> None:
    server = ObedientServer({READ_OVERFLOW: f"80 19 10 00 {code}", WRITE_OVERFLOW: "80 19 10 00 02 00 01 06"})
    driver, sent = booted(server)
    assert sent == [OUR_HEARTBEAT, START]
    assert any("no 0x1019" in words for words in driver.lost) == lacks
    assert (WRITE_OVERFLOW in server.requests) != lacks
    assert driver.memory["sync_overflow"][0] == 0


def test_an_answer_that_nobody_waits_for_changes_nothing() -> None:
    """Of the server, while the node boots or starts; and one that is too short."""
    answer = "58a 43 00 10 00 91 01 0c 00"
    driver = AmplifierDriver(DriverConfig())
    driver.start(0)
    assert driver.receive(frame(answer), 1) == ()
    assert driver.state is DriverState.RESETTING
    driver, _ = booted(ObedientServer())
    assert driver.receive(frame(answer), 1) == ()
    assert driver.state is DriverState.STARTING


def never_booted(retries: int = 0) -> AmplifierDriver:
    """It is asked all the same."""
    driver = AmplifierDriver(DriverConfig(boot_timeout_us=1000, sdo_timeout_us=1000, retries=retries))
    driver.start(0)
    for repeat in range(retries + 1):
        driver.poll(1000 * (repeat + 1))
    assert driver.state is DriverState.IDENTIFYING
    return driver


MISSED = "sent no boot-up message"


def test_a_boot_up_that_was_missed_is_the_cause_as_long_as_nothing_was_answered() -> None:
    driver = never_booted()
    driver.receive(frame("58a 80 00 10 00 00 00 00 08"), 1500)
    assert MISSED in driver.failure
    driver = never_booted()
    driver.poll(2000)
    assert MISSED in driver.failure


def test_a_node_that_boots_slowly_is_asked_again_and_not_said_to_restart() -> None:
    driver = never_booted()
    assert text(driver.receive(heartbeat(BOOT_UP), 1100)) == [PRE_OP, "60a 40 00 10 00 00 00 00 00"]
    driver.receive(frame("58a 80 00 10 00 00 00 00 08"), 1200)
    assert "was refused" in driver.failure
    driver = never_booted()
    driver.receive(heartbeat(BOOT_UP), 1100)
    driver.receive(heartbeat(BOOT_UP), 1200)
    assert "restarts again and again" in driver.failure


def test_each_request_is_repeated_as_often_as_is_said() -> None:
    driver = AmplifierDriver(DriverConfig(sdo_timeout_us=1000, retries=2))
    driver.start(0)
    driver.receive(heartbeat(BOOT_UP), 0)
    driver.receive(frame("58a 43 00 10 00 91 01 0c 00"), 0)
    assert [len(driver.poll(1000 * time)) for time in (1, 2, 3)] == [2, 2, 1]
    assert "asked 3 times" in driver.failure


def test_once_something_was_answered_it_is_not() -> None:
    for reply, words in (("58a 80 18 10 01 00 00 00 08", "was refused"), (None, "no answer to 0x1018:01")):
        driver = never_booted()
        driver.receive(frame("58a 43 00 10 00 91 01 0c 00"), 1500)
        if reply is None:
            driver.poll(2500)
        else:
            driver.receive(frame(reply), 1600)
        assert words in driver.failure
        assert MISSED not in driver.failure


class Forgetful(ObedientServer):
    """It has a counter of SYNCs when it is asked first, and none any more when it is to be written."""

    def answer(self, sent: Frame) -> Frame:
        asked = sent.data.hex(" ")
        if asked == READ_OVERFLOW and READ_OVERFLOW not in self.requests:
            self.answers = {READ_OVERFLOW: "4f 19 10 00 05 00 00 00"}
        elif asked in (READ_OVERFLOW, WRITE_OVERFLOW):
            self.answers = {asked: "80 19 10 00 00 00 02 06"}
        return super().answer(sent)


def test_what_turns_out_to_be_lacking_once_there_is_a_plan_holds_nothing() -> None:
    driver, sent = booted(Forgetful())
    assert sent == [OUR_HEARTBEAT, START]
    assert driver.memory["sync_overflow"][0] == 0


def test_a_counter_of_another_length_begins_at_1() -> None:
    server = ObedientServer({READ_OVERFLOW: "4f 19 10 00 05 00 00 00", WRITE_OVERFLOW: "80 19 10 00 02 00 01 06"})
    driver, _ = booted(server)
    try_out(driver, 0)
    assert [driver.sync(0).data[0] for _ in range(7)] == [1, 2, 3, 4, 5, 1, 2]


def test_a_request_has_eight_bytes() -> None:
    driver = AmplifierDriver(DriverConfig())
    driver_rules.switch_on(driver.memory)
    start_sequence.begin(driver.record, driver.memory, 0)
    driver.memory["outgoing"] = 0
    start_sequence.on_frame(driver.record, driver.memory, 0x70A, 0, 1, 0, 0)
    out = driver.memory["out"][0][: int(driver.memory["outgoing"][0])]
    assert [(int(each["can_id"]), int(each["length"])) for each in out] == [(0x000, 2), (0x60A, 8)]


# -- start and trial -------------------------------------------------------------------------------------------------


def test_a_node_that_does_not_tell_its_number_is_tried_each_time() -> None:
    for answers, tried_again in (({}, False), ({READ_SERIAL: NO_SUBINDEX}, True)):
        server = ObedientServer(answers)
        driver, _ = booted(server)
        try_out(driver, 0)
        assert driver.state is DriverState.OPERATIONAL
        driver.start(100)
        run_dialogue(driver, server, driver.receive(heartbeat(BOOT_UP), 100), 100)
        if tried_again:
            try_out(driver, 200)
        else:
            driver.receive(heartbeat(OPERATIONAL), 200)
        assert driver.state is DriverState.OPERATIONAL


def test_a_start_has_its_time_and_is_repeated_as_often_as_is_said() -> None:
    driver, _ = booted(ObedientServer(), start_timeout_us=5_000, retries=2)
    sent = {t_us: text(driver.poll(t_us)) for t_us in (1, 4_999, 5_000, 5_001, 9_999, 10_000, 14_999)}
    assert {t_us for t_us, frames in sent.items() if frames} == {5_000, 10_000}
    assert text(driver.poll(15_000)) == [PRE_OP]
    assert driver.state is DriverState.FAILED
    assert driver.heartbeat_due(10**9) is None
    assert driver.poll(10**9) == ()


def test_a_trial_has_its_time() -> None:
    """The node's consumer, 50 ms, and two heartbeats of its own."""
    driver, _ = booted(ObedientServer())
    driver.receive(heartbeat(OPERATIONAL), 1_000)
    assert driver.poll(1_001) == driver.poll(120_999) == ()
    assert driver.state is DriverState.TRYING
    assert text(driver.poll(121_000)) == [PRE_OP]
    assert "did not notice that our heartbeat ended: 120 ms later its heartbeat says operational" in driver.failure


def test_a_node_has_left_once_it_says_so_twice_in_a_row() -> None:
    driver, _ = booted(ObedientServer())
    driver.receive(heartbeat(OPERATIONAL), 0)
    for state in (PRE_OPERATIONAL, OPERATIONAL, PRE_OPERATIONAL):
        assert driver.receive(heartbeat(state), 10) == ()
    assert text(driver.receive(heartbeat(PRE_OPERATIONAL), 20)) == [OUR_HEARTBEAT, START]


def test_the_heartbeat_that_ended_the_start_up_is_the_first_that_the_loop_counts_from() -> None:
    driver, _ = booted(ObedientServer())
    try_out(driver, 7)
    driver.sync(50_007)
    assert driver.state is DriverState.OPERATIONAL
    driver.sync(50_008)
    assert "sent no heartbeat for 50.001 ms" in driver.failure


def test_a_node_whose_numbers_are_all_0_is_tried_like_any_other() -> None:
    """The driver has tried none yet, which is not the same as one of these numbers."""
    server = ObedientServer({f"40 18 10 0{part} 00 00 00 00": f"43 18 10 0{part} 00 00 00 00" for part in (1, 2, 3, 4)})
    driver, _ = booted(server, vendor_id=None, product_code=None)
    driver.receive(heartbeat(OPERATIONAL), 0)
    assert driver.state is DriverState.TRYING


def test_a_number_that_was_not_told_is_not_0() -> None:
    server = ObedientServer({READ_SERIAL: NO_SUBINDEX})
    driver, _ = booted(server)
    try_out(driver, 0)
    server.answers[READ_SERIAL] = "43 18 10 04 00 00 00 00"
    driver.start(100)
    run_dialogue(driver, server, driver.receive(heartbeat(BOOT_UP), 100), 100)
    driver.receive(heartbeat(OPERATIONAL), 200)
    assert driver.state is DriverState.TRYING


@pytest.mark.parametrize("sent", ["080 05", "000 01 0a", "000 01 00", "30a 00 00 00 00 00 00 00 00"])
def test_whoever_speaks_in_our_name_while_the_node_is_tried_ends_the_start(sent: str) -> None:
    driver, _ = booted(ObedientServer())
    driver.receive(heartbeat(OPERATIONAL), 0)
    assert text(driver.receive(frame(sent), 5)) == [PRE_OP]
    assert driver.state is DriverState.FAILED
    assert driver.failure == driver.foreign
    assert driver.failure.startswith(f"0x{sent[:3].upper()}")


def test_while_it_is_configured_a_foreign_frame_is_noted_and_the_dialogue_goes_on() -> None:
    driver, server = AmplifierDriver(DriverConfig()), ObedientServer()
    driver.start(0)
    sent = driver.receive(heartbeat(BOOT_UP), 0)
    while driver.state is DriverState.IDENTIFYING:
        sent = driver.receive(server.answer(sent[-1]), 0)
    assert driver.receive(frame("080 05"), 5) == ()
    assert driver.node_events & FOREIGN_FRAME
    assert run_dialogue(driver, server, sent) == [OUR_HEARTBEAT, START]


def test_an_emergency_of_before_the_start_counts_whatever_it_says() -> None:
    driver = AmplifierDriver(DriverConfig())
    driver.start(0)
    driver.receive(heartbeat(BOOT_UP), 0)
    driver.receive(frame("08a 30 81 11 00 00 00 00 00"), 1)
    assert driver.node_events & NODE_EMERGENCY


def test_a_boot_up_of_a_node_that_is_being_released_is_no_restart_of_its_own() -> None:
    driver, _ = booted(ObedientServer())
    try_out(driver, 0)
    driver.release(0)
    driver.receive(heartbeat(BOOT_UP), 10)
    assert not driver.node_events & NODE_REBOOTED
    assert driver.state is DriverState.RELEASED


# -- what has no room ------------------------------------------------------------------------------------------------


def test_what_has_no_room_among_the_frames_to_send_is_left_out_and_does_no_harm() -> None:
    driver = AmplifierDriver(DriverConfig())
    for number in range(driver_rules.OUTGOING_MOST + 2):
        driver_rules.put(driver.record[0], driver.memory[0], 0x100 + number, 1, number)
    assert driver.memory["outgoing"][0] == driver_rules.OUTGOING_MOST
    kept = driver.memory["out"][0]["can_id"].tolist()
    assert kept == [0x100 + number for number in range(driver_rules.OUTGOING_MOST)]


@pytest.mark.parametrize(("count", "sent"), [(-32769, -1), (-32768, -32768), (32767, 32767), (32768, -1)])
def test_a_count_that_has_no_room_becomes_one_that_no_gate_lets_pass(count: int, sent: int) -> None:
    driver = AmplifierDriver(DriverConfig())
    driver_rules.drive(driver.record, driver.memory, count, 0, 0)
    data = int(driver.memory["out"]["data"][0, 0])
    assert (data & 0xFFFF ^ 0x8000) - 0x8000 == sent

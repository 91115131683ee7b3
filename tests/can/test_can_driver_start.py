"""The driver's start-up as a scripted dialogue: literal bytes in, literal bytes out, no node behind it."""

import pytest
from scripted_node import (
    BOOT_UP,
    OPERATIONAL,
    OUR_HEARTBEAT,
    PRE_OP,
    PRE_OPERATIONAL,
    RESET,
    START,
    STOPPED,
    WRITES,
    ObedientServer,
    frame,
    heartbeat,
    run_dialogue,
    started,
    text,
    try_out,
)

from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.driver import (
    AmplifierDriver,
)
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.can.sense_input import SENSE_MISSING


def test_start_up_word_for_word():
    driver, server = AmplifierDriver(DriverConfig()), ObedientServer()
    assert text(driver.start(1000)) == [RESET]
    assert driver.state is DriverState.RESETTING
    assert driver.receive(heartbeat(OPERATIONAL), 1100) == ()  # from before the reset
    first = driver.receive(heartbeat(BOOT_UP), 2000)
    assert driver.state is DriverState.IDENTIFYING
    assert text(first)[0] == PRE_OP  # where a node that starts by itself is not
    assert run_dialogue(driver, server, first) == [OUR_HEARTBEAT, START]
    assert driver.state is DriverState.STARTING
    identity = ["00 10 00", "18 10 01", "18 10 02", "18 10 03", "18 10 04"]
    written = {line[3:11] for line in WRITES}
    asked, said = server.requests[: 5 + len(written)], server.requests[5 + len(written) :]
    assert asked[:5] == [f"40 {where} 00 00 00 00" for where in identity]
    assert {request[3:11] for request in asked[5:]} == written
    assert {request[:2] for request in asked} == {"40"}
    assert said == [*WRITES, *(f"40 {request[3:11]} 00 00 00 00" for request in asked[5:])]
    assert driver.receive(heartbeat(PRE_OPERATIONAL), 3000) == ()
    assert driver.state is DriverState.STARTING
    try_out(driver, 4000)
    assert driver.state is DriverState.OPERATIONAL
    assert (driver.failure, driver.node_events) == ("", 0)


def test_plain_module_gets_no_manufacturer_object():
    driver, server = AmplifierDriver(DriverConfig(protection=False)), ObedientServer()
    driver.start(0)
    assert run_dialogue(driver, server, driver.receive(heartbeat(BOOT_UP), 0)) == [OUR_HEARTBEAT, START]
    assert "2f 01 16 00 03 00 00 00" in server.requests
    assert "2f 01 1a 00 03 00 00 00" in server.requests
    assert not any(" 20 0" in request[3:9] or request.endswith(" 20") for request in server.requests)


@pytest.mark.parametrize("fd", [True, False])
def test_frames_have_the_format_of_the_bus(fd):
    driver = AmplifierDriver(DriverConfig(fd=fd))
    frames = [*driver.start(0), driver.sync(0), driver.drive((0, 0, 0), 0), *driver.stop(0)]
    assert {(each.is_fd, each.bitrate_switch) for each in frames} == {(fd, fd)}
    assert not any(each.is_remote or each.is_extended or each.is_error for each in frames)


@pytest.mark.parametrize(
    ("asked", "answer", "expected"),
    [
        ("40 00 10 00 00 00 00 00", "43 00 10 00 92 01 00 00", "(device type) is 0x00000192, expected 0x000C0191"),
        ("40 18 10 01 00 00 00 00", "43 18 10 01 01 00 00 00", "(vendor) is 0x00000001, expected 0x7078797A"),
        ("40 18 10 02 00 00 00 00", "43 18 10 02 09 00 00 00", "(product code) is 0x00000009, expected 0x00000003"),
        (
            WRITES[6],
            "80 01 16 04 41 00 04 06",
            "0x06040041, object cannot be mapped to the PDO; does the amplifier have",
        ),
        (WRITES[19], "80 43 64 01 22 00 00 08", "0x08000022, data cannot be transferred"),
        ("40 17 10 00 00 00 00 00", "80 17 10 00 00 00 02 06", "no 0x1017 (heartbeat period): the amplifier must prod"),
        ("40 44 64 02 00 00 00 00", "43 44 64 02 01 00 00 00", "read-back of error value of comb 2: 0 V) is 0x0000000"),
    ],
)
def test_start_up_ends_at_the_first_wrong_answer(asked, answer, expected):
    driver, server = AmplifierDriver(DriverConfig()), ObedientServer({asked: answer})
    driver.start(0)
    assert run_dialogue(driver, server, driver.receive(heartbeat(BOOT_UP), 0)) == []
    assert driver.state is DriverState.FAILED
    assert driver.failure.startswith("amplifier (node 10): ")
    assert expected in driver.failure
    assert asked in server.requests
    assert driver.poll(10**9) == ()


@pytest.mark.parametrize("line", [line for line in WRITES if line[3:8] in ("43 64", "44 64", "29 10", "10 20")])
def test_an_amplifier_without_a_safe_state_is_refused(line):
    driver = AmplifierDriver(DriverConfig())
    driver.start(0)
    server = ObedientServer({line: f"80 {line[3:11]} 30 00 09 06"})
    assert run_dialogue(driver, server, driver.receive(heartbeat(BOOT_UP), 0)) == []
    assert "0x06090030, invalid value" in driver.failure
    assert driver.failure.endswith("an amplifier that cannot be told to go to 0 V by itself must not be used")


def test_repetitions_of_the_reset_do_not_use_up_those_of_the_start():
    driver = AmplifierDriver(DriverConfig(boot_timeout_us=1000, start_timeout_us=1000, retries=1))
    driver.start(0)
    assert text(driver.poll(1000)) == [RESET]
    run_dialogue(driver, ObedientServer(), driver.receive(heartbeat(BOOT_UP), 1500), 1500)
    assert text(driver.poll(2500)) == [START]


def test_a_boot_up_while_starting_silences_our_heartbeat_until_the_node_is_configured_again():
    driver = AmplifierDriver(DriverConfig())
    driver.start(0)
    run_dialogue(driver, ObedientServer(), driver.receive(heartbeat(BOOT_UP), 0))
    driver.receive(heartbeat(BOOT_UP), 10)
    assert driver.heartbeat_due(10**9) is None


def test_identity_may_be_left_open():
    answers = {"40 18 10 01 00 00 00 00": "43 18 10 01 01 00 00 00"}
    driver = AmplifierDriver(DriverConfig(vendor_id=None))
    driver.start(0)
    sent = driver.receive(heartbeat(BOOT_UP), 0)
    assert run_dialogue(driver, ObedientServer(answers), sent) == [OUR_HEARTBEAT, START]


def test_no_boot_up():
    driver = AmplifierDriver(DriverConfig(boot_timeout_us=1000, retries=2))
    driver.start(0)
    assert [text(driver.poll(t_us)) for t_us in (999, 1000, 1999, 2000, 2999)] == [[], [RESET], [], [RESET], []]
    assert text(driver.poll(3000)) == [PRE_OP, "60a 40 00 10 00 00 00 00 00"]  # perhaps it is there all the same
    for t_us in (53_000, 103_000, 153_000):
        driver.poll(t_us)
    assert driver.state is DriverState.FAILED
    assert driver.failure == (
        "amplifier (node 10) sent no boot-up message 0x70A within 1 ms of NMT reset, 3 times; "
        "check node id, power, wiring and bit rates"
    )


def test_silent_sdo_server():
    driver = AmplifierDriver(DriverConfig(sdo_timeout_us=1000, retries=1))
    driver.start(0)
    driver.receive(heartbeat(BOOT_UP), 0)
    gave_up = "60a 80 00 10 00 00 00 04 05"
    assert text(driver.poll(1000)) == [gave_up, "60a 40 00 10 00 00 00 00 00"]
    driver.poll(2000)
    assert driver.state is DriverState.FAILED
    assert "no answer to 0x1000:00 (device type) within 1 ms, asked 2 times" in driver.failure


def test_node_that_does_not_become_operational():
    driver = AmplifierDriver(DriverConfig(start_timeout_us=5_000, retries=1))
    driver.start(0)
    run_dialogue(driver, ObedientServer(), driver.receive(heartbeat(BOOT_UP), 0))
    driver.receive(heartbeat(STOPPED), 100)
    assert text(driver.poll(5_000)) == [START]
    assert text(driver.poll(10_000)) == [PRE_OP]
    assert driver.state is DriverState.FAILED
    assert "did not become operational within 5 ms of NMT start, 2 times: its heartbeat says stopped" in driver.failure


def test_our_heartbeat_runs_while_the_node_is_starting():
    driver = AmplifierDriver(DriverConfig(start_timeout_us=10**6))
    driver.start(0)
    run_dialogue(driver, ObedientServer(), driver.receive(heartbeat(BOOT_UP), 0))
    sent_at = [t_us for t_us in range(0, 100_001, 1000) if OUR_HEARTBEAT in text(driver.poll(t_us))]
    assert sent_at == [20_000, 40_000, 60_000, 80_000, 100_000]


def test_a_second_boot_up_begins_the_dialogue_again_but_not_for_ever():
    driver = AmplifierDriver(DriverConfig(retries=2))
    driver.start(0)
    for _ in range(3):
        assert text(driver.receive(heartbeat(BOOT_UP), 0)) == [PRE_OP, "60a 40 00 10 00 00 00 00 00"]
        assert driver.state is DriverState.IDENTIFYING
    assert driver.receive(heartbeat(BOOT_UP), 0) == ()
    assert driver.state is DriverState.FAILED
    assert "restarts again and again" in driver.failure


def test_start_is_possible_from_a_failure():
    driver = started()
    driver.sync(0)
    driver.drive((0, 0, 0), 0)
    sense = [Frame(0x28A, ProcessCodec(0x28A, True).encode((1, 2, 3), counter)) for counter in (50, 9)]
    driver.receive(sense[0], 0)
    driver.receive(frame("08a 10 23 03 00 00 00 00 00"), 5)
    driver.receive(heartbeat(BOOT_UP), 10)
    assert driver.state is DriverState.FAILED
    assert text(driver.start(20)) == [RESET]
    assert driver.sense.take() == (0, 0, 0, SENSE_MISSING)
    assert (driver.sync(21).data[0], driver.drive((0, 0, 0), 21).data[6], len(driver.emergencies)) == (1, 0, 0)
    driver.receive(sense[1], 22)
    assert driver.sense.take() == (1, 2, 3, 0)
    assert (driver.failure, driver.node_events, driver.state) == ("", 0, DriverState.RESETTING)
    assert run_dialogue(driver, ObedientServer(), driver.receive(heartbeat(BOOT_UP), 30)) == [OUR_HEARTBEAT, START]


def test_a_sense_frame_of_the_life_before_shifts_none_of_the_new_one():
    """It waited for a crowded bus, and came between our reset and the boot-up message."""
    driver, codec = AmplifierDriver(DriverConfig()), ProcessCodec(0x28A, protected=True)

    def came(counter: int) -> None:
        driver.receive(Frame(0x28A, codec.encode((counter, 0, 0), counter)), 5000)

    driver.start(0)
    driver.sync(500)
    came(240)
    assert run_dialogue(driver, ObedientServer(), driver.receive(heartbeat(BOOT_UP), 1000)) == [OUR_HEARTBEAT, START]
    for counter in range(3):
        driver.sync(2000)
        came(counter)
        assert driver.sense.take() == (counter, 0, 0, 0)

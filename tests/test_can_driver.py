"""The amplifier driver as a scripted dialogue: literal bytes in, literal bytes out, no node behind it."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from pkxyz_ctrl.can.codec import CountsOutOfRangeError, ProcessCodec
from pkxyz_ctrl.can.driver import (
    NODE_EMERGENCY,
    NODE_HEARTBEAT_LOST,
    NODE_NOT_OPERATIONAL,
    NODE_REBOOTED,
    AmplifierDriver,
    DriverState,
)
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.can.sense_input import SENSE_MISSING

BOOT_UP, OPERATIONAL, PRE_OPERATIONAL, STOPPED = "00", "05", "7f", "04"
RESET, START = "000 81 0a", "000 01 0a"
PRE_OP = "000 80 0a"
OUR_HEARTBEAT = "77f 05"

# What a start writes, in order, for node 10 with protected PDOs, and what must be read back.
WRITES = """
23 05 10 00 80 00 00 00
23 01 14 01 0a 03 00 80
2f 01 14 02 01 00 00 00
2f 01 16 00 00 00 00 00
23 01 16 01 10 01 11 64
23 01 16 02 10 02 11 64
23 01 16 03 10 03 11 64
23 01 16 04 08 01 00 20
23 01 16 05 08 02 00 20
2f 01 16 00 05 00 00 00
23 01 18 01 8a 02 00 c0
2f 01 18 02 01 00 00 00
2f 01 1a 00 00 00 00 00
23 01 1a 01 10 01 01 64
23 01 1a 02 10 02 01 64
23 01 1a 03 10 03 01 64
23 01 1a 04 08 01 01 20
23 01 1a 05 08 02 01 20
2f 01 1a 00 05 00 00 00
2f 43 64 01 01 00 00 00
23 44 64 01 00 00 00 00
2f 43 64 02 01 00 00 00
23 44 64 02 00 00 00 00
2f 43 64 03 01 00 00 00
23 44 64 03 00 00 00 00
2f 29 10 01 00 00 00 00
2f 10 20 00 05 00 00 00
23 16 10 01 32 00 7f 00
2b 17 10 00 14 00 00 00
2f 19 10 00 f0 00 00 00
23 01 14 01 0a 03 00 00
23 01 18 01 8a 02 00 40
""".strip().splitlines()


def frame(text: str, fd: bool = True) -> Frame:
    """``"58a 60 17 ..."`` as a frame."""
    can_id, _, data = text.partition(" ")
    return Frame(int(can_id, 16), bytes.fromhex(data), fd, fd)


def text(sent: tuple[Frame, ...]) -> list[str]:
    return [f"{each.can_id:03x} {each.data.hex(' ')}" for each in sent]


def heartbeat(state: str) -> Frame:
    return frame(f"70a {state}")


class ObedientServer:
    """Answers SDO requests from a table of bytes; ``answers`` overrides single ones."""

    def __init__(self, answers: dict[str, str] | None = None) -> None:
        self.store = {"00 10 00": "91 01 0c 00", "18 10 01": "7a 79 78 70", "18 10 02": "03 00 00 00"}
        self.commands: dict[str, str] = {}  # how an object was written: it is read with the same length
        self.answers = answers or {}
        self.requests: list[str] = []

    def answer(self, sent: Frame) -> Frame:
        assert sent.can_id == 0x60A
        asked = sent.data.hex(" ")
        self.requests.append(asked)
        if asked in self.answers:
            return frame(f"58a {self.answers[asked]}")
        command, where, value = asked[:2], asked[3:11], asked[12:]
        if command == "40":
            size = {"23": "43", "2b": "4b", "2f": "4f"}[self.commands.get(where, "23")]
            return frame(f"58a {size} {where} {self.store[where]}")
        self.store[where] = value
        self.commands[where] = command
        return frame(f"58a 60 {where} 00 00 00 00")


def run_dialogue(driver: AmplifierDriver, server: ObedientServer, sent: tuple[Frame, ...], t_us: int = 0) -> list[str]:
    """Passes SDO frames to and fro until the driver sends something else; returns that."""
    while sent and sent[0].can_id == 0x60A:
        (only,) = sent
        sent = driver.receive(server.answer(only), t_us)
    return text(sent)


def started(**settings_of: object) -> AmplifierDriver:
    """An operational driver whose node gave its first heartbeat at t = 0."""
    driver = AmplifierDriver(DriverConfig(**settings_of))
    assert text(driver.start(0)) == [RESET]
    assert run_dialogue(driver, ObedientServer(), driver.receive(heartbeat(BOOT_UP), 0)) == [OUR_HEARTBEAT, START]
    assert driver.receive(heartbeat(OPERATIONAL), 0) == ()
    assert driver.state is DriverState.OPERATIONAL
    return driver


# -- start ------------------------------------------------------------------------------------------------------------


def test_start_up_word_for_word():
    driver, server = AmplifierDriver(DriverConfig()), ObedientServer()
    assert text(driver.start(1000)) == [RESET]
    assert driver.state is DriverState.RESETTING
    assert driver.receive(heartbeat(OPERATIONAL), 1100) == ()  # from before the reset
    first = driver.receive(heartbeat(BOOT_UP), 2000)
    assert driver.state is DriverState.IDENTIFYING
    assert run_dialogue(driver, server, first) == [OUR_HEARTBEAT, START]
    assert driver.state is DriverState.STARTING
    identity = ["40 00 10 00", "40 18 10 01", "40 18 10 02"]
    last_written = list(dict.fromkeys(line[3:11] for line in WRITES))
    read_back = [f"40 {where}" for where in last_written]
    assert server.requests == [
        *(f"{head} 00 00 00 00" for head in identity),
        *WRITES,
        *(f"{head} 00 00 00 00" for head in read_back),
    ]
    assert driver.receive(heartbeat(PRE_OPERATIONAL), 3000) == ()
    assert driver.state is DriverState.STARTING
    driver.receive(heartbeat(OPERATIONAL), 4000)
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
            WRITES[7],
            "80 01 16 04 41 00 04 06",
            "0x06040041, object cannot be mapped to the PDO; does the amplifier have",
        ),
        (WRITES[19], "80 43 64 01 00 00 02 06", "0x06020000, object does not exist"),
        (
            "40 44 64 02 00 00 00 00",
            "43 44 64 02 01 00 00 00",
            "read-back of error value of comb 2: 0 V) is 0x00000001",
        ),
    ],
)
def test_start_up_ends_at_the_first_wrong_answer(asked, answer, expected):
    driver, server = AmplifierDriver(DriverConfig()), ObedientServer({asked: answer})
    driver.start(0)
    assert run_dialogue(driver, server, driver.receive(heartbeat(BOOT_UP), 0)) == []
    assert driver.state is DriverState.FAILED
    assert driver.failure.startswith("amplifier (node 10): ")
    assert expected in driver.failure
    assert server.requests[-1] == asked
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
    assert driver.poll(3000) == ()
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
        assert text(driver.receive(heartbeat(BOOT_UP), 0)) == ["60a 40 00 10 00 00 00 00 00"]
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


# -- the loop ---------------------------------------------------------------------------------------------------------


def test_sync_counts_1_to_240():
    driver = started()
    counters = [driver.sync(0).data[0] for _ in range(482)]
    assert counters == [*range(1, 241), *range(1, 241), 1, 2]
    assert driver.sync(0)._replace(data=b"") == Frame(0x080, b"", True, True)


def test_drive_counts_its_frames():
    driver = started()
    codec = ProcessCodec(0x30A, protected=True)
    for sent in range(520):
        assert driver.drive((sent, 0, 32767), 0) == Frame(
            0x30A, codec.encode((sent, 0, 32767), sent & 0xFF), True, True
        )


def test_a_refused_drive_uses_no_alive_counter():
    driver = started()
    with pytest.raises(CountsOutOfRangeError):
        driver.drive((0, 40000, 0), 0)
    assert driver.drive((0, 0, 0), 0).data[6] == 0


def test_one_tick():
    driver = started()
    assert driver.sync(200) == frame("080 01")
    assert driver.receive(Frame(0x28A, ProcessCodec(0x28A, True).encode((1, -2, 3), 9), True, True), 250) == ()
    assert driver.sense.fresh
    assert driver.sense.take() == (1, -2, 3, 0)
    driver.sync(400)
    assert not driver.sense.fresh
    assert driver.sense.take() == (1, -2, 3, SENSE_MISSING)


@pytest.mark.parametrize("flag", ["is_remote", "is_extended", "is_error"])
@pytest.mark.parametrize("can_id", [0x28A, 0x70A, 0x08A, 0x58A])
def test_frames_of_another_kind_are_not_ours(flag, can_id):
    driver = started()
    driver.sync(0)
    data = ProcessCodec(0x28A, True).encode((1, 2, 3), 0) if can_id == 0x28A else bytes(1 if can_id == 0x70A else 8)
    assert driver.receive(Frame(can_id, data, **{flag: True}), 0) == ()
    assert driver.sense.take() == (0, 0, 0, SENSE_MISSING)
    assert (driver.node_events, len(driver.emergencies), driver.state) == (0, 0, DriverState.OPERATIONAL)


def test_our_heartbeat_keeps_its_grid_however_late_it_is_sent():
    """Its grid would be the node's, whose first heartbeat came at 0; it stays 1 ms before that."""
    driver = started()
    assert driver.heartbeat_due(18_999) is None
    assert driver.heartbeat_due(19_000) == frame(OUR_HEARTBEAT)
    assert driver.heartbeat_due(19_400) == frame(OUR_HEARTBEAT)  # until it was sent
    driver.heartbeat_sent(19_400)
    assert driver.heartbeat_due(38_999) is None
    assert driver.heartbeat_due(39_000) is not None
    driver.heartbeat_sent(105_000)  # whole periods are skipped
    assert driver.heartbeat_due(118_999) is None
    assert driver.heartbeat_due(119_000) is not None


def test_stop_is_zero_volts_then_pre_operational():
    driver = started()
    driver.drive((5, 5, 5), 0)
    sent = driver.stop(100)
    assert sent[0] == Frame(0x30A, ProcessCodec(0x30A, True).encode((0, 0, 0), 1), True, True)
    assert text(sent[1:]) == [PRE_OP]
    assert driver.state is DriverState.OFF
    driver.heartbeat_sent(100)
    assert driver.heartbeat_due(10**9) is None
    driver.sync(10**9)
    assert driver.node_events == 0  # nobody is watched any more


# -- supervision ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("watch", ["sync", "poll"])
def test_lost_heartbeat_is_seen_one_microsecond_after_the_time_out(watch):
    driver = started()
    driver.receive(heartbeat(OPERATIONAL), 20_000)
    getattr(driver, watch)(70_000)
    assert (driver.node_events, driver.state) == (0, DriverState.OPERATIONAL)
    getattr(driver, watch)(70_001)
    assert (driver.node_events, driver.state) == (NODE_HEARTBEAT_LOST, DriverState.FAILED)
    assert driver.failure == (
        "amplifier (node 10) sent no heartbeat for 50.001 ms, expected one every 20 ms; "
        "check cable and power, then start it again"
    )
    driver.receive(heartbeat(OPERATIONAL), 70_002)
    assert driver.node_events == NODE_HEARTBEAT_LOST  # latched until the next start


@pytest.mark.parametrize(
    ("state", "events", "failure"),
    [
        (BOOT_UP, NODE_REBOOTED | NODE_NOT_OPERATIONAL, "restarted by itself"),
        (STOPPED, NODE_NOT_OPERATIONAL, "its heartbeat says stopped"),
        (PRE_OPERATIONAL, NODE_NOT_OPERATIONAL, "its heartbeat says pre-operational"),
        ("33", NODE_NOT_OPERATIONAL, "its heartbeat says unknown state 0x33"),
        (OPERATIONAL, 0, ""),
        ("85", 0, ""),  # with the toggle bit of node guarding
    ],
)
def test_what_the_nodes_heartbeat_says(state, events, failure):
    driver = started()
    assert driver.receive(heartbeat(state), 100) == ()
    assert driver.node_events == events
    assert failure in driver.failure
    assert driver.state is (DriverState.FAILED if events else DriverState.OPERATIONAL)
    assert (driver.heartbeat_due(10**6) is None) == bool(events)  # silence takes the node to 0 V as well


def test_heartbeat_of_another_node_or_length_says_nothing():
    driver = started()
    driver.receive(frame("70b 00"), 100)
    driver.receive(frame("70a 00 00"), 100)
    driver.receive(frame("70a"), 100)
    assert driver.node_events == 0


def test_emergencies_are_kept_and_latched_until_acknowledged():
    driver = started()
    driver.receive(frame("08a 00 00 00 00 00 00 00 00"), 10)
    assert driver.node_events == 0  # "no error" is not an emergency
    driver.receive(frame("08a 10 23 03 00 00 00 00 00"), 20)
    assert driver.node_events == NODE_EMERGENCY
    assert driver.state is DriverState.OPERATIONAL
    assert [(each.t_us, each.code) for each in driver.emergencies] == [(10, 0), (20, 0x2310)]
    driver.acknowledge()
    assert driver.node_events == 0
    driver.receive(frame("08a 10 23"), 30)  # no EMCY
    assert (driver.node_events, len(driver.emergencies)) == (0, 2)
    for t_us in range(100):
        driver.receive(frame("08a 10 ff 81 00 00 00 00 00"), t_us)
    assert len(driver.emergencies) == 64


def test_the_first_cause_stays():
    driver = started()
    driver.receive(heartbeat(STOPPED), 10)
    driver.receive(heartbeat(BOOT_UP), 20)
    assert "left the operational state" in driver.failure
    assert driver.node_events == NODE_NOT_OPERATIONAL | NODE_REBOOTED


frames = st.builds(
    Frame,
    st.one_of(st.sampled_from([0x28A, 0x58A, 0x70A, 0x08A, 0x77F, 0x000, 0x080]), st.integers(0, 0x7FF)),
    st.one_of(
        st.binary(max_size=64),
        st.binary(min_size=8, max_size=8),
        st.sampled_from([b"\x00", b"\x05", b"\x7f", bytes.fromhex("43 00 10 00 91 01 0c 00")]),
    ),
    st.booleans(),
    st.booleans(),
    st.booleans(),
    st.booleans(),
    st.booleans(),
)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(frames, st.integers(0, 300_000)), max_size=40), st.booleans())
def test_no_frame_whatsoever_upsets_the_driver(traffic, from_operational):
    driver = started() if from_operational else AmplifierDriver(DriverConfig())
    if not from_operational:
        driver.start(0)
    t_us = 0
    for received, step_us in traffic:
        t_us += step_us
        sent = (*driver.receive(received, t_us), *driver.poll(t_us))
        assert {each.can_id for each in sent} <= {0x000, 0x60A, 0x77F}
        assert len(sent) <= 4
        driver.sync(t_us)
        *_, status = driver.sense.take()
        assert 0 <= status < 32
        assert (driver.state is DriverState.FAILED) == (driver.failure != "")
    if from_operational and driver.state is DriverState.OPERATIONAL:
        assert driver.node_events & ~NODE_EMERGENCY == 0


@pytest.mark.parametrize(
    ("settings_of", "complaint"),
    [
        ({"node_id": 0}, "node_id"),
        ({"node_id": 127}, "different ids"),
        ({"node_heartbeat_timeout_ms": 20}, "must be longer than node_heartbeat_period_ms"),
        ({"controller_heartbeat_timeout_ms": 10}, "must be longer than controller_heartbeat_period_ms"),
        ({"controller_heartbeat_timeout_ms": 1001}, "less than or equal to 1000"),
        ({"drive_timeout_syncs": 0}, "greater than or equal to 2"),
        ({"sdo_timeout_us": 0}, "sdo_timeout_us"),
        ({"node_idd": 3}, "node_idd"),
    ],
)
def test_configuration_errors_name_the_key(settings_of, complaint):
    with pytest.raises(ValidationError, match=complaint):
        DriverConfig(**settings_of)


@pytest.mark.parametrize(
    ("ours_ms", "nodes_ms", "slip_us"), [(20, 20, -200), (20, 20, 0), (20, 20, 70), (7, 20, -33), (50, 20, 3)]
)
def test_heartbeats_of_both_sides_never_meet(ours_ms: int, nodes_ms: int, slip_us: int) -> None:
    """A tick has room for one. The node's come a little earlier or later than its period says; ours keep their time."""
    driver = started(
        controller_heartbeat_period_ms=ours_ms, controller_heartbeat_timeout_ms=200,
        node_heartbeat_period_ms=nodes_ms, node_heartbeat_timeout_ms=200,
    )  # fmt: skip
    node_us = [1000 * nodes_ms]
    our_us = [0]
    for t_us in range(0, 3_000_000, 200):
        if t_us >= node_us[-1]:
            driver.receive(heartbeat(OPERATIONAL), t_us)
            node_us.append(node_us[-1] + 1000 * nodes_ms + slip_us)
        if driver.heartbeat_due(t_us) is not None:
            driver.heartbeat_sent(t_us)
            our_us.append(t_us)
    apart_us = [min(abs(t_us - other_us) for other_us in node_us) for t_us in our_us[2:]]
    assert min(apart_us) >= 400
    gaps_us = [b - a for a, b in itertools.pairwise(our_us[1:])]
    assert max(gaps_us) <= 1000 * ours_ms + 200
    assert len(our_us) < 1.2 * 3000 / ours_ms

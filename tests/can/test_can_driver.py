"""The amplifier driver once it runs: literal bytes in, literal bytes out, no node behind it."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scripted_node import (
    BOOT_UP,
    OPERATIONAL,
    OUR_HEARTBEAT,
    PRE_OP,
    PRE_OPERATIONAL,
    STOPPED,
    ObedientServer,
    frame,
    heartbeat,
    started,
    text,
)

from pkxyz_ctrl.can.codec import CountsOutOfRangeError, ProcessCodec
from pkxyz_ctrl.can.driver import (
    FOREIGN_FRAME,
    NODE_EMERGENCY,
    NODE_HEARTBEAT_LOST,
    NODE_NOT_OPERATIONAL,
    NODE_REBOOTED,
    AmplifierDriver,
)
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.can.sense_input import SENSE_MISSING

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
    """It begins 2 ms after the node's first, at 0; where it would meet one of the node's, it goes out 1 ms before."""
    driver = started()
    assert driver.heartbeat_due(1_999) is None
    driver.heartbeat_sent(2_000)
    assert driver.heartbeat_due(21_999) is None
    driver.receive(heartbeat(OPERATIONAL), 21_500)
    assert driver.heartbeat_due(21_999) is None
    assert driver.heartbeat_due(22_000) == frame(OUR_HEARTBEAT)
    assert driver.heartbeat_due(22_400) == frame(OUR_HEARTBEAT)  # until it was sent
    driver.heartbeat_sent(22_400)
    assert driver.heartbeat_due(40_499) is None
    assert driver.heartbeat_due(40_500) is not None
    driver.heartbeat_sent(105_000)  # whole periods are skipped
    assert driver.heartbeat_due(120_499) is None
    assert driver.heartbeat_due(120_500) is not None


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


@pytest.mark.parametrize("code", [0x0100, 0x1000, 0x2310, 0x8130, 0x8250, 0xFF10, 0xFF14, 0xFFFF])
def test_every_code_from_0x0100_on_is_an_emergency(code):
    driver = started()
    driver.receive(frame(f"08a {code & 0xFF:02x} {code >> 8:02x} 01 00 00 00 00 00"), 10)
    assert driver.node_events == NODE_EMERGENCY


@pytest.mark.parametrize("code", [0x0000, 0x00FF])
def test_a_code_below_0x0100_says_that_an_error_is_over(code):
    driver = started()
    driver.receive(frame(f"08a {code & 0xFF:02x} {code >> 8:02x} 00 00 00 00 00 00"), 10)
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


# -- somebody else in our name -----------------------------------------------------------------------------------------

OURS = ["080 01", "30a 00 00 00 00 00 00 00 00", "60a 40 00 10 00 00 00 00 00", "77f 05", "000 80 0a", "000 02 00"]


@pytest.mark.parametrize("sent", OURS)
def test_a_frame_that_only_we_may_send_is_noticed_and_named(sent):
    driver = started()
    assert driver.receive(frame(sent), 100) == ()
    assert driver.node_events == FOREIGN_FRAME
    assert driver.foreign.startswith(f"0x{sent[:3].upper()} [{sent[4:]}]")
    driver.receive(frame("080 02"), 200)
    assert driver.foreign.startswith(f"0x{sent[:3].upper()}")  # the first
    driver.acknowledge()
    assert driver.node_events == FOREIGN_FRAME  # until everything has been configured again
    driver.start(300)
    assert (driver.node_events, driver.foreign) == (0, "")


@pytest.mark.parametrize("sent", ["000 80 0b", "000 01 01", "77e 05", "30b 00 00", "60b 40", "081 01", "180", "7ff 00"])
def test_frames_of_others_in_their_own_name_are_none_of_our_business(sent):
    driver = started()
    driver.receive(frame(sent), 100)
    assert (driver.node_events, driver.foreign) == (0, "")


@pytest.mark.parametrize("sent", OURS)
def test_before_the_node_is_configured_others_may_have_spoken_and_from_then_on_not(sent):
    driver = AmplifierDriver(DriverConfig())
    driver.start(0)
    driver.receive(frame(sent), 10)
    asked = driver.receive(heartbeat(BOOT_UP), 100)
    driver.receive(frame(sent), 110)
    assert driver.state is DriverState.IDENTIFYING
    assert driver.node_events == 0
    server = ObedientServer()
    while driver.state is DriverState.IDENTIFYING:
        asked = driver.receive(server.answer(asked[-1]), 120)
    driver.receive(frame(sent), 130)
    assert driver.node_events == FOREIGN_FRAME


# -- release ----------------------------------------------------------------------------------------------------------


def test_a_release_is_repeated_until_the_node_says_that_it_has_left_operational():
    driver = started()
    assert text(driver.release(100)) == [PRE_OP]
    assert text(driver.release(300)) == [PRE_OP]
    assert driver.state is DriverState.RELEASING
    driver.receive(heartbeat(OPERATIONAL), 400)  # from before
    assert text(driver.release(500)) == [PRE_OP]
    assert driver.heartbeat_due(10**9) is None  # the node's consumer is to miss us
    driver.receive(heartbeat(PRE_OPERATIONAL), 600)
    assert driver.state is DriverState.RELEASED
    assert text(driver.release(700)) == [OUR_HEARTBEAT]
    assert driver.heartbeat_due(20_599) is None
    assert driver.release(20_599) == ()
    assert text(driver.release(20_600)) == [OUR_HEARTBEAT]
    assert (driver.failure, driver.node_events) == ("", 0)  # all this is as it should be


@pytest.mark.parametrize("left", [PRE_OPERATIONAL, STOPPED, BOOT_UP])
def test_whatever_leaves_operational_ends_the_release_and_a_node_that_is_started_again_begins_it_anew(left):
    driver = started()
    driver.release(0)
    driver.receive(heartbeat(left), 100)
    assert text(driver.release(200)) == [OUR_HEARTBEAT]
    driver.receive(heartbeat(OPERATIONAL), 300)  # somebody else did that
    assert text(driver.release(400)) == [PRE_OP]
    assert driver.heartbeat_due(10**9) is None


def test_a_release_ends_a_start_up_and_a_start_begins_anew():
    driver = AmplifierDriver(DriverConfig())
    driver.start(0)
    driver.receive(heartbeat(BOOT_UP), 100)
    assert text(driver.release(200)) == [PRE_OP]
    assert driver.receive(frame("58a 43 00 10 00 91 01 0c 00"), 300) == ()  # an answer that is not waited for
    assert driver.poll(10**9) == ()
    assert text(driver.start(400)) == ["000 81 0a"]
    assert driver.state is DriverState.RESETTING


@settings(max_examples=150)
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
        assert driver.node_events & ~(NODE_EMERGENCY | FOREIGN_FRAME) == 0


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

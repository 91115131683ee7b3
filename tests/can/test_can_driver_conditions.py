"""What the driver does only now and then: each condition of it, met alone."""

from itertools import pairwise

import pytest
from scripted_node import (
    BOOT_UP,
    OPERATIONAL,
    PRE_OPERATIONAL,
    ObedientServer,
    frame,
    heartbeat,
    run_dialogue,
    started,
    text,
)

from pkxyz_ctrl.can.codec import CountsOutOfRangeError, ProcessCodec
from pkxyz_ctrl.can.driver import FOREIGN_FRAME, NODE_EMERGENCY, NODE_REBOOTED, AmplifierDriver
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.startup import table

HEARTBEAT_ERROR, OTHER_ERROR, RESET_ERROR = "30 81 11", "00 10 01", "00 00 00"


def emergency(head: str) -> str:
    return f"08a {head} 00 00 00 00 00"


def tried() -> AmplifierDriver:
    """A driver in the middle of its trial."""
    driver = AmplifierDriver(DriverConfig())
    driver.start(0)
    run_dialogue(driver, ObedientServer(), driver.receive(heartbeat(BOOT_UP), 0))
    driver.receive(heartbeat(OPERATIONAL), 0)
    assert driver.state is DriverState.TRYING
    return driver


@pytest.mark.parametrize(("head", "counts"), [(HEARTBEAT_ERROR, False), (RESET_ERROR, False), (OTHER_ERROR, True)])
def test_in_the_trial_the_node_complains_as_it_should_and_of_nothing_else(head: str, counts: bool) -> None:
    driver = tried()
    driver.receive(frame(emergency(head)), 1)
    assert bool(driver.node_events & NODE_EMERGENCY) == counts
    assert len(driver.emergencies) == counts


@pytest.mark.parametrize(("head", "counts"), [(HEARTBEAT_ERROR, True), (RESET_ERROR, False), (OTHER_ERROR, True)])
def test_after_it_every_emergency_counts_but_the_end_of_one(head: str, counts: bool) -> None:
    driver = started()
    driver.receive(frame(emergency(head)), 1)
    assert bool(driver.node_events & NODE_EMERGENCY) == counts
    assert len(driver.emergencies) == 1


def test_a_boot_up_of_a_node_that_nobody_started_means_nothing() -> None:
    driver = AmplifierDriver(DriverConfig())
    assert driver.receive(heartbeat(BOOT_UP), 0) == ()
    assert (driver.state, driver.node_events) == (DriverState.OFF, 0)


def test_the_first_cause_is_kept() -> None:
    driver = started()
    driver.receive(heartbeat(PRE_OPERATIONAL), 10)
    first = driver.failure
    assert "left the operational state" in first
    driver.receive(heartbeat(BOOT_UP), 20)
    assert driver.failure == first
    assert driver.node_events & NODE_REBOOTED


def test_the_first_foreign_frame_is_kept() -> None:
    driver = started()
    for sent in ("080 05", "000 02 0a"):
        assert driver.receive(frame(sent), 5) == ()
    assert driver.foreign.startswith("0x080 [05]")
    assert driver.node_events & FOREIGN_FRAME


def test_a_released_node_that_says_so_again_stays_released_and_one_that_is_operational_is_told_again() -> None:
    driver = started()
    assert text(driver.release(0)) == ["000 80 0a"]
    for t_us in (100, 200):
        driver.receive(heartbeat(PRE_OPERATIONAL), t_us)
        assert driver.state is DriverState.RELEASED
    driver.receive(heartbeat(OPERATIONAL), 300)
    assert driver.state is DriverState.RELEASING
    assert text(driver.release(300)) == ["000 80 0a"]


def test_a_drive_frame_that_was_not_sent_leaves_its_counter_to_the_next() -> None:
    driver = started()
    first = driver.drive((0, 0, 0), 0)
    driver.revoke_drive()
    assert driver.drive((0, 0, 0), 0) == first
    assert driver.drive((0, 0, 0), 0).data[6] == first.data[6] + 1


@pytest.mark.parametrize("period_ms", [1, 2, 3, 20])
def test_our_heartbeat_keeps_away_from_the_nodes_where_there_is_room(period_ms: int) -> None:
    """Where the node's come every two milliseconds or less there is none: ours goes out when it is due."""
    driver = started(node_heartbeat_period_ms=period_ms, node_heartbeat_timeout_ms=period_ms + 30)
    t_us = 2_000
    sent_us = []
    for step in range(200):
        if step % 2 == 0:
            driver.receive(heartbeat(OPERATIONAL), t_us)
        if driver.heartbeat_due(t_us) is not None:
            driver.heartbeat_sent(t_us)
            sent_us.append(t_us)
        t_us += 500 * period_ms
    assert len(sent_us) >= 4
    assert max(b - a for a, b in pairwise(sent_us)) <= 22_000 + 500 * period_ms


def test_a_plain_pdo_has_no_counter_that_could_be_out_of_range() -> None:
    assert ProcessCodec(0x30A, False).encode((1, 2, 3), 300) == bytes.fromhex("010002000300")
    with pytest.raises(CountsOutOfRangeError):
        ProcessCodec(0x30A, True).encode((1, 2, 3), 256)


def test_what_the_start_up_goes_by_may_be_handed_in() -> None:
    """One that was told to hold the node to another step, say."""
    config = DriverConfig()
    driver = AmplifierDriver(config, settings=table(config, 77))
    server = ObedientServer()
    driver.start(0)
    run_dialogue(driver, server, driver.receive(heartbeat(BOOT_UP), 0))
    assert "2b 11 20 00 4d 00 00 00" in server.requests

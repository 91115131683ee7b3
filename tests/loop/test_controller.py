"""The controller between a bus and a law: what it says, and what it does when something is in its way."""

import dataclasses
import re
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from loop_rig import rows_of, setup

from hil.faults.fault import parse
from hil.lanes.blocks import Blocks
from hil.lanes.lockstep import LockstepRig
from hil.studies.faults.outcome import setup_for
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.safety.modes import Mode


@cache
def scan():
    return setup_for("lqg")


def faults_of(*texts):
    run = dataclasses.replace(scan(), faults=tuple(parse(text) for text in texts), duration_s=0.3)
    vars(run)["law"] = scan().law
    return rows_of(run, "lockstep")[1].faults


@pytest.mark.parametrize(
    ("fault", "said", "unsaid"),
    [
        ("amplifier.2:trip@0.22", ("EMCY 0x2310: current, output side", "short or dust"), ("heartbeat",)),
        ("bus.heartbeat:drop@0.22", ("EMCY 0x8130: heartbeat of the controller missed",), ("over-current",)),
        ("bus.drive:drop@0.22", ("EMCY 0x8250: no drive PDO was applied in time",), ("over-current",)),
    ],
)
def test_a_fault_of_the_node_is_told_by_its_emergency(fault, said, unsaid):
    """Not by the record of the program, with times from another origin and the remedy of another code."""
    (told,) = faults_of(fault)
    assert told.startswith("at 0.2")
    assert "NODE_EMERGENCY" in told
    for words in ("ms before", *said):
        assert words in told
    for words in ("Emergency(", "t_us", *unsaid):
        assert words not in told
    (before_ms,) = re.findall(r"([\d.]+) ms before", told)
    assert 0.0 <= float(before_ms) < 0.5  # ticks are 0.2 ms


class Watched:
    """A lockstep run of the scan, with somebody at its side: ``each_tick(controller, tick)`` is called as it begins."""

    def __init__(self, each_tick, *texts, duration_s=0.35, prepare=lambda rig: None):
        run = dataclasses.replace(scan(), faults=tuple(parse(text) for text in texts), duration_s=duration_s)
        vars(run)["law"] = scan().law
        self.rig = LockstepRig(run)
        self.frames: list[tuple[int, Frame]] = []
        self.rig.wire.attach("tap", lambda frame, t_us: self.frames.append((t_us, frame)), listen_only=True)
        prepare(self.rig)
        controller, blocks, self.tick = self.rig.controller, [], 0
        begin = controller.begin

        def begin_watched(t_us):
            each_tick(controller, self.tick)
            begin(t_us)
            self.tick += 1

        controller.begin = begin_watched
        keep = Blocks(run.trajectory, run.bus.period_us, run.ticks, lambda b: blocks.append(b.copy()), lambda *_: None)
        self.rig.run(keep)
        self.rows = np.concatenate(blocks)

    def of(self, can_id):
        return [frame.data for _, frame in self.frames if frame.can_id == can_id]


def test_the_mode_and_the_counts_stand_in_the_memory_of_the_cycle_and_nowhere_else():
    sent = []
    controller = Controller(setup().law, setup().bus, setup().gate, sent.append)
    controller.memory["mode"] = Mode.IDLE
    controller.memory["tick"]["count"][0, 0] = (1, 2, 3)
    assert controller.mode == Mode.IDLE
    controller.finish(1000, 0)
    assert controller.faults[-1].endswith("blocked in IDLE: DRIVE is not permitted now")
    assert "[01 00 02 00 03 00" in controller.faults[-1]
    assert [frame.data[:6] for frame in sent] == [bytes(6)]


def test_a_clear_while_it_is_starting_clears_nothing_that_comes_later():
    """Somebody impatient asks again and again while the start-up runs. The next fault stays until it is asked for."""
    seen = set()

    def each_tick(controller, tick):
        if controller.mode == Mode.FAULT and tick < 1200:
            controller.clear()
        if controller.mode in (Mode.BOOT, Mode.PRE_OPERATIONAL):
            seen.add(controller.driver.state)
            controller.clear()

    watched = Watched(each_tick, "node:silent@0.1+0.002", "node:silent@0.3+0.002", duration_s=0.4)
    assert {DriverState.CONFIGURING, DriverState.RESETTING} <= seen
    mode = watched.rows["mode"]
    decisions = np.flatnonzero((mode[1:] == Mode.FAULT) & (mode[:-1] != Mode.FAULT)) + 1
    assert len(decisions) == 2
    assert Mode.TRACKING in mode[decisions[0] : decisions[1]]  # cleared, since that was asked for in FAULT
    assert (mode[decisions[1] :] == Mode.FAULT).all()  # and the second was not
    resets = [data for data in watched.of(0x000) if data[0] == 0x81]
    assert len(resets) == 2  # at the start, and after the clear; no more for having been asked more often


def test_a_voltage_that_the_gate_holds_back_becomes_0_v_under_the_same_alive_counter():
    """Were its number taken for sent, the node would refuse the 0 V that comes in its place."""

    def each_tick(controller, tick):
        if tick == 1100:  # a law whose numbers run away, behind all that looks at it
            finish = controller._finish

            def runaway(config, memory, t_us, until_us):
                controller._finish = finish
                controller.memory["tick"]["count"][0, 0] = 32767
                return finish(config, memory, t_us, until_us)

            controller._finish = runaway

    watched = Watched(each_tick)
    (told,) = [words for words in watched.rig.controller.faults if "GATE_BLOCKED" in words]
    assert told
    counters = [data[6] for data in watched.of(0x30A)]
    assert {(b - a) & 0xFF for a, b in pairwise(counters)} == {1}
    trial = [b"\x30\x81", b"\0\0"]
    assert [data[:2] for data in watched.of(0x08A)] == trial  # after that the node has nothing to complain about
    drives = [any(data[:6]) for data in watched.of(0x30A)]
    assert drives.index(False, 600) - 1100 in range(3)  # no voltage after the blocked one
    assert not any(drives[1103:])
    volts = watched.rows["comb_voltage_v"]
    assert volts[1101].max() > 100.0
    assert not volts[1103].any()


def test_what_waits_to_be_sent_is_discarded_at_the_decision_before_0_v_goes_out():
    order = []

    def prepare(rig):
        controller = rig.controller
        send, discard = controller._send, controller._discard_unsent

        def sending(frame):
            if frame.can_id == 0x30A:
                order.append(any(frame.data[:6]))
            return send(frame)

        def discarding():
            order.append("discarded")
            return discard()

        controller._send, controller._discard_unsent = sending, discarding

    watched = Watched(lambda controller, tick: None, "node:silent@0.22", prepare=prepare)
    assert order.count("discarded") == 1
    at = order.index("discarded")
    assert order[at - 1] is True
    assert not any(order[at + 1 :])
    decided = int(np.flatnonzero(watched.rows["mode"] == Mode.FAULT)[0])
    told = [data for data in watched.of(0x000) if data == bytes((0x80, 10))][1:]  # the first is the start-up's
    assert (
        len(told) == len(watched.rows) - decided - 1
    )  # in each tick: the node's transmitter is dead, and never says so

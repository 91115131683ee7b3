"""Both lanes on the default scan: bit for bit the same, from run to run, over python-can and at any block length."""

import dataclasses
from collections import Counter

import can
import numpy as np
import pytest
from loop_rig import bus, first_difference, rows_of, setup, shortened

import hil.lanes.blocks
from hil.bus.published_wires import publish
from hil.bus.sim_bus import to_frame, to_message
from hil.lanes import in_process as lanes
from hil.lanes.blocks import Blocks
from hil.lanes.lockstep import LockstepRig
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.loop.controller import StartUpError
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode

PLANTS = ("nominal", "mild", "harsh", "lab")
CASES = [*((plant, "fd_5k") for plant in PLANTS), ("nominal", "classic_2k"), ("mild", "classic_2k")]


@pytest.mark.parametrize(("plant", "bus_name"), CASES)
def test_lockstep_equals_fast_bit_for_bit(plant, bus_name):
    """Every field of every row, the truth beside the controller's own, over the whole scan."""
    fast, by_hand = rows_of(setup(plant, bus_name), "fast")
    slow, over_bus = rows_of(setup(plant, bus_name), "lockstep")
    assert first_difference(slow, fast) is None
    ticks = round(1.1e6 / bus(bus_name).period_us)
    assert len(fast) == by_hand.ticks == over_bus.ticks == ticks
    assert by_hand.faults == over_bus.faults == ()
    assert by_hand.missed_ticks == over_bus.missed_ticks == 0
    assert by_hand.bus_load is None
    assert over_bus.bus_load is not None
    assert (
        {"fd_5k": 0.66, "classic_2k": 0.56}[bus_name]
        < over_bus.bus_load
        < {"fd_5k": 0.71, "classic_2k": 0.60}[bus_name]
    )
    modes = Counter(fast["mode"].tolist())
    homing = round(0.05e6 / bus(bus_name).period_us)
    assert modes == {Mode.HOMING: homing - 1, Mode.IDLE: 1, Mode.ENABLED: 1, Mode.TRACKING: ticks - homing - 1}


def test_the_lanes_agree_for_as_long_as_one_likes():
    """Both sides' heartbeats drift past one another; a tick with both of them would be too full for its SYNC."""
    long = dataclasses.replace(setup("mild"), duration_s=6.0)
    fast, _ = rows_of(long, "fast")
    slow, over_bus = rows_of(long, "lockstep")
    assert over_bus.missed_ticks == 0
    assert first_difference(slow, fast) is None


@pytest.mark.parametrize(("plant", "seed"), [("mild", 1), ("mild", 2), ("lab", 3)])
def test_the_lanes_agree_under_the_default_law_while_it_learns(plant, seed):
    """Fast and lockstep, with what is learnt at work: it changes the bits, and the same ones in both."""
    learning = load("controllers", "youla", ControllerConfig).model_copy(update={"learn": "online"})
    scan = dataclasses.replace(setup(plant, seed=seed), controller=learning, duration_s=0.6)
    fast, _ = rows_of(scan, "fast")
    assert first_difference(rows_of(scan, "lockstep")[0], fast) is None
    alone = dataclasses.replace(scan, controller=learning.model_copy(update={"learn": "off"}))
    assert first_difference(rows_of(alone, "fast")[0], fast) is not None


def test_a_slow_adapter_is_the_same_in_both_lanes():
    """Two periods from sample to action: frames that leave a period late, and a compiled loop that waits as long."""
    slow_bus = bus("fd_5k").model_copy(update={"delay_periods": 2})
    two_periods = dataclasses.replace(shortened(setup("mild"), 2500), bus=slow_bus)
    fast, _ = rows_of(two_periods, "fast")
    slow, over_bus = rows_of(two_periods, "lockstep")
    assert first_difference(slow, fast) is None
    assert over_bus.faults == ()
    tracking = fast[fast["mode"] == Mode.TRACKING]
    assert np.abs(tracking["position_m"] - tracking["reference_m"]).max() < 60e-9


@pytest.mark.parametrize("lane", ["fast", "lockstep"])
def test_one_seed_the_same_bits_another_seed_not(lane):
    once, _ = rows_of(shortened(setup("harsh"), 1500), lane)
    again, _ = rows_of(shortened(setup("harsh"), 1500), lane)
    other, _ = rows_of(shortened(setup("harsh", seed=2), 1500), lane)
    assert first_difference(once, again) is None
    difference = first_difference(once, other)
    assert difference is not None
    assert difference.startswith("tick 0: ")
    assert np.abs(once["position_m"] - other["position_m"]).max() < 1e-6  # another noise, not another machine


def test_the_comparison_sees_one_bit():
    rows, _ = rows_of(shortened(setup(), 300), "fast")
    for name in ("demand_n", "position_m", "mode", "trips"):
        other = rows.copy()
        field = other[name] if other[name].ndim == 1 else other[name][:, 1]
        view = field[250:251].copy().view(np.uint8)
        view[0] ^= 1
        field[250] = view.view(field.dtype)[0]
        assert str(first_difference(rows, other)).startswith(f"tick 250: {name} ")
    assert first_difference(rows, rows[:-1]) == "300 rows against 299"


@pytest.mark.parametrize("lane", ["fast", "lockstep"])
@pytest.mark.parametrize("length", [1, 37, 300, 1000])
def test_the_ends_of_blocks_do_not_show(lane, length, monkeypatch):
    """1300 ticks whole, and in blocks of a length that cuts homing, enabling and the move anywhere."""
    short = shortened(setup("mild"), 1300)
    whole, _ = rows_of(short, lane)
    monkeypatch.setattr(hil.lanes.blocks, "BLOCK_TICKS", length)
    sizes, done = [], []
    blocks = []

    def on_block(block):
        sizes.append(len(block))
        blocks.append(block.copy())

    lanes.run(short, lane, on_block=on_block, on_progress=lambda now, total: done.append((now, total)))
    assert first_difference(np.concatenate(blocks), whole) is None
    assert sizes == [length] * (1300 // length) + [1300 % length] * (1300 % length > 0)
    assert done[-1] == (1300, 1300)
    assert [now for now, _ in done] == sorted(now for now, _ in done)


class PythonCanPort:
    """``runtime.Port`` over python-can alone, as a tool of somebody else's would be."""

    def __init__(self, bus_: can.BusABC, rig: LockstepRig) -> None:
        self._bus, self._rig = bus_, rig

    def send(self, frame: Frame) -> None:
        self._bus.send(to_message(frame, 0, "ignored", is_rx=False))

    def receive(self, deadline_us: int) -> Frame | None:
        message = self._bus.recv(max(0, deadline_us - self._rig.clock.now_us) * 1e-6)
        return None if message is None else to_frame(message)

    def unsent(self) -> int:
        return 0


@pytest.mark.parametrize("bus_name", ["fd_5k", "classic_2k"])
def test_over_a_python_can_bus_the_bits_are_the_same(bus_name):
    """The controller on ``can.Bus(interface="pkxyz-sim")`` in place of the wire's own port: start-up and 600 ticks."""
    short = shortened(setup("nominal", bus_name), 600)
    direct, _ = rows_of(short, "lockstep")
    rows = []
    rig = LockstepRig(short)
    channel = f"lanes {bus_name}"
    publish(rig.wire, channel)
    with can.Bus(interface="pkxyz-sim", channel=channel, receive_error_frames=False) as python_can:
        port = PythonCanPort(python_can, rig)
        rig.port, rig.controller._send = port, port.send
        blocks = Blocks(short.trajectory, short.bus.period_us, 600, lambda b: rows.append(b.copy()), lambda *_: None)
        rig.run(blocks)
    assert first_difference(np.concatenate(rows), direct) is None


def test_a_bus_without_frames_runs_in_the_fast_lane_only():
    local = dataclasses.replace(setup(), bus=bus("local_20k"), duration_s=0.01)
    rows, result = rows_of(local, "fast")
    assert len(rows) == result.ticks == 200
    with pytest.raises(ConfigError, match=r"'local_20k' has no \[can\].*use the fast lane"):
        rows_of(local, "lockstep")
    with pytest.raises(ValueError, match="the wall lane waits for a clock"):
        rows_of(local, "wall")


def test_a_frame_that_our_own_gate_blocks_ends_the_start_up_with_its_reason():
    """Nobody would ever answer it: saying that the amplifier doesn't would send people to the wiring."""
    short = shortened(setup(), 10)
    rig = LockstepRig(short)
    rig.controller.record["gate"]["writes"]["timeout_max_ms"] = 40
    blocks = Blocks(short.trajectory, short.bus.period_us, 10, lambda _: None, lambda *_: None)
    with pytest.raises(StartUpError, match=r"consumer of our heartbeat\): 0x7F0032 is not permitted"):
        rig.run(blocks)
    assert rig.controller.mode == Mode.PRE_OPERATIONAL


def test_what_was_run_before_an_interruption_is_handed_on():
    """Ctrl-C while the SYNC of tick 1234 is on the wire: the 1234 rows before it arrive, and the exception too."""
    short, blocks = shortened(setup(), 2000), []
    rig = LockstepRig(short)
    syncs = 0

    def interrupt(frame, sender, t_us):
        nonlocal syncs
        syncs += frame.can_id == 0x080
        if syncs == 1235:
            raise KeyboardInterrupt

    rig.wire.disturbance.set_tap(interrupt)
    with pytest.raises(KeyboardInterrupt):
        rig.run(Blocks(short.trajectory, 200, 2000, lambda b: blocks.append(b.copy()), lambda *_: None))
    whole, _ = rows_of(short, "lockstep")
    assert first_difference(np.concatenate(blocks), whole[:1234]) is None


def test_every_column_of_the_row_is_alive():
    """No field of the record stays 0 through a scan, but those that tell of trouble."""
    rows, _ = rows_of(setup("harsh"), "lockstep")
    quiet = {"trips", "request", "outside_trips", "sense_status", "node_events", "overrun", "saturated", "slack_n"}
    quiet |= {"solver_iterations", "learnt_n"}  # of another law
    quiet |= {"quiet", "warning", "warning_share"}  # an operator's wish, and of a device that changes
    quiet |= {"output", "output_acting", "output_late_ns", "terminal_output"}  # this scan triggers nothing
    for name in ROW.names:
        alive = bool(np.any(rows[name]))
        assert alive or name in quiet, name
        if name in quiet - {"slack_n"}:
            assert not alive, name
        if rows[name].ndim == 2 and name not in quiet:
            assert all(len(np.unique(rows[name][:, i])) > 100 for i in range(3)), name

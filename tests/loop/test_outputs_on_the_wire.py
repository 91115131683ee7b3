"""Triggers on the wire: what RPDO 1 carries, when it acts at the node's terminals, and who waits for whom."""

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hil.bus.frame_time import frame_duration_ns
from hil.lanes.blocks import Blocks
from hil.lanes.lockstep import LockstepRig
from hil.lanes.setup import Setup
from hil.node.object_dictionary import Abort, SdoAbortError
from hil.node.signature import signature
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.can.driver_rules import SAFETY_OBJECTS
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.config.triggers import BITS, IN_POSITION, LINE, POSITION, PositionTrigger, TriggersConfig
from pkxyz_ctrl.loop.outputs import aim
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import Trip

RPDO1, SIGNATURE, NODE, OURS, SYNC = 0x20A, 0x38A, 0x70A, 0x77F, 0x080
EVERY = 240


def setup_of(bus: str, duration_s: float, triggers: TriggersConfig | None = None) -> Setup:
    made = load_scenario("raster", bus=bus).setup()
    return dataclasses.replace(made, duration_s=duration_s, triggers=triggers)


class Bits(Blocks):
    """The path's bits are ``of(tick)``."""

    def __init__(self, setup: Setup, of=None) -> None:
        self.got: list[np.ndarray] = []
        self._of = of
        super().__init__(
            setup.trajectory, setup.bus.period_us, setup.ticks, lambda b: self.got.append(b.copy()), lambda *_: None
        )

    def reference(self, memory):
        rows = super().reference(memory)
        if self._of is not None:
            rows = rows.copy()
            rows["output"] = self._of(rows["tick"])
        return rows


def run(setup: Setup, log: Path | None = None, of=None, **kinds):
    rig, blocks = LockstepRig(setup, log, **kinds), Bits(setup, of)
    missed, _ = rig.run(blocks)
    return np.concatenate(blocks.got), missed, rig


def frames_of(log: Path) -> list[tuple[float, int, str]]:
    """When each ended, in us, its identifier and data."""
    found = []
    for line in log.read_text().splitlines():
        at, _, frame = line.split()
        can_id, _, data = frame.partition("#")
        found.append((float(at.strip("()")) * 1e6, int(can_id, 16), data.lstrip("#")))
    return found


def any_bits(tick):
    """All five bits, another pattern in every tick."""
    return (tick * 7 + tick // 31) % 32


# -- room ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bus", ["fd_5k", "classic_2k", "socketcan_fd", "unix_1k"])
def test_outputs_that_change_in_every_tick_delay_no_sync_and_lose_no_heartbeat(bus: str, tmp_path: Path) -> None:
    """On fd_5k one short frame fits behind the drive frame: outputs wait a tick for the node's heartbeat and for its
    signature, and our heartbeat waits for them, up to 5 ms. On the others there is room for all.
    """
    rows, missed, rig = run(setup_of(bus, 0.4), tmp_path / "frames.log", any_bits)
    assert (missed, rig.controller.faults) == (0, [])
    tracking = rows["mode"] == Mode.TRACKING
    assert (rows["output_acting"] == rows["terminal_output"]).all(), "what was sent acts"
    frames = frames_of(tmp_path / "frames.log")
    first = next(n for n, (_, can_id, _) in enumerate(frames) if can_id == SYNC)
    times = {can_id: np.array([t for t, c, _ in frames[first:] if c == can_id]) for can_id in (SYNC, NODE, OURS)}
    period_us = rig.setup.bus.period_us
    assert np.abs(np.diff(times[SYNC]) - period_us).max() <= 2, "its length depends on its counter, no more"
    assert np.diff(times[NODE]).max() <= 20_000 + period_us
    assert np.diff(times[OURS]).max() <= 25_000 + period_us
    late = np.flatnonzero(tracking[:-1] & (rows["output"][:-1] != rows["output_acting"][1:]))
    if bus == "fd_5k":
        beats = len(times[NODE]) + sum(c == SIGNATURE for _, c, _ in frames[first:]) + len(times[OURS])
        assert 0 < len(late) <= 2 * beats, "one for each, and one in which what rose meanwhile is still up"
    else:
        assert len(late) == 0


def test_a_bit_that_rose_for_one_tick_is_not_lost_beside_a_heartbeat(tmp_path: Path) -> None:
    """It goes out a tick later, or two where a heartbeat and a signature follow one another, and for a tick."""
    rows, _, _ = run(setup_of("fd_5k", 0.4), of=lambda tick: np.where(tick % 5 == 0, 1, 0))
    asked, put_out = rows["output"] & LINE, rows["terminal_output"].astype(int) & LINE
    rises = [int(np.count_nonzero(np.diff(bits) == 1)) for bits in (asked, put_out)]
    assert rises[0] > 100
    assert rises[1] == rises[0]
    assert np.count_nonzero(asked[:-1] != put_out[1:]) > 0, "some did wait"


@pytest.mark.parametrize("bus", ["fd_5k", "classic_2k", "socketcan_fd"])
def test_a_frame_of_one_byte_is_no_longer_than_is_reckoned_with(bus: str) -> None:
    can = load("buses", bus, BusConfig).can
    assert can is not None
    fd = can.data_bitrate_bit_per_s is not None
    longest_ns = max(
        frame_duration_ns(Frame(can_id, bytes([byte]), fd, fd), can.nominal_bitrate_bit_per_s,
                          can.data_bitrate_bit_per_s or can.nominal_bitrate_bit_per_s)
        for can_id in (0x201, RPDO1, 0x27F, OURS, 0x701) for byte in range(256)
    )  # fmt: skip
    assert longest_ns <= 1000 * can.short_frame_us <= 1.1 * longest_ns


def test_whole_ticks_carry_them_to_the_same_bits(tmp_path: Path) -> None:
    triggers = TriggersConfig(window_m=20e-9, position=PositionTrigger(axis="x", start_m=-1e-6, pitch_m=2e-7, count=9))
    made = [
        run(setup_of("fd_5k", 0.3, triggers), tmp_path / f"{n}.log", lambda tick: tick // 5 % 8, whole_ticks=whole)
        for n, whole in enumerate((True, False))
    ]
    assert made[0][0].tobytes() == made[1][0].tobytes()
    assert (tmp_path / "0.log").read_bytes() == (tmp_path / "1.log").read_bytes()
    assert {0, LINE, IN_POSITION, POSITION} <= {int(b) & m for b in made[0][0]["output"] for m in (0, *BITS.values())}


def test_nothing_is_put_out_in_a_fault_and_all_is_low_behind_it() -> None:
    setup = dataclasses.replace(setup_of("fd_5k", 0.2))
    rig, blocks = LockstepRig(setup), Bits(setup, lambda tick: np.full(len(tick), 31))
    rig.clock.call_at(250_000, lambda: rig.node.amplifier_fault(0x2310))
    rig.run(blocks)
    rows = np.concatenate(blocks.got)
    fault = rows["mode"] == Mode.FAULT
    assert (rows["terminal_output"] == 31).any()
    assert fault.any()
    assert not rows["terminal_output"][np.flatnonzero(fault)[0] + 1 :].any()
    assert not rows["output"][fault].any()
    assert len(rig.controller.faults) == 1, rig.controller.faults


def test_a_foreign_node_without_outputs_goes_on() -> None:
    setup = setup_of("fd_5k", 0.12)
    rig, blocks = LockstepRig(setup), Bits(setup, any_bits)
    objects = rig.node._sdo._objects
    read = objects.read

    def without(index: int, subindex: int) -> bytes:
        if index == 0x6200:
            raise SdoAbortError(Abort.NO_OBJECT)
        return read(index, subindex)

    objects.read = without
    rig.run(blocks)
    rows = np.concatenate(blocks.got)
    assert any("no digital outputs" in words for words in rig.controller.driver.lost)
    assert (rows["mode"] == Mode.TRACKING).any()
    assert rows["output"].any()
    assert not rows["output_acting"].any()


# -- positions -------------------------------------------------------------------------------------------------------


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(("axis", "pitch_m", "least"), [("x", 0.25e-6, 300), ("y", 0.2e-6, 30)])
def test_where_the_stage_was_when_the_terminal_rose(axis: str, pitch_m: float, least: int) -> None:
    """Of the default raster: the true position at the rise, less the way since the passage that the row tells, is the
    trigger's to 1.2 times the tracking error, and pulses are late as often as early, those that waited included.
    """
    grid = PositionTrigger(axis=axis, start_m=-1.9e-6, pitch_m=pitch_m, count=16)
    scenario = load_scenario("raster", controller="youla")
    setup = dataclasses.replace(scenario.setup(), triggers=TriggersConfig(position=grid))
    rows, missed, _ = run(setup)
    assert missed == 0
    i, period_s = "xyz".index(axis), setup.bus.period_s
    rows = rows[rows["mode"] == Mode.TRACKING]
    velocity = np.gradient(rows["reference_m"][:, i], period_s)
    acceleration = np.gradient(velocity, period_s)
    truth, terminal = rows["position_m"][:, i], rows["terminal_output"].astype(int) & POSITION
    errors, late_ticks, waited = [], [], 0
    for n in np.flatnonzero(rows["output"][:-3] & POSITION):
        rise = n + 1 if terminal[n + 1] else n + 2
        assert terminal[rise], "no pulse is lost"
        late_s = rows["output_late_ns"][n] * 1e-9 + (rise - n - 1) * period_s
        waited += rise != n + 1
        if abs(velocity[n + 1]) < 20e-6:
            continue
        passed_m = truth[rise] - velocity[rise] * late_s + 0.5 * acceleration[rise] * late_s**2
        errors.append((passed_m - grid.start_m + 0.5 * pitch_m) % pitch_m - 0.5 * pitch_m)
        late_ticks.append(late_s / period_s)
    assert len(errors) > least
    moving = np.abs(velocity) >= 20e-6
    assert rms(errors) <= 1.2 * rms((truth - rows["reference_m"][:, i])[moving])
    assert abs(np.mean(late_ticks)) < 0.1
    assert waited < 0.05 * len(errors)


def test_a_trigger_that_is_aimed_while_the_stage_moves_begins_then() -> None:
    setup = setup_of("fd_5k", 0.4)
    rig, blocks = LockstepRig(setup), Bits(setup)
    rig.clock.call_at(320_000, lambda: aim(rig.controller.outputs, 0, 0, -2e-6, 0.1e-6, 40))
    rig.run(blocks)
    rows = np.concatenate(blocks.got)
    fired = np.flatnonzero(rows["output"] & POSITION)
    assert len(fired) > 3
    assert rows["t_us"][fired[0]] > 200_000


# -- signature -------------------------------------------------------------------------------------------------------


def objects_signed() -> list[tuple[int, int]]:
    rig = LockstepRig(setup_of("fd_5k", 0.1))
    od, found = rig.node.od, []
    before = signature(od)
    for entry in od:
        if isinstance(entry.value, int):
            was, entry.value = entry.value, entry.value ^ 1
            if signature(od) != before:
                found.append((entry.index, entry.subindex))
            entry.value = was
    return found


SIGNED = [
    (0x1005, 0), (0x1016, 1), (0x1017, 0), (0x1019, 0), (0x1029, 1), (0x1401, 1), (0x1401, 2),
    *((0x1601, n) for n in range(6)), (0x1801, 1), (0x1801, 2), *((0x1A01, n) for n in range(6)),
    *((0x6443, n) for n in (1, 2, 3)), *((0x6444, n) for n in (1, 2, 3)), (0x2010, 0), (0x2011, 0), (0x2012, 0),
]  # fmt: skip
"""What keeps the combs safe."""


def test_what_keeps_the_combs_safe_is_signed() -> None:
    assert objects_signed() == SIGNED


@pytest.mark.parametrize("key", SIGNED, ids=lambda key: f"{key[0]:04X}:{key[1]}")
def test_a_change_at_work_trips_within_the_time_between_two_signatures(key: tuple[int, int]) -> None:
    """By the node's back door: over the bus they are locked."""
    setup = setup_of("fd_5k", 0.2)
    rig, blocks = LockstepRig(setup), Bits(setup)
    changed_us = 200_000

    def change() -> None:
        entry = rig.node.od.entry(*key)
        assert isinstance(entry.value, int)
        entry.value = 20_000 if key[0] == 0x6444 else entry.value ^ 1  # 122 V where it leaves operational

    begun: list[int] = []
    rig.clock.call_at(changed_us, change)
    rig.clock.call_at(changed_us, lambda: begun.append(int(rig.controller.memory["tick_index"][0])))
    rig.run(blocks)
    rows = np.concatenate(blocks.got)
    tripped = np.flatnonzero(rows["trips"])
    assert len(tripped), "noticed"
    assert rows["trips"][tripped[0]] == Trip.SAFETY_OBJECTS
    assert tripped[0] - begun[0] <= EVERY + 2
    assert rows["mode"][tripped[0]] == Mode.FAULT
    assert not rows["comb_voltage_v"][tripped[0] + 5 :].any(), "0 V, whatever the node would do by itself now"


def test_a_signature_that_stays_away_trips_within_twice_that_time() -> None:
    setup = setup_of("fd_5k", 0.25)
    rig, blocks = LockstepRig(setup, whole_ticks=False), Bits(setup)  # whole ticks go by the node's rules
    rig.node.signature.ride = lambda has_heartbeat: None
    rig.run(blocks)
    rows = np.concatenate(blocks.got)
    tripped = np.flatnonzero(rows["trips"])
    assert rows["trips"][tripped[0]] == Trip.SAFETY_OBJECTS
    assert tripped[0] <= 2 * EVERY + 3


def test_after_a_clear_the_objects_are_written_and_signed_anew() -> None:
    setup = dataclasses.replace(setup_of("fd_5k", 0.5), clear_s=0.05)
    rig, blocks = LockstepRig(setup), Bits(setup)
    rig.clock.call_at(200_000, lambda: setattr(rig.node.od.entry(0x2010, 0), "value", 200))
    rig.run(blocks)
    rows = np.concatenate(blocks.got)
    assert rows["mode"][-1] in (Mode.ENABLED, Mode.TRACKING)
    assert rig.node.od[0x2010, 0] == 5
    assert not int(rig.controller.exchange["driver"]["node_events"][0, 0]) & SAFETY_OBJECTS
    assert len(rig.controller.faults) == 1


def test_a_damaged_signature_is_not_ours_to_guess() -> None:
    """A wrong length, too: the module then is not the one that was read back."""
    for data in (b"\0\0", b"\0", bytes(8)):
        setup = setup_of("fd_5k", 0.12)
        rig, blocks = LockstepRig(setup), Bits(setup)
        rig.clock.call_at(180_000, partial(rig.node._transmit, SIGNATURE, data))
        rig.run(blocks)
        rows = np.concatenate(blocks.got)
        assert rows["trips"].max() == Trip.SAFETY_OBJECTS, data

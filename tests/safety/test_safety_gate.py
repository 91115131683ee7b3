"""The gate's limits: each boundary passes and one past it does not; what it remembers; and random traffic."""

import dataclasses
import struct

import numpy as np
import pytest
from crccheck.crc import Crc8Autosar
from gate_frames import CONFIG, DRIVE_ID, WRITES, crc8h2f, drive, holding, nmt, sdo_write, sync
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.lanes.wall import wall_gate
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.frame import FD, REMOTE, Frame
from pkxyz_ctrl.can.sdo import SdoStep, request
from pkxyz_ctrl.can.startup import configuration_steps, identity_steps
from pkxyz_ctrl.safety.gate import GateConfig, TransmitGate
from pkxyz_ctrl.safety.gate_rules import GATE, new_gate_memory
from pkxyz_ctrl.safety.modes import Mode

T = 200


def passes(gate: TransmitGate, frame: Frame, t_us: int = T, mode: Mode = Mode.TRACKING) -> bool:
    return gate.check(frame, mode, t_us) is None


def test_oracle_is_the_autosar_crc() -> None:
    assert crc8h2f(b"123456789") == 0xDF
    assert all(crc8h2f(bytes(range(n))) == Crc8Autosar.calc(bytes(range(n))) for n in range(1, 40))


@pytest.mark.parametrize("count_max", [1, 32767])
def test_smallest_and_largest_limit(count_max: int) -> None:
    config = GateConfig(count_max=count_max, count_slew_max=32767, period_us=T)
    assert passes(holding((0, 0, 0), config), drive(count_max, 0, count_max, 0))
    if count_max < 32767:
        assert not passes(holding((0, 0, 0), config), drive(count_max, 0, count_max + 1, 0))


@pytest.mark.parametrize("mode", list(Mode))
def test_zero_is_permitted_from_everywhere_in_every_mode(mode: Mode) -> None:
    assert passes(holding((30000, 29000, 28000)), drive(0, 0, 0, 0), 1, mode)
    assert passes(TransmitGate(CONFIG), drive(0, 0, 0, 77), -5, mode)


def test_spacing_at_its_boundary() -> None:
    assert passes(holding((5, 5, 5)), drive(6, 5, 5, 0), 100)
    assert not passes(holding((5, 5, 5)), drive(6, 5, 5, 0), 99)
    assert not passes(holding((5, 5, 5)), drive(6, 5, 5, 0), -1)


def test_one_voltage_in_a_tick_but_zero_may_follow_at_once() -> None:
    gate = holding((5, 5, 5))
    assert passes(gate, drive(6, 5, 5, 0), T)
    assert passes(gate, drive(0, 0, 0, 1), T)
    assert not passes(gate, drive(0, 0, 0, 2), T + 99)  # a second 0 V says nothing new: babble
    assert passes(gate, drive(0, 0, 0, 2), T + 100)
    gate = holding((5, 5, 5))
    assert passes(gate, drive(6, 5, 5, 0), T)
    assert "no SYNC" in str(gate.check(drive(7, 5, 5, 1), Mode.TRACKING, 3 * T))


def test_voltage_waits_until_a_zero_in_sequence_has_been_sent() -> None:
    """The node ignores a frame whose counter jumped, so that its combs still hold the old voltage."""
    gate = holding((900, 900, 900))
    assert passes(gate, drive(0, 0, 0, 7), T)
    assert passes(gate, sync(), T)
    assert not passes(gate, drive(10, 10, 10, 8), 2 * T)
    gate.clear()
    assert passes(gate, drive(0, 0, 0, 8), 2 * T)
    assert passes(gate, sync(), 2 * T)
    assert passes(gate, drive(10, 10, 10, 9), 3 * T)


@pytest.mark.parametrize("before", [0, 1, 200, 255])
def test_a_zero_whose_counter_jumped_is_not_known_to_be_held(before: int) -> None:
    """Whatever counter came before it; the first ever may carry any."""
    for step in (2, 7, 255):
        gate = TransmitGate(CONFIG)
        assert passes(gate, drive(0, 0, 0, before), 0)
        assert passes(gate, sync(), 0)
        assert passes(gate, drive(0, 0, 0, before + step), T)
        assert passes(gate, sync(), T)
        assert not passes(gate, drive(10, 10, 10, before + step + 1), 2 * T)


def test_frame_made_for_another_node_is_blocked() -> None:
    assert not passes(holding((5, 5, 5)), drive(6, 5, 5, 0, can_id=0x30B))
    swapped = drive(6, 5, 5, 0, can_id=0x30B)._replace(can_id=DRIVE_ID)
    assert not passes(holding((5, 5, 5)), swapped)


@settings(max_examples=100)
@given(
    st.tuples(st.integers(0, 32767), st.integers(0, 32767), st.integers(0, 32767)),
    st.integers(0, 255),
    st.integers(0, 255),
    st.integers(1, 127),
)
def test_crc_by_tables_is_the_crc_by_bits(counts: tuple[int, int, int], counter: int, wrong: int, node: int) -> None:
    config = GateConfig(
        count_max=32767, count_slew_max=32767, period_us=T, node_id=node, controller_node_id=node % 127 + 1
    )
    zero = drive(0, 0, 0, counter - 1, can_id=0x300 + node)
    frame = drive(*counts, counter, can_id=0x300 + node)
    gate = TransmitGate(config)
    assert passes(gate, zero, 0)
    assert passes(gate, sync(), T)
    bad = frame._replace(data=frame.data[:7] + bytes([wrong]))
    assert passes(gate, bad) == (bad == frame)
    gate.clear()
    if bad != frame:
        assert passes(gate, frame)


def test_without_protection_six_bytes_and_nothing_else() -> None:
    config = GateConfig(count_max=30000, count_slew_max=1000, period_us=T, protection=False)
    gate = TransmitGate(config)

    def plain(*counts: int) -> Frame:
        return Frame(DRIVE_ID, struct.pack("<hhh", *counts), True, True)

    assert passes(gate, plain(0, 0, 0), 0)
    assert passes(gate, sync(), T)
    assert passes(gate, plain(1000, 0, 0), T)
    assert passes(gate, sync(), 2 * T)
    for frame in (plain(1000, 1001, 0), plain(-1, 0, 0), plain(0, -1, 0), plain(0, 0, -1), drive(1000, 0, 0, 0)):
        assert not passes(gate, frame, 2 * T)
        gate.clear()
    assert passes(gate, plain(2000, 1000, 0), 2 * T)


def test_voltage_needs_a_zero_first_at_the_start_and_after_nmt() -> None:
    assert not passes(TransmitGate(CONFIG), drive(1, 1, 1, 0))
    gate = TransmitGate(CONFIG)
    assert passes(gate, sync(), 0)  # that the tick is new does not help
    assert not passes(gate, drive(1, 1, 1, 0))
    for command in (0x80, 0x02):
        gate = holding((5, 5, 5))
        assert passes(gate, nmt(command))
        assert not passes(gate, drive(6, 5, 5, 0))
    gate = holding((0, 0, 0))
    assert passes(gate, nmt(0x81), T, Mode.BOOT)
    assert not passes(gate, drive(1, 1, 1, 0), 2 * T)
    gate.clear()


@pytest.mark.parametrize("command", [0x81, 0x82])
@pytest.mark.parametrize("counter", [0, 200, 255])
def test_after_a_reset_any_counter_may_come(command: int, counter: int) -> None:
    gate = holding((900, 900, 900))
    assert passes(gate, nmt(command), T, Mode.BOOT)
    assert passes(gate, drive(0, 0, 0, counter), T)
    assert passes(gate, sync(), 2 * T)
    assert passes(gate, drive(1, 1, 1, counter + 1), 2 * T)


def test_what_a_loop_allows_itself_between_two_voltages() -> None:
    """In lockstep from a tick that waited for its frame in vain to one that had it at once; at rate the guard that the
    clock of the ticks keeps. Never nothing: a program that babbles is held back by it, too.
    """
    for name in ("fd_5k", "unix_1k", "unix_2k", "socketcan_classic"):
        setup = load_scenario("faults", bus=name).setup()
        can, period_us = setup.bus.can, setup.bus.period_us
        assert can is not None
        spacing_us = setup.gate.spacing_min_us
        assert spacing_us == min(period_us // 2, period_us - can.sense_deadline_us - can.compute_us)
        assert spacing_us > 0
        at_rate = wall_gate(setup.gate)
        assert at_rate.spacing_min_us == period_us // 8
        gate = holding((5, 5, 5), dataclasses.replace(CONFIG, period_us=period_us, spacing_min_us=period_us // 8))
        assert not passes(gate, drive(6, 5, 5, 0), period_us // 8 - 1)
        gate.clear()
        assert passes(gate, drive(6, 5, 5, 0), period_us // 8)


@pytest.mark.parametrize("syncs", range(1, 9))
def test_a_sync_without_a_drive_frame_must_be_followed_by_zero(syncs: int) -> None:
    """The node would take the next voltage for a late one: what its combs hold would no longer be what passed here."""
    gate = holding((900, 900, 900))  # one SYNC is behind it
    for k in range(syncs - 1):
        assert passes(gate, sync(), (k + 1) * T)
    assert passes(gate, drive(900, 900, 901, 0), syncs * T) == (syncs == 1)
    gate.clear()
    if syncs > 1:
        assert passes(gate, drive(0, 0, 0, 0), syncs * T)
        assert passes(gate, sync(), (syncs + 1) * T)
        assert passes(gate, drive(1000, 0, 0, 1), (syncs + 1) * T)


def test_clear_keeps_the_slew_limit() -> None:
    gate = holding((500, 500, 500))
    assert not passes(gate, drive(9000, 500, 500, 0))
    gate.clear()
    assert gate.latched == ""
    assert not passes(gate, drive(9000, 500, 500, 0))
    gate.clear()
    assert passes(gate, drive(1500, 500, 500, 0))
    assert gate.blocked_frames == 2


def test_fd_frames_only_where_the_bus_carries_them() -> None:
    classic = GateConfig(count_max=100, count_slew_max=10, period_us=T, fd=False)
    assert "format that this bus does not carry" in str(TransmitGate(classic).check(sync(), Mode.TRACKING, T))
    assert "not a plain data frame" in str(TransmitGate(classic).check(sync()._replace(flags=REMOTE), Mode.TRACKING, T))
    assert passes(TransmitGate(classic), sync()._replace(flags=0))
    assert passes(TransmitGate(CONFIG), sync()._replace(flags=0))
    assert passes(TransmitGate(CONFIG), sync()._replace(flags=FD))


@pytest.mark.parametrize(("index", "subindex", "size", "permitted", "refused"), WRITES)
@pytest.mark.parametrize("mode", [Mode.BOOT, Mode.PRE_OPERATIONAL])
def test_sdo_writes_value_by_value(
    mode: Mode, index: int, subindex: int, size: int, permitted: list[int], refused: list[int]
) -> None:
    gate = TransmitGate(CONFIG)
    for value in permitted:
        assert passes(gate, sdo_write(index, subindex, value, size), T, mode), hex(value)
    spoilt = [sdo_write(index, subindex, value, size) for value in refused]
    value = permitted[0]
    spoilt += [sdo_write(index, subindex, value, other) for other in {1, 2, 3, 4} - {size} if value < 256**other]
    plain = sdo_write(index, subindex, value, size).data
    # without its size (0x22), segmented (0x21), a segment (0x00), block download (0xC6)
    spoilt += [Frame(0x60A, bytes([command]) + plain[1:]) for command in (0x22, 0x21, 0x00, 0xC6)]
    if size < 4:
        spoilt.append(Frame(0x60A, plain[:7] + b"\x01"))  # something behind the value
    for frame in spoilt:
        assert not passes(gate, frame, T, mode), frame
        gate.clear()


@pytest.mark.parametrize("mode", list(Mode))
def test_sdo_reads_have_empty_bytes_behind(mode: Mode) -> None:
    gate = TransmitGate(CONFIG)
    requests = [bytes([0x40, 0x18, 0x10, 1, 0, 0, 0, 0]), bytes([0x60, *[0] * 7]), bytes([0x70, *[0] * 7])]
    for good in requests:
        assert passes(gate, Frame(0x60A, good), T, mode)
        for place in range(1 if good[0] != 0x40 else 4, 8):
            bad = good[:place] + b"\x01" + good[place + 1 :]
            assert not passes(gate, Frame(0x60A, bad), T, mode)
            gate.clear()


def test_sdo_writes_over_the_whole_dictionary() -> None:
    """One byte of value 1, to index after index: what is not listed never passes."""
    gate = TransmitGate(CONFIG)
    passed = set()
    for index in range(0x10000):
        if 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00 or (index % 31 and index >= 0x7000):
            continue  # mappings, which are open; and most of what no profile of ours defines
        for subindex in (0, 1, 3):
            frame = sdo_write(index, subindex, 1, 1)
            if passes(gate, frame, T, Mode.BOOT):
                passed.add(index)
            else:
                gate.clear()
    assert passed == {0x2010, 0x6443}  # of one byte, and content with the value 1


@pytest.mark.parametrize("protection", [True, False])
@pytest.mark.parametrize("mode", [Mode.BOOT, Mode.PRE_OPERATIONAL])
def test_drivers_own_start_up_passes(protection: bool, mode: Mode) -> None:
    config = DriverConfig(protection=protection)
    gate = TransmitGate(GateConfig(count_max=1, count_slew_max=1, period_us=T, protection=protection))
    for step in (*identity_steps(config), *configuration_steps(config, 1)):
        assert gate.check(Frame(0x600 + config.node_id, request(step), True, True), mode, T) is None


def test_the_drive_frame_may_be_that_of_another_pdo_with_other_channels() -> None:
    config = DriverConfig(drive_pdo=1, sense_pdo=1, drive_channels=(4, 2, 7), sense_channels=(9, 8, 7))
    gate = TransmitGate(
        GateConfig(count_max=100, count_slew_max=100, period_us=T, drive_pdo=1, drive_channels=(4, 2, 7))
    )
    for step in (*identity_steps(config), *configuration_steps(config, 1)):
        assert gate.check(Frame(0x60A, request(step), True, True), Mode.BOOT, T) is None
    for index, subindex, size, value in (
        (0x1600, 1, 4, 0x64110110),
        (0x1401, 1, 4, 0x30A),
        (0x1401, 2, 1, 1),
        (0x6443, 1, 1, 1),
        (0x6444, 3, 4, 0),
    ):
        step = SdoStep(index, subindex, size, value, True, "", "")
        assert gate.check(Frame(0x60A, request(step), True, True), Mode.BOOT, T) is not None
    gate.clear()
    drives = [Frame(can_id, ProcessCodec(can_id, True).encode((0, 0, 0), 0), True, True) for can_id in (0x20A, 0x30A)]
    assert gate.check(drives[0], Mode.ENABLED, 2 * T) is None
    assert "not in the list" in str(gate.check(drives[1], Mode.ENABLED, 3 * T))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"drive_pdo": 5}, "drive_pdo"),
        ({"count_max": -1}, "count_max"),
        ({"count_max": 32768}, "count_max"),
        ({"count_max": 1.5}, "count_max"),
        ({"count_slew_max": 0}, "count_slew_max"),
        ({"period_us": 1}, "period_us"),
        ({"node_id": 0}, "node_id"),
        ({"node_id": 128}, "node_id"),
        ({"node_id": 127}, "controller_node_id"),
        ({"spacing_min_us": 201}, "spacing_min_us"),
    ],
)
def test_bad_config_is_refused_by_name(changes: dict[str, int], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        GateConfig(**{"count_max": 100, "count_slew_max": 10, "period_us": T, **changes})  # type: ignore[arg-type]


def test_reason_names_frame_mode_and_rule() -> None:
    reason = TransmitGate(CONFIG).check(drive(1, 2, 3, 4), Mode.IDLE, T)
    assert str(reason).startswith("frame 0x30A [01 00 02 00 03 00 04 ")
    assert str(reason).endswith("blocked in IDLE: DRIVE is not permitted now")
    assert "SYNC is not permitted" in str(TransmitGate(CONFIG).check(sync(), 8, T))
    assert "1..240" in str(TransmitGate(CONFIG).check(sync(0), Mode.IDLE, T))


def test_a_gate_may_stand_in_somebody_elses_records() -> None:
    record, memory = np.zeros(1, GATE), new_gate_memory()
    gate = TransmitGate(CONFIG, record, memory)
    assert record.tobytes() == CONFIG.record.tobytes()
    assert not record.flags.writeable
    assert passes(gate, drive(0, 0, 0, 0), T)
    assert memory["time_us"][0] == T

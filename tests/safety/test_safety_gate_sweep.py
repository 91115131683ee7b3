"""The gate's full sweep, imposed on each mode in turn.

All 2048 identifiers with all lengths and a payload of every kind; and of each kind every value where there are few,
else each boundary and one step past it. A mode adds nothing but the list of what it permits.
"""

from abc import ABC
from collections.abc import Iterable, Set
from dataclasses import replace
from itertools import combinations

import pytest
from gate_frames import CONFIG, DRIVE_ID, WRITES, drive, holding, nmt, sdo_read, sdo_write, sync

from pkxyz_ctrl.can.frame import BIT_RATE_SWITCH, ERROR, EXTENDED, REMOTE, UNUSUAL, Frame
from pkxyz_ctrl.safety.gate import GateConfig, TransmitGate
from pkxyz_ctrl.safety.modes import Mode

LENGTHS = [*range(9), 12, 16, 20, 24, 32, 48, 64]
HELD = (500, 600, 700)

# One payload of every kind that some identifier may carry in some mode.
PAYLOADS: dict[str, bytes] = {
    "nothing": b"",  # SYNC without counter
    "one 0x05": b"\x05",  # SYNC 5, and our heartbeat
    "one 0xF0": b"\xf0",  # SYNC 240
    "start": nmt(0x01).data,
    "stop": nmt(0x02).data,
    "pre-operational": nmt(0x80).data,
    "reset node": nmt(0x81).data,
    "reset communication": nmt(0x82).data,
    "sdo read": sdo_read(0x6411, 1).data,
    "sdo abort": sdo_read(0x1018, 1).data.replace(b"\x40", b"\x80", 1),
    "sdo write": sdo_write(0x1017, 0, 20, 2).data,
    "sdo write of a voltage": sdo_write(0x6411, 1, 100, 2).data,
    "drive 0 V": drive(0, 0, 0, 0).data,
    "drive": drive(501, 601, 701, 0).data,
}
ALWAYS = {
    (0x080, "nothing"),
    (0x080, "one 0x05"),
    (0x080, "one 0xF0"),
    (0x77F, "one 0x05"),
    (0x000, "stop"),
    (0x000, "pre-operational"),
    (DRIVE_ID, "drive 0 V"),
}
READ = {(0x60A, "sdo read"), (0x60A, "sdo abort")}
WRITE = {(0x60A, "sdo write")}
START = {(0x000, "start")}
RESET = {(0x000, "reset node"), (0x000, "reset communication")}
DRIVE = {(DRIVE_ID, "drive")}


WIDE = replace(CONFIG, count_max=32767, count_slew_max=32767)
MOST, SLEW = CONFIG.count_max, CONFIG.count_slew_max
# A comb's count now, and what is asked of it: at each boundary, and one step past it.
STEPS = [
    (MOST - SLEW // 2, MOST),
    (MOST - SLEW // 2, MOST + 1),
    (SLEW // 2, -1),
    (SLEW // 2, -32768),
    (SLEW // 2, 32767),
    (500, 500 + SLEW),
    (500, 501 + SLEW),
    (2500, 2500 - SLEW),
    (2500, 2499 - SLEW),
    (SLEW, 0),
    (SLEW + 1, 0),
]


class GateSweep(ABC):
    """What holds in every mode; a subclass says what that mode permits of :data:`PAYLOADS`."""

    mode: int
    permitted: Set[tuple[int, str]]

    def gate(self, held: tuple[int, int, int] = HELD, config: GateConfig = CONFIG) -> TransmitGate:
        """A gate that last let ``held`` pass, so that a small step is the best that a drive frame can be."""
        return holding(held, config)

    def forget(self, gate: TransmitGate) -> None:
        """After a blocked frame, as if it had not been asked."""
        gate.clear()

    def passes(self, gate: TransmitGate, frame: Frame) -> bool:
        """Whether it does, 10 ms after the last drive frame; if not, forgotten."""
        if gate.check(frame, self.mode, 10_000) is None:
            return True
        self.forget(gate)
        return False

    def passed(self, frames: Iterable[tuple[str, Frame]]) -> set[tuple[int, str]]:
        """Identifier and name of the frames that pass, each after ``HELD``."""
        result = set()
        gate = self.gate()
        for name, frame in frames:
            if self.passes(gate, frame):
                result.add((frame.can_id, name))
                gate = self.gate()
        return result

    @pytest.mark.parametrize("fd", [False, True])
    def test_every_identifier_with_every_kind_of_payload(self, fd: bool) -> None:
        frames = ((name, Frame(can_id, data, fd, fd)) for can_id in range(2048) for name, data in PAYLOADS.items())
        assert self.passed(frames) == self.permitted

    @pytest.mark.parametrize("fill", [0x00, 0x40, 0xFF])
    def test_every_identifier_with_every_length(self, fill: int) -> None:
        """No bytes, and 0x40, are well-formed for SYNC alone (an SDO read must have empty bytes behind)."""
        frames = (
            (str(length), Frame(can_id, bytes([fill]) * length, True, True))
            for can_id in range(2048)
            for length in LENGTHS
        )
        may_sync = (0x080, "one 0x05") in self.permitted
        empty, counted = {(0x080, "0")}, {(0x080, "1")}
        assert self.passed(frames) == (set() if not may_sync else empty | counted if fill == 0x40 else empty)

    def test_identifiers_of_29_bits_that_end_like_ours(self) -> None:
        """Every extended identifier with one or two bits above the eleven, and a payload that its end may carry."""
        gate = self.gate()
        above = [1 << a | 1 << b for a in range(11, 29) for b in range(11, 29)]
        for can_id, name in sorted(self.permitted):
            for bits in above:
                for extended in (False, True):
                    frame = Frame(can_id | bits, PAYLOADS[name], is_extended=extended)
                    assert not self.passes(gate, frame), frame

    def test_permitted_payloads_with_another_length_or_format(self) -> None:
        gate = self.gate()
        for can_id, name in sorted({*self.permitted, *ALWAYS, *DRIVE}):
            payload = PAYLOADS[name]
            spoilt = [Frame(can_id, payload + b"\x00", True, True)]
            if can_id != 0x080:  # without its byte, it is a SYNC all the same
                spoilt += [Frame(can_id, payload[:-1])]
            plain = Frame(can_id, payload)
            spoilt += [plain._replace(flags=flag) for flag in (REMOTE, EXTENDED, ERROR, UNUSUAL)]
            spoilt += [plain._replace(flags=BIT_RATE_SWITCH)]  # which only FD frames have
            for frame in spoilt:
                assert not self.passes(gate, frame), frame

    @pytest.mark.parametrize("comb", [0, 1, 2])
    @pytest.mark.parametrize(("held", "asked"), STEPS)
    def test_drive_counts_at_each_boundary_and_one_past_it(self, held: int, asked: int, comb: int) -> None:
        now, then = [500, 500, 500], [500, 500, 500]
        now[comb], then[comb] = held, asked
        gate = self.gate((now[0], now[1], now[2]))
        within = 0 <= asked <= MOST and abs(asked - held) <= SLEW
        assert self.passes(gate, drive(*then, 0)) == (within and self.permitted >= DRIVE)

    def test_alive_counter_over_all_its_values(self) -> None:
        """A voltage needs the next one; 0 V any that the node does not take for a repetition."""
        for counter in range(256):
            small = drive(501, 601, 701, counter)
            assert self.passes(self.gate(), small) == (counter == 0 and self.permitted >= DRIVE)
            zero = drive(0, 0, 0, counter)
            assert self.passes(self.gate(), zero) == (counter != 255 and (DRIVE_ID, "drive 0 V") in self.permitted)

    @pytest.mark.parametrize("name", ["drive", "drive 0 V"])
    def test_every_error_of_one_or_two_bits_in_a_drive_frame(self, name: str) -> None:
        """Held back by the CRC alone, since no limit is in the way."""
        gate, word = self.gate(HELD, WIDE), int.from_bytes(PAYLOADS[name], "little")
        masks = [1 << a for a in range(64)] + [1 << a | 1 << b for a, b in combinations(range(64), 2)]
        assert len(masks) == 64 + 2016
        for mask in masks:
            assert not self.passes(gate, Frame(DRIVE_ID, (word ^ mask).to_bytes(8, "little"))), hex(mask)

    def test_sync_over_all_its_values(self) -> None:
        gate = self.gate()
        passed = [value for value in range(256) if self.passes(gate, sync(value))]
        assert passed == (list(range(1, 241)) if (0x080, "one 0x05") in self.permitted else [])

    def test_heartbeat_over_all_its_values(self) -> None:
        gate = self.gate()
        passed = [value for value in range(256) if self.passes(gate, Frame(0x77F, bytes([value])))]
        assert passed == ([5] if (0x77F, "one 0x05") in self.permitted else [])

    def test_nmt_over_all_commands_and_nodes(self) -> None:
        gate = self.gate()
        ours = {PAYLOADS[name] for can_id, name in self.permitted if can_id == 0x000}
        commands = [nmt(command, node) for command in range(256) for node in (0, 1, 9, 10, 11, 127, 128, 255)]
        commands += [nmt(command, node) for command in (0x01, 0x02, 0x80, 0x81, 0x82) for node in range(256)]
        assert {frame.data for frame in commands if self.passes(gate, frame)} == ours

    def test_sdo_command_bytes_over_all_their_values(self) -> None:
        """With an object that may be read and written; 0 as its value, so that no command leaves bytes behind it."""
        gate = self.gate()
        plain = sdo_write(0x1801, 5, 0, 2).data
        passed = {command for command in range(256) if self.passes(gate, Frame(0x60A, bytes([command]) + plain[1:]))}
        read, write = self.permitted >= READ, self.permitted >= WRITE
        assert passed == ({0x40, 0x80} if read else set()) | ({0x2B} if write else set())

    def test_sdo_writes_value_by_value(self) -> None:
        """Each object that may be written, with what it may hold and one past it, where the mode configures at all."""
        gate = self.gate()
        for index, subindex, size, permitted, refused in WRITES:
            for value in permitted:
                frame = sdo_write(index, subindex, value, size)
                assert self.passes(gate, frame) == (self.permitted >= WRITE), frame
            for value in refused:
                assert not self.passes(gate, sdo_write(index, subindex, value, size))

    def test_no_voltage_behind_the_back_of_the_modes(self) -> None:
        gate = self.gate()
        for index in (0x6411, 0x6413, 0x6421, 0x6423, 0x2000, 0x1010, 0x1011, 0x1F51):
            for subindex in range(5):
                for size in (1, 2, 3, 4):
                    assert not self.passes(gate, sdo_write(index, subindex, 0, size))

    def test_blocked_frame_leaves_only_what_is_always_permitted(self) -> None:
        gate = self.gate()
        first = gate.latched
        blocked = gate.check(Frame(0x123, b"first"), self.mode, 10_000)
        assert blocked is not None
        first = first or blocked
        assert gate.latched == first
        for can_id, name in sorted({*self.permitted, *DRIVE} - ALWAYS):
            assert gate.check(Frame(can_id, PAYLOADS[name]), self.mode, 10_000) is not None
        assert gate.latched == first
        always = {pair for pair in ALWAYS if gate.check(Frame(pair[0], PAYLOADS[pair[1]]), self.mode, 10_000) is None}
        assert always == self.permitted & ALWAYS


class TestBoot(GateSweep):
    mode = Mode.BOOT
    permitted = ALWAYS | READ | WRITE | START | RESET


class TestPreOperational(GateSweep):
    mode = Mode.PRE_OPERATIONAL
    permitted = ALWAYS | READ | WRITE | START | RESET


class TestIdle(GateSweep):
    mode = Mode.IDLE
    permitted = ALWAYS | READ | RESET


class TestHoming(GateSweep):
    mode = Mode.HOMING
    permitted = ALWAYS | READ


class TestEnabled(GateSweep):
    mode = Mode.ENABLED
    permitted = ALWAYS | READ | DRIVE


class TestTracking(GateSweep):
    mode = Mode.TRACKING
    permitted = ALWAYS | READ | DRIVE


class TestFault(GateSweep):
    mode = Mode.FAULT
    permitted = ALWAYS | READ | RESET


class TestLanding(GateSweep):
    mode = Mode.LANDING
    permitted = ALWAYS | READ | DRIVE


class TestLatched(GateSweep):
    mode = Mode.TRACKING
    permitted = ALWAYS

    def gate(self, held: tuple[int, int, int] = HELD, config: GateConfig = CONFIG) -> TransmitGate:
        gate = super().gate(held, config)
        gate.check(Frame(0x7FF, b""), Mode.TRACKING, 0)
        return gate

    def forget(self, gate: TransmitGate) -> None:
        assert gate.latched


class TestUnknownMode(GateSweep):
    mode = 8
    permitted = frozenset[tuple[int, str]]()


class TestNegativeMode(GateSweep):
    mode = -1
    permitted = frozenset[tuple[int, str]]()


def test_every_mode_is_swept() -> None:
    assert {sweep.mode for sweep in GateSweep.__subclasses__()} == {*map(int, Mode), 8, -1}

"""The gate over all 2048 identifiers, all lengths and a payload of every kind, imposed on each mode in turn."""

from collections.abc import Iterator, Set

import pytest
from gate_frames import DRIVE_ID, drive, holding, nmt, sdo_read, sdo_write, sync

from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.safety.gate import TransmitGate
from pkxyz_ctrl.safety.modes import Mode

LENGTHS = [*range(9), 12, 16, 20, 24, 32, 48, 64]
HELD = (500, 600, 700)

# One payload of every kind that some identifier may carry in some mode.
PAYLOADS: dict[str, bytes] = {
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


class GateSweep:
    """What holds in every mode; a subclass says what that mode adds."""

    mode: int
    permitted: Set[tuple[int, str]]

    def gate(self) -> TransmitGate:
        """A gate that last let ``HELD`` pass, so that a small step is the best that a drive frame can be."""
        return holding(HELD)

    def forget(self, gate: TransmitGate) -> None:
        """After a blocked frame, as if it had not been asked."""
        gate.clear()

    def passed(self, frames: Iterator[tuple[str, Frame]]) -> set[tuple[int, str]]:
        result = set()
        gate = self.gate()
        for name, frame in frames:
            if gate.check(frame, self.mode, 10_000) is None:
                result.add((frame.can_id, name))
                gate = self.gate()
            else:
                self.forget(gate)
        return result

    def test_every_identifier_with_every_kind_of_payload(self) -> None:
        frames = ((name, Frame(can_id, payload)) for can_id in range(2048) for name, payload in PAYLOADS.items())
        assert self.passed(frames) == self.permitted

    def test_the_same_as_fd_frames(self) -> None:
        frames = (
            (name, Frame(can_id, payload, True, True)) for can_id in range(2048) for name, payload in PAYLOADS.items()
        )
        assert self.passed(frames) == self.permitted

    @pytest.mark.parametrize("fill", [0x00, 0x40, 0xFF])
    def test_every_identifier_with_every_length(self, fill: int) -> None:
        """0x40 fills are well-formed for SYNC alone (and an SDO read must have empty bytes behind)."""
        frames = (
            (str(length), Frame(can_id, bytes([fill]) * length, True, True))
            for can_id in range(2048)
            for length in LENGTHS
        )
        may_sync = (0x080, "one 0x05") in self.permitted
        assert self.passed(frames) == ({(0x080, "1")} if fill == 0x40 and may_sync else set())

    def test_permitted_payloads_with_another_length_or_format(self) -> None:
        gate = self.gate()
        for can_id, name in {*self.permitted, *ALWAYS, *DRIVE}:
            payload = PAYLOADS[name]
            spoilt = [Frame(can_id, payload + b"\x00", True, True), Frame(can_id, payload[:-1])]
            plain = Frame(can_id, payload)
            spoilt += [plain._replace(is_remote=True), plain._replace(is_extended=True), plain._replace(is_error=True)]
            spoilt += [plain._replace(bitrate_switch=True)]  # which only FD frames have
            for frame in spoilt:
                assert gate.check(frame, self.mode, 10_000) is not None, frame
                self.forget(gate)

    def test_no_voltage_behind_the_back_of_the_modes(self) -> None:
        gate = self.gate()
        for index in (0x6411, 0x6413, 0x6421, 0x6423, 0x2000, 0x1010, 0x1011, 0x1F51):
            for subindex in range(5):
                for size in (1, 2, 3, 4):
                    assert gate.check(sdo_write(index, subindex, 0, size), self.mode, 10_000) is not None
                    self.forget(gate)

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


class TestLatched(GateSweep):
    mode = Mode.TRACKING
    permitted = ALWAYS

    def gate(self) -> TransmitGate:
        gate = holding(HELD)
        gate.check(Frame(0x7FF, b""), Mode.TRACKING, 0)
        return gate

    def forget(self, gate: TransmitGate) -> None:
        assert gate.latched


class TestUnknownMode(GateSweep):
    mode = 7
    permitted = frozenset[tuple[int, str]]()


class TestNegativeMode(GateSweep):
    mode = -1
    permitted = frozenset[tuple[int, str]]()


def test_every_mode_is_swept() -> None:
    assert {sweep.mode for sweep in GateSweep.__subclasses__()} == {*map(int, Mode), 7, -1}


def test_sync_over_all_its_values() -> None:
    gate = holding((0, 0, 0))
    for value in range(256):
        passed = gate.check(sync(value), Mode.IDLE, 1000) is None
        assert passed == (1 <= value <= 240)
        gate.clear()


def test_nmt_over_all_commands_and_nodes() -> None:
    gate = holding((0, 0, 0))
    passed = set()
    for command in range(256):
        for node in range(256):
            if gate.check(nmt(command, node), Mode.BOOT, 1000) is None:
                passed.add((command, node))
            else:
                gate.clear()
    assert passed == {(command, 10) for command in (0x01, 0x02, 0x80, 0x81, 0x82)}

"""The gate's every reason, and every condition of it by itself: each is met, and alone decides."""

import dataclasses

import pytest
from gate_frames import CONFIG, drive, holding, nmt, sdo_write, sync

from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.safety import gate_rules, sdo_rules
from pkxyz_ctrl.safety.gate import TransmitGate, _words
from pkxyz_ctrl.safety.gate_rules import FrameKind, Reason
from pkxyz_ctrl.safety.modes import Mode

NO_MODE = 99
T_US = 200


def reason(frame: Frame, mode: int = Mode.TRACKING, gate: TransmitGate | None = None, t_us: int = T_US) -> str | None:
    return (gate or TransmitGate(CONFIG)).check(frame, mode, t_us)


def of(can_id: int, data: bytes) -> Frame:
    return Frame(can_id, data, True, True)


@pytest.mark.parametrize("mode", [NO_MODE, -1])
@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (drive(0, 0, 0, 0), "DRIVE_ZERO"),
        (drive(5, 0, 0, 0), "DRIVE"),
        (of(0x77F, b"\5"), "HEARTBEAT"),
        (sync(), "SYNC"),
        (nmt(0x80), "NMT_PRE_OPERATIONAL"),
        (of(0x60A, bytes(8)), "SDO"),
    ],
)
def test_in_a_mode_that_there_is_not_nothing_may_be_sent(frame: Frame, words: str, mode: int) -> None:
    told = reason(frame, mode)
    assert told is not None
    assert words in told


@pytest.mark.parametrize("data", [b"", b"\1", b"\xf0"])
def test_a_sync_with_or_without_counter(data: bytes) -> None:
    assert reason(of(0x080, data)) is None


@pytest.mark.parametrize("data", [b"\0", b"\xf1", b"\xff", b"\1\1", b"\0\1", bytes(8)])
def test_what_is_no_sync(data: bytes) -> None:
    assert "SYNC" in (reason(of(0x080, data)) or "")


@pytest.mark.parametrize("data", [b"", b"\4", b"\x7f", b"\0", b"\5\0", b"\x85"])
def test_what_is_no_heartbeat_of_ours(data: bytes) -> None:
    assert "must be the one byte 0x05" in (reason(of(0x77F, data)) or "")


@pytest.mark.parametrize("data", [b"\x80", b"\x80\x0a\0", b"", b"\x7f\x0a", b"\0\x0a", b"\3\x0a", b"\x83\x0a"])
def test_what_is_no_nmt_command(data: bytes) -> None:
    assert "not an NMT command" in (reason(of(0x000, data)) or "")


@pytest.mark.parametrize("node", [0, 9, 11, 255])
def test_nmt_to_somebody_else_or_all(node: int) -> None:
    assert f"to node {node}" in (reason(nmt(0x80, node)) or "")


@pytest.mark.parametrize("length", [0, 1, 7, 12])
def test_an_sdo_request_has_eight_bytes(length: int) -> None:
    assert f"{length} bytes instead of 8" in (reason(of(0x60A, bytes(length)), Mode.BOOT) or "")


def test_a_write_under_voltage_and_a_read() -> None:
    assert "SDO_WRITE" in (reason(sdo_write(0x1017, 0, 20, 2), Mode.TRACKING) or "")
    assert reason(sdo_write(0x1017, 0, 20, 2), Mode.BOOT) is None


@pytest.mark.parametrize("zero", [True, False])
def test_a_counter_that_is_repeated(zero: bool) -> None:
    gate = holding((5, 5, 5))
    told = reason(drive(0, 0, 0, 255) if zero else drive(6, 5, 5, 255), gate=gate)
    assert told is not None
    assert "counter" in told


@pytest.mark.parametrize("comb", [0, 1, 2])
@pytest.mark.parametrize(("count", "passes"), [(0, True), (2000, True), (-1, False), (2001, False)])
def test_each_comb_has_its_range(comb: int, count: int, passes: bool) -> None:
    """From combs that stand where the step is small enough."""
    config = CONFIG.__class__(count_max=2000, count_slew_max=32767, period_us=200)
    counts = [1000, 1000, 1000]
    counts[comb] = count
    assert (
        reason(drive(counts[0], counts[1], counts[2], 0), gate=holding((1000, 1000, 1000), config)) is None
    ) == passes


@pytest.mark.parametrize("comb", [0, 1, 2])
@pytest.mark.parametrize(("step", "passes"), [(1000, True), (-1000, True), (1001, False), (-1001, False)])
def test_each_comb_has_its_step(comb: int, step: int, passes: bool) -> None:
    counts = [5000, 5000, 5000]
    gate = holding((5000, 5000, 5000))
    counts[comb] += step
    assert (reason(drive(counts[0], counts[1], counts[2], 0), gate=gate) is None) == passes


@pytest.mark.parametrize(
    ("held", "passes"), [((0, 0, 0), False), ((5, 0, 0), True), ((0, 5, 0), True), ((0, 0, 5), True)]
)
def test_0_v_comes_at_once_unless_it_is_there_already(held: tuple[int, int, int], passes: bool) -> None:
    assert (reason(drive(0, 0, 0, 0), gate=holding(held), t_us=1) is None) == passes
    assert reason(drive(0, 0, 0, 0), gate=holding(held), t_us=T_US) is None


def test_plain_frames_have_no_counter_to_repeat() -> None:
    config = CONFIG.__class__(count_max=2000, count_slew_max=1000, period_us=200, protection=False)
    gate = TransmitGate(config)
    plain = of(0x30A, bytes(6))
    assert [reason(plain, gate=gate, t_us=t_us) for t_us in (0, 200)] == [None, None]
    assert "bytes" in (reason(drive(0, 0, 0, 0), gate=gate, t_us=400) or "")


@pytest.mark.parametrize("command", [0x01, 0x02, 0x80, 0x81, 0x82])
def test_every_nmt_command_has_its_time(command: int) -> None:
    assert reason(nmt(command), Mode.BOOT) is None
    assert (reason(nmt(command), Mode.TRACKING) is None) == (command in (0x02, 0x80))


@pytest.mark.parametrize(
    ("is_fd", "is_fast", "on_fd", "on_classic"),
    [(False, False, True, True), (True, False, True, False), (True, True, True, False), (False, True, False, False)],
)
def test_the_format_of_the_bus(is_fd: bool, is_fast: bool, on_fd: bool, on_classic: bool) -> None:
    frame = Frame(0x080, b"\1", is_fd, is_fast)
    assert (reason(frame) is None) == on_fd
    classic = CONFIG.__class__(count_max=2000, count_slew_max=1000, period_us=200, fd=False)
    assert (reason(frame, gate=TransmitGate(classic)) is None) == on_classic


def test_the_first_refusal_is_kept_until_it_is_cleared() -> None:
    gate = holding((5, 5, 5))
    first = reason(of(0x123, b""), gate=gate)
    assert first is not None
    reason(of(0x60A, b""), gate=gate)
    assert gate.latched == first
    assert (reason(of(0x080, b"\0"), gate=gate) or "").endswith("SYNC must be empty, or one byte, 1..240")  # of itself
    told = reason(drive(6, 5, 5, 0), gate=gate)
    assert told is not None
    assert told.endswith(f"blocked in TRACKING: the gate is latched since this {first}")
    gate_rules.clear(gate.memory)  # as the compiled loop does it
    gate.clear()
    assert not gate.latched
    assert reason(drive(6, 5, 5, 0), gate=gate) is None


WORD = int.from_bytes(bytes.fromhex("fe ff 03 00 ff 7f 07 ab"), "little", signed=True)  # -2, 3, 32767, counter 7


@pytest.mark.parametrize(
    ("what", "words"),
    [
        (Reason.NOT_NOW + FrameKind.SYNC, "SYNC is not permitted now"),
        (Reason.LATCHED, "the gate is latched"),
        (Reason.NMT_NODE, "NMT command to node 255; only node 10 is ours, never all"),
        (Reason.DRIVE_LENGTH, "drive PDO has 5 bytes instead of 8"),
        (Reason.DRIVE_REPEATED, "drive PDO repeats alive counter 7: the node would ignore it"),
        (Reason.DRIVE_TOO_SOON, "drive PDO 40 us after the one before, at least 100 us apart"),
        (Reason.DRIVE_RANGE, f"drive counts -2, 3, 32767 are not all in 0..{CONFIG.count_max}"),
        (Reason.DRIVE_STEP, f"drive counts -2, 3, 32767 after 4, 5, 6: a step beyond {CONFIG.count_slew_max}"),
        (Reason.DRIVE_COUNTER, "drive PDO has alive counter 7 instead of 9"),
        (Reason.DRIVE_CRC, "drive PDO has a wrong CRC, 0xAB"),
        (Reason.SDO_LENGTH, "SDO request has 5 bytes instead of 8"),
        (Reason.OUTPUT_LENGTH, "the digital outputs' PDO has 5 bytes instead of 1"),
        (Reason.OUTPUT_BITS, "digital outputs 0xFE beyond 0x1F"),
    ],
)
def test_words_of_a_reason(what: int, words: str) -> None:
    gate = TransmitGate(CONFIG)
    memory = gate.memory
    memory["count"], memory["time_us"], memory["counter_next"] = (4, 5, 6), 160, 9
    assert _words(what, gate.record[0], memory[0], 5, WORD, 200) == words


def test_words_of_a_refused_write_name_the_object_and_what_is_permitted() -> None:
    told = reason(sdo_write(0x6444, 1, 5, 4), Mode.PRE_OPERATIONAL) or ""
    assert "0x6444:01" in told
    assert told.startswith("frame 0x60A [23 44 64 01 05 00 00 00] blocked in PRE_OPERATIONAL: SDO write")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (
            "21 17 10 00 14 00 00 00",
            "SDO command 0x21 is neither a read nor an expedited write with its size",
        ),
        ("2b 17 10 00 14 00 01 00", "SDO write of 0x1017:00: the bytes behind its 2 are not empty"),
        ("2b 11 64 01 14 00 00 00", "SDO write of 0x6411:01: not in the list of objects that may be written"),
        ("23 17 10 00 14 00 00 00", "SDO write of 0x1017:00 (the node's heartbeat): 4 bytes instead of 2"),
        (
            "23 44 64 03 78 56 34 f2",
            "SDO write of 0x6444:03 (error value of a comb): 0xF2345678 is not permitted; permitted: 0, that is 0 V",
        ),
    ],
)
def test_words_of_each_refusal_of_a_write(data: str, words: str) -> None:
    assert (reason(of(0x60A, bytes.fromhex(data)), Mode.BOOT) or "").endswith(f"blocked in BOOT: {words}")


OFF = 0x8000_0000
LISTED = [
    (0x1005, 0x1005, 0, 0, 4, 0x80), (0x1016, 0x1016, 1, 1, 4, 0x7F0001), (0x1017, 0x1017, 0, 0, 2, 20),
    (0x1019, 0x1019, 0, 0, 1, 240), (0x1029, 0x1029, 1, 1, 1, 2), (0x1400, 0x15FF, 1, 1, 4, OFF),
    (0x1600, 0x17FF, 0, 0, 1, 5), (0x1600, 0x17FF, 1, 64, 4, 0), (0x1800, 0x19FF, 1, 1, 4, OFF),
    (0x1800, 0x19FF, 2, 2, 1, 255), (0x1800, 0x19FF, 3, 3, 2, 1000), (0x1800, 0x19FF, 5, 5, 2, 1000),
    (0x1A00, 0x1BFF, 0, 0, 1, 5), (0x1A00, 0x1BFF, 1, 64, 4, 0x64010110), (0x2010, 0x2010, 0, 0, 1, 5),
    (0x2011, 0x2011, 0, 0, 2, 900), (0x2012, 0x2012, 0, 0, 2, 1000), (0x6443, 0x6443, 1, 3, 1, 1),
    (0x6444, 0x6444, 1, 3, 4, 0),
]  # fmt: skip
"""First and last object and sub-index, size, and a value that each of them may hold."""
ELSEWHERE = {(0x1A00, 1, OFF), (0x2011, 0, 1000), (0x2012, 0, 900)}
"""Neighbours that are listed themselves, with what else they may hold."""


@pytest.mark.parametrize(("first", "last", "sub_first", "sub_last", "size", "value"), LISTED)
def test_what_may_be_written_begins_and_ends_with_its_objects(
    first: int, last: int, sub_first: int, sub_last: int, size: int, value: int
) -> None:
    """CiA 301's: 512 PDOs each way, of 64 entries at most; everything else by itself."""
    gate = TransmitGate(dataclasses.replace(CONFIG, count_slew_max=900))

    def told(index: int, subindex: int) -> str | None:
        gate.clear()
        return reason(sdo_write(index, subindex, value, size), Mode.BOOT, gate)

    subs = (sub_first, sub_last)
    assert [told(index, sub) for index in (first, last) for sub in subs] == [None] * 4
    beside = [(index, sub) for index in (first - 1, last + 1) for sub in subs]
    beside += [(index, sub) for index in (first, last) for sub in (sub_first - 1, sub_last + 1) if sub >= 0]
    assert all("SDO write" in (told(*key) or "") for key in beside if (*key, value) not in ELSEWHERE)


def test_the_largest_step_and_the_time_out_have_a_limit_each() -> None:
    gate = TransmitGate(dataclasses.replace(CONFIG, count_slew_max=900))
    assert reason(sdo_write(0x2012, 0, 1000, 2), Mode.BOOT, gate) is None
    assert "is not permitted" in (reason(sdo_write(0x2011, 0, 901, 2), Mode.BOOT, gate) or "")


@pytest.mark.parametrize("count", [-32768, -32767])
@pytest.mark.parametrize("comb", range(3))
def test_the_lowest_counts_are_no_small_ones(comb: int, count: int) -> None:
    counts = [0, 0, 0]
    counts[comb] = count
    assert "not all in 0.." in (reason(drive(*counts, 0), gate=holding((0, 0, 0))) or "")


def test_our_heartbeat_passes_and_a_read_where_reads_do() -> None:
    assert reason(of(0x77F, b"\5")) is None
    read = of(0x60A, bytes.fromhex("40 00 10 00 00 00 00 00"))
    assert reason(read, Mode.PRE_OPERATIONAL) is None
    assert "SDO_READ is not permitted now" in (reason(read, NO_MODE) or "")


def test_reasons_are_counted_through() -> None:
    """The exported gate answers with these numbers."""
    assert [int(kind) for kind in Reason] == [*range(23), 1 << 16]


def test_nobody_changes_the_limits_of_a_gate() -> None:
    gate = TransmitGate(CONFIG)
    with pytest.raises(ValueError, match="read-only"):
        gate.record["count_max"] = 32767
    with pytest.raises(ValueError, match="read-only"):
        gate_rules._ROWS[0] = 0
    with pytest.raises(ValueError, match="read-only"):
        sdo_rules._RULES["low"][0] = 0
    assert gate.config is CONFIG


def test_only_a_reason_of_a_mode_names_a_kind_of_frame() -> None:
    assert min(Reason.NOT_NOW + kind for kind in FrameKind) > max(kind for kind in Reason if kind != Reason.NOT_NOW)


def test_a_payload_of_full_negative_bytes_is_looked_at_like_any_other() -> None:
    assert "has a wrong CRC, 0xFF" in (reason(of(0x30A, bytes(7) + b"\xff")) or "")


def test_words_of_a_latched_gate_by_one_that_did_not_see_what_latched_it() -> None:
    """As beside a loop in another process, whose earlier words are not here."""
    told = TransmitGate(CONFIG).blocked(
        drive(5, 0, 0, 1), Mode.TRACKING, Reason.LATCHED, holding((0, 0, 0)).memory[0], T_US
    )
    assert told.endswith("blocked in TRACKING: the gate is latched")

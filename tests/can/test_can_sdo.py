"""The SDO dialogue and the emergency texts, as literal bytes."""

import pytest
from canopen.sdo.exceptions import SdoAbortedError

from pkxyz_ctrl.can.emergency import code_remedy, code_text, decode_emergency
from pkxyz_ctrl.can.sdo import ABORT_TEXT, ReplyKind, SdoDialogue, SdoStep, abort_text, parse_reply, request


def write(value: int, size: int = 2) -> SdoStep:
    return SdoStep(0x1017, 0, size, value, True, "heartbeat period", "REMEDY")


def read(value: int | None, size: int = 4) -> SdoStep:
    return SdoStep(0x1018, 2, size, value, False, "product code", "REMEDY")


def hexes(payloads: tuple[bytes, ...]) -> list[str]:
    return [payload.hex(" ") for payload in payloads]


READ_REQUEST = "40 18 10 02 00 00 00 00"
READ_GOOD = bytes.fromhex("43 18 10 02 03 00 00 00")


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        (read(3), READ_REQUEST),
        (write(0xAB, 1), "2f 17 10 00 ab 00 00 00"),
        (write(0x1234, 2), "2b 17 10 00 34 12 00 00"),
        (write(0xC000028A, 4), "23 17 10 00 8a 02 00 c0"),
    ],
)
def test_requests(step, expected):
    assert request(step).hex(" ") == expected


@pytest.mark.parametrize(
    ("data", "kind", "value", "size"),
    [
        ("4f 18 10 02 05 ff ff ff", ReplyKind.READ, 5, 1),
        ("4b 18 10 02 05 01 ff ff", ReplyKind.READ, 0x105, 2),
        ("47 18 10 02 05 01 02 ff", ReplyKind.READ, 0x020105, 3),
        ("43 18 10 02 05 01 02 ff", ReplyKind.READ, 0xFF020105, 4),
        ("42 18 10 02 05 00 00 00", ReplyKind.READ, 5, 0),
        ("60 18 10 02 00 00 00 00", ReplyKind.WRITTEN, 0, 0),
        ("80 18 10 02 00 00 02 06", ReplyKind.ABORT, 0x06020000, 4),
        ("41 18 10 02 09 00 00 00", ReplyKind.OTHER, 9, 0),
    ],
)
def test_replies(data, kind, value, size):
    assert parse_reply(bytes.fromhex(data)) == (kind, 0x1018, 2, value, size)


@pytest.mark.parametrize("length", [0, 1, 7, 12])
def test_a_reply_has_eight_bytes(length):
    assert parse_reply(bytes(length)) is None


def test_dialogue_goes_step_by_step():
    dialogue = SdoDialogue((read(3), write(20)), timeout_us=1000, retries=1)
    assert hexes(dialogue.begin(0)) == [READ_REQUEST]
    assert hexes(dialogue.receive(READ_GOOD, 10)) == ["2b 17 10 00 14 00 00 00"]
    assert not dialogue.done
    assert dialogue.receive(bytes.fromhex("60 17 10 00 00 00 00 00"), 20) == ()
    assert dialogue.done
    assert dialogue.failure == ""
    assert dialogue.values == {(0x1018, 2): 3}
    assert dialogue.poll(10**9) == ()


@pytest.mark.parametrize(
    "stray",
    [
        "43 18 10 01 03 00 00 00",  # another sub-index
        "43 00 10 02 03 00 00 00",  # another object
        "60 18 10 02 00 00 00 00",  # a late confirmation of a write
        "80 00 00 00 00 00 04 05",  # an abort that names another object
        "80 18 10 02 00 00 04 05",  # the server gave up a transfer: we repeat it by our own time-out
        "43 18 10 02",
    ],
)
def test_answers_to_something_else_are_ignored(stray):
    dialogue = SdoDialogue((read(3),), timeout_us=1000, retries=1)
    dialogue.begin(0)
    assert dialogue.receive(bytes.fromhex(stray), 10) == ()
    assert (dialogue.done, dialogue.failure) == (False, "")
    dialogue.receive(READ_GOOD, 20)
    assert dialogue.done


def test_an_answer_without_a_size_is_taken_as_long_as_asked():
    dialogue = SdoDialogue((read(3, 2),), timeout_us=1000, retries=0)
    dialogue.begin(0)
    dialogue.receive(bytes.fromhex("42 18 10 02 03 00 99 99"), 1)
    assert dialogue.done


def test_a_segmented_answer_does_not_end_a_write():
    dialogue = SdoDialogue((write(20),), timeout_us=1000, retries=0)
    dialogue.begin(0)
    dialogue.receive(bytes.fromhex("41 17 10 00 20 00 00 00"), 1)
    assert (dialogue.done, dialogue.failure) == (False, "")


def test_silence_is_repeated_then_reported():
    dialogue = SdoDialogue((read(3),), timeout_us=1000, retries=2)
    dialogue.begin(0)
    gave_up = "80 18 10 02 00 00 04 05"
    assert hexes(dialogue.poll(999)) == []
    assert hexes(dialogue.poll(1000)) == [gave_up, READ_REQUEST]
    assert hexes(dialogue.poll(1999)) == []
    assert hexes(dialogue.poll(2000)) == [gave_up, READ_REQUEST]
    assert hexes(dialogue.poll(3000)) == [gave_up]
    assert dialogue.failure == (
        "no answer to 0x1018:02 (product code) within 1 ms, asked 3 times; "
        "check node id, bit rates, wiring and termination"
    )
    assert dialogue.poll(10**9) == ()
    assert dialogue.receive(READ_GOOD, 10**9) == ()


@pytest.mark.parametrize(
    ("step", "data", "failure"),
    [
        (
            read(3),
            "43 18 10 02 04 00 00 00",
            "0x1018:02 (product code) is 0x00000004, expected 0x00000003; REMEDY",
        ),
        (read(3), "4b 18 10 02 03 00 00 00", "0x1018:02 (product code) has 2 bytes instead of 4; REMEDY"),
        (
            read(3),
            "41 18 10 02 20 00 00 00",
            "0x1018:02 (product code) is longer than four bytes or not a number; REMEDY",
        ),
        (
            write(20),
            "80 17 10 00 02 00 01 06",
            "writing 0x1017:00 (heartbeat period) was refused: 0x06010002, attempt to write a read only object; REMEDY",
        ),
    ],
)
def test_failures_say_what_came_and_what_to_do(step, data, failure):
    dialogue = SdoDialogue((step,), timeout_us=1000, retries=0)
    dialogue.begin(0)
    assert dialogue.receive(bytes.fromhex(data), 1) == ()
    assert dialogue.failure == failure
    assert not dialogue.done


def test_abort_codes_are_those_that_canopen_knows():
    missing = set(SdoAbortedError.CODES) - set(ABORT_TEXT)
    assert missing == set()
    assert abort_text(0x12345678) == "0x12345678, a code that CiA 301 does not know"


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x0000, "error reset or no error"),
        (0x1000, "generic error"),
        (0x2310, "current, output side"),
        (0x2F00, "current"),
        (0x4210, "device temperature"),
        (0x8130, "heartbeat of the controller missed"),
        (0x81FF, "monitoring, communication"),
        (0x8F00, "monitoring"),
        (0xFF10, "drive PDO with a wrong CRC"),
        (0xFF99, "device specific"),
        (0xA000, "unknown error code"),
        (0x0100, "unknown error code"),
    ],
)
def test_emergency_codes_as_text(code, text):
    assert code_text(code) == text


def test_every_emergency_code_has_a_text():
    assert all(code_text(code) for code in range(0x10000))


@pytest.mark.parametrize(
    ("code", "word"),
    [
        (0x2310, "short or dust"), (0x2000, "short or dust"), (0x3210, "supply"), (0x4210, "cool"), (0x5000, "repair"),
        (0x6100, "repair"), (0x8130, "heartbeat"), (0x8250, "in time"), (0x8120, "termination"), (0x8240, "who else"),
        (0xFF10, "who else"), (0xFF14, "who else"), (0xFF20, "manual"), (0x1000, "manual"),
    ],
)  # fmt: skip
def test_what_to_do_follows_the_code(code, word):
    assert word in code_remedy(code)
    assert ("over-current" in code_remedy(code)) == (code >> 12 == 2)


def test_an_emergency_is_told_by_the_time_since_it_came():
    emergency = decode_emergency(bytes.fromhex("30 81 11 00 00 00 00 00"), 7_000_000)
    assert emergency.told_at(7_001_550) == (
        "EMCY 0x8130: heartbeat of the controller missed (error register 0x11), 1.6 ms before; it missed our "
        "heartbeat, so the computer or the bus stood still: see what held them up"
    )
    over = decode_emergency(bytes(8), 10)
    assert over.told_at(10) == "EMCY 0x0000: error reset or no error (error register 0x00), 0.0 ms before"
    assert over.told_at(0).endswith("0.0 ms before")  # it came in the tick that tells


def test_emergency_frame():
    emergency = decode_emergency(bytes.fromhex("10 23 03 01 00 00 00 00"), 42)
    assert emergency == (42, 0x2310, 0x03, b"\x01\0\0\0\0")
    assert emergency.text == "EMCY 0x2310: current, output side (error register 0x03, data 01 00 00 00 00)"
    assert not emergency.is_reset
    assert [decode_emergency(bytes.fromhex(code + 12 * "0"), 0).is_reset for code in ("0000", "ff00", "0001")] == [
        True,
        True,
        False,
    ]
    assert decode_emergency(bytes(7), 0) is None

"""The SDO dialogue and the emergency texts, as literal bytes."""

import pytest
from canopen.sdo.exceptions import SdoAbortedError

from pkxyz_ctrl.can import start_plan
from pkxyz_ctrl.can.driver import AmplifierDriver
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import IDENTIFYING, DriverState
from pkxyz_ctrl.can.emergency import code_remedy, code_text, decode_emergency
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.can.sdo import ABORT_TEXT, ReplyKind, SdoStep, abort_text, kind_of, request, size_of, value_of
from pkxyz_ctrl.can.startup import Setting


def write(value: int | None, size: int = 2) -> SdoStep:
    return SdoStep(0x1017, 0, size, value, True, "heartbeat period", "REMEDY")


def read(value: int | None, size: int = 4) -> SdoStep:
    return SdoStep(0x1018, 2, size, value, False, "product code", "REMEDY")


READ_REQUEST = "40 18 10 02 00 00 00 00"
READ_GOOD = "43 18 10 02 03 00 00 00"


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


def test_nothing_is_no_value_to_write():
    with pytest.raises(ValueError, match="nothing to write"):
        request(write(None))


@pytest.mark.parametrize(
    ("data", "kind", "value"),
    [
        ("4f 18 10 02 05 ff ff ff", ReplyKind.READ, 5),
        ("4b 18 10 02 05 01 ff ff", ReplyKind.READ, 0x105),
        ("47 18 10 02 05 01 02 ff", ReplyKind.READ, 0x020105),
        ("43 18 10 02 05 01 02 ff", ReplyKind.READ, 0xFF020105),
        ("42 18 10 02 05 00 00 00", ReplyKind.READ, 5),
        ("60 18 10 02 00 00 00 00", ReplyKind.WRITTEN, 0),
        ("80 18 10 02 00 00 02 06", ReplyKind.ABORT, 0x06020000),
        ("41 18 10 02 09 00 00 00", ReplyKind.OTHER, 9),
    ],
)
def test_replies(data, kind, value):
    word = int.from_bytes(bytes.fromhex(data), "little", signed=True)
    assert (kind_of(word), value_of(word)) == (kind, value)


@pytest.mark.parametrize(("command", "size"), [(0x4F, 1), (0x4B, 2), (0x47, 3), (0x43, 4), (0x42, 0)])
def test_a_reply_says_how_many_bytes_were_read(command, size):
    assert size_of(command) == size


PRODUCT = Setting(0x1018, 2, 4, 3, "product code", "REMEDY", start_plan.IDENTITY)
SHORT_PRODUCT = Setting(0x1018, 2, 2, 3, "product code", "REMEDY", start_plan.IDENTITY)
PERIOD = Setting(0x1017, 0, 2, 20, "heartbeat period", "REMEDY")
BOOT_UP = Frame(0x70A, b"\0")


class Dialogue:
    """A driver that has asked for the product code, of a table with the heartbeat period besides."""

    def __init__(self, product: Setting = PRODUCT, retries: int = 0) -> None:
        self.driver = AmplifierDriver(DriverConfig(sdo_timeout_us=1000, retries=retries), settings=(product, PERIOD))
        self.driver.start(0)
        self.asked = self.requests(self.driver.receive(BOOT_UP, 0))

    def requests(self, frames: tuple[Frame, ...]) -> list[str]:
        return [frame.data.hex(" ") for frame in frames if frame.can_id == 0x60A]

    def receive(self, data: str, t_us: int) -> list[str]:
        return self.requests(self.driver.receive(Frame(0x58A, bytes.fromhex(data)), t_us))

    def poll(self, t_us: int) -> list[str]:
        return self.requests(self.driver.poll(t_us))

    def write(self) -> None:
        """On to the step that writes the heartbeat period: the node has another one."""
        self.receive(READ_GOOD, 1)
        assert self.receive("4b 17 10 00 15 00 00 00", 1) == ["2b 17 10 00 14 00 00 00"]

    @property
    def is_open(self) -> bool:
        """Whether it still waits for the product code."""
        return int(self.driver.memory["state"][0]) == IDENTIFYING


def test_dialogue_goes_step_by_step():
    dialogue = Dialogue()
    assert dialogue.asked == [READ_REQUEST]
    assert dialogue.receive(READ_GOOD, 10) == ["40 17 10 00 00 00 00 00"]  # what does it hold?
    assert dialogue.receive("4b 17 10 00 15 00 00 00", 20) == ["2b 17 10 00 14 00 00 00"]
    assert dialogue.receive("60 17 10 00 00 00 00 00", 30) == ["40 17 10 00 00 00 00 00"]  # does it hold it?
    assert dialogue.receive("4b 17 10 00 14 00 00 00", 40) == []
    assert (dialogue.driver.state, dialogue.driver.failure) == (DriverState.STARTING, "")


def test_what_stands_is_not_written_but_read_once_more():
    dialogue = Dialogue()
    dialogue.receive(READ_GOOD, 10)
    assert dialogue.receive("4b 17 10 00 14 00 00 00", 20) == ["40 17 10 00 00 00 00 00"]
    dialogue.receive("4b 17 10 00 15 00 00 00", 30)
    assert dialogue.driver.failure.startswith(
        "amplifier (node 10): 0x1017:00 (read-back of heartbeat period) is 0x0015, expected 0x0014; the amplifier did"
    )


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
    dialogue = Dialogue()
    assert dialogue.receive(stray, 10) == []
    assert (dialogue.is_open, dialogue.driver.failure) == (True, "")
    dialogue.receive(READ_GOOD, 20)
    assert not dialogue.is_open


def test_an_answer_without_a_size_is_taken_as_long_as_asked():
    dialogue = Dialogue(SHORT_PRODUCT)
    dialogue.receive("42 18 10 02 03 00 99 99", 1)
    assert (dialogue.driver.state, dialogue.driver.failure) == (DriverState.CONFIGURING, "")


def test_a_segmented_answer_does_not_end_a_write():
    dialogue = Dialogue()
    dialogue.write()
    assert dialogue.receive("41 17 10 00 20 00 00 00", 1) == []
    assert (dialogue.driver.state, dialogue.driver.failure) == (DriverState.CONFIGURING, "")
    assert dialogue.receive("60 17 10 00 00 00 00 00", 1) == ["40 17 10 00 00 00 00 00"]


def test_silence_is_repeated_then_reported():
    dialogue = Dialogue(retries=2)
    gave_up = "80 18 10 02 00 00 04 05"
    assert dialogue.poll(999) == []
    assert dialogue.poll(1000) == [gave_up, READ_REQUEST]
    assert dialogue.poll(1999) == []
    assert dialogue.poll(2000) == [gave_up, READ_REQUEST]
    assert dialogue.poll(3000) == [gave_up]
    assert dialogue.driver.failure == (
        "amplifier (node 10): no answer to 0x1018:02 (product code) within 1 ms, asked 3 times; "
        "check node id, bit rates, wiring and termination"
    )
    assert dialogue.poll(10**9) == []
    assert dialogue.receive(READ_GOOD, 10**9) == []


@pytest.mark.parametrize(
    ("data", "failure"),
    [
        ("43 18 10 02 04 00 00 00", "0x1018:02 (product code) is 0x00000004, expected 0x00000003; REMEDY"),
        ("4b 18 10 02 03 00 00 00", "0x1018:02 (product code) has 2 bytes instead of 4; REMEDY"),
        ("4f 18 10 02 03 00 00 00", "0x1018:02 (product code) has 1 bytes instead of 4; REMEDY"),
        ("41 18 10 02 20 00 00 00", "0x1018:02 (product code) is longer than four bytes or not a number; REMEDY"),
    ],
)
def test_failures_say_what_came_and_what_to_do(data, failure):
    dialogue = Dialogue()
    assert dialogue.receive(data, 1) == []
    assert dialogue.driver.failure == f"amplifier (node 10): {failure}"
    assert dialogue.driver.state is DriverState.FAILED


def test_a_refused_write_says_why():
    dialogue = Dialogue()
    dialogue.write()
    assert dialogue.receive("80 17 10 00 02 00 01 06", 2) == []
    assert dialogue.driver.failure == (
        "amplifier (node 10): writing 0x1017:00 (heartbeat period) was refused: 0x06010002, attempt to write a read "
        "only object; REMEDY"
    )


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

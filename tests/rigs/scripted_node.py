"""An amplifier of literal bytes: what the driver sends, as text, and what a node that does as it is told answers."""

from pkxyz_ctrl.can.driver import AmplifierDriver
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.frame import Frame

BOOT_UP, OPERATIONAL, PRE_OPERATIONAL, STOPPED = "00", "05", "7f", "04"
RESET, START = "000 81 0a", "000 01 0a"
PRE_OP = "000 80 0a"
OUR_HEARTBEAT = "77f 05"

# What is written, in order, to node 10 with protected PDOs of which nothing is known, and what must be read back.
WRITES = """
23 01 14 01 0a 03 00 80
2f 01 14 02 01 00 00 00
2f 01 16 00 00 00 00 00
23 01 16 01 10 01 11 64
23 01 16 02 10 02 11 64
23 01 16 03 10 03 11 64
23 01 16 04 08 01 00 20
23 01 16 05 08 02 00 20
2f 01 16 00 05 00 00 00
23 01 18 01 8a 02 00 c0
2f 01 18 02 01 00 00 00
2f 01 1a 00 00 00 00 00
23 01 1a 01 10 01 01 64
23 01 1a 02 10 02 01 64
23 01 1a 03 10 03 01 64
23 01 1a 04 08 01 01 20
23 01 1a 05 08 02 01 20
2f 01 1a 00 05 00 00 00
23 05 10 00 80 00 00 00
2f 43 64 01 01 00 00 00
23 44 64 01 00 00 00 00
2f 43 64 02 01 00 00 00
23 44 64 02 00 00 00 00
2f 43 64 03 01 00 00 00
23 44 64 03 00 00 00 00
2f 29 10 01 00 00 00 00
2f 10 20 00 05 00 00 00
2b 11 20 00 ff 7f 00 00
2b 12 20 00 14 00 00 00
23 16 10 01 32 00 7f 00
2b 17 10 00 14 00 00 00
2f 19 10 00 f0 00 00 00
23 01 14 01 0a 03 00 00
23 01 18 01 8a 02 00 40
""".strip().splitlines()


def frame(text: str, fd: bool = True) -> Frame:
    """``"58a 60 17 ..."`` as a frame."""
    can_id, _, data = text.partition(" ")
    return Frame(int(can_id, 16), bytes.fromhex(data), fd, fd)


def text(sent: tuple[Frame, ...]) -> list[str]:
    return [f"{each.can_id:03x} {each.data.hex(' ')}" for each in sent]


def heartbeat(state: str) -> Frame:
    return frame(f"70a {state}")


class ObedientServer:
    """Answers SDO requests from a table of bytes; ``answers`` overrides single ones. What has not been written holds
    nothing that can be read.
    """

    def __init__(self, answers: dict[str, str] | None = None) -> None:
        self.store = {
            "00 10 00": "91 01 0c 00",
            "18 10 01": "7a 79 78 70",
            "18 10 02": "03 00 00 00",
            "18 10 03": "00 00 01 00",
            "18 10 04": "01 00 00 00",
        }
        self.commands: dict[str, str] = {}  # how an object was written: it is read with the same length
        self.answers = answers or {}
        self.requests: list[str] = []

    def answer(self, sent: Frame) -> Frame:
        assert sent.can_id == 0x60A
        asked = sent.data.hex(" ")
        self.requests.append(asked)
        if asked in self.answers:
            return frame(f"58a {self.answers[asked]}")
        command, where, value = asked[:2], asked[3:11], asked[12:]
        if command == "40" and where not in self.store:
            return frame(f"58a 80 {where} 23 00 0a 06")
        if command == "40":
            size = {"23": "43", "2b": "4b", "2f": "4f"}[self.commands.get(where, "23")]
            return frame(f"58a {size} {where} {self.store[where]}")
        self.store[where] = value
        self.commands[where] = command
        return frame(f"58a 60 {where} 00 00 00 00")


def run_dialogue(driver: AmplifierDriver, server: ObedientServer, sent: tuple[Frame, ...], t_us: int = 0) -> list[str]:
    """Passes SDO frames to and fro until the driver sends something else; returns that. The pre-operational of before
    the dialogue is nothing that a node in that state answers.
    """
    while sent and sent[-1].can_id == 0x60A:
        *_, only = sent
        sent = driver.receive(server.answer(only), t_us)
    return text(sent)


def started(**settings_of: object) -> AmplifierDriver:
    """An operational driver whose node gave its first heartbeat at t = 0."""
    driver = AmplifierDriver(DriverConfig(**settings_of))
    assert text(driver.start(0)) == [RESET]
    assert run_dialogue(driver, ObedientServer(), driver.receive(heartbeat(BOOT_UP), 0)) == [OUR_HEARTBEAT, START]
    try_out(driver, 0)
    assert driver.state is DriverState.OPERATIONAL
    return driver


def try_out(driver: AmplifierDriver, t_us: int) -> None:
    """The node's part of the trial: it is operational, misses our heartbeat, and is started again."""
    assert driver.receive(heartbeat(OPERATIONAL), t_us) == ()
    assert driver.state is DriverState.TRYING
    assert driver.receive(heartbeat(PRE_OPERATIONAL), t_us) == ()  # once is not enough
    assert text(driver.receive(heartbeat(PRE_OPERATIONAL), t_us)) == [OUR_HEARTBEAT, START]
    assert driver.receive(heartbeat(OPERATIONAL), t_us) == ()

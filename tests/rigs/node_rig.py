"""The amplifier node between a lockstep clock and a plant that writes down what is done to it. No wire: frames reach
the node at the microsecond at which a test hands them over."""

from pathlib import Path

import canopen
from crccheck.crc import Crc8Base

from hil.bus.clock import Lockstep
from hil.node.amplifier import AmplifierNode, NmtState
from pkxyz_ctrl.can.frame import Frame

EDS = Path(__file__).parents[2] / "configs" / "comb_amplifier.eds"
NODE_ID = 10
NMT, SYNC, EMCY, SENSE, DRIVE, REPLY, REQUEST, HEARTBEAT = 0x000, 0x080, 0x08A, 0x28A, 0x30A, 0x58A, 0x60A, 0x70A
CONTROLLER = 0x77F
TURNAROUND_US = 7
START, STOP, PRE_OPERATIONAL = 1, 2, 128  # NMT commands
COMMAND_OF = {NmtState.STOPPED: STOP, NmtState.OPERATIONAL: START, NmtState.PRE_OPERATIONAL: PRE_OPERATIONAL}


class Crc8H2F(Crc8Base):  # type: ignore[misc]
    """AUTOSAR's, by a library that neither side uses."""

    _poly, _initvalue, _xor_output = 0x2F, 0xFF, 0xFF
    _reflect_input = _reflect_output = False


def protected(cob_id: int, counts: tuple[int, int, int], counter: int) -> bytes:
    payload = b"".join(count.to_bytes(2, "little", signed=True) for count in counts) + bytes((counter,))
    return payload + bytes((Crc8H2F.calc(cob_id.to_bytes(2, "little") + payload),))


class RecordingPlant:
    """Remembers each (t_us, counts) that it was driven with; its samples are a function of time."""

    def __init__(self) -> None:
        self.t_us = 0
        self.driven: list[tuple[int, tuple[int, int, int]]] = []
        self.sampled_us: list[int] = []
        self.sensed = (0, 0, 0)

    def exchange(self, t_us: int, counts: tuple[int, int, int] | None, *, sample: bool) -> tuple[int, int, int]:
        assert t_us >= self.t_us, "time runs one way"
        self.t_us = t_us
        if counts is not None:
            self.drive(counts)
        if sample:
            self.sensed = self.sample()
        return self.sensed

    def drive(self, counts: tuple[int, int, int]) -> None:
        self.driven.append((self.t_us, counts))

    def sample(self) -> tuple[int, int, int]:
        self.sampled_us.append(self.t_us)
        return sample_at(self.t_us)


def sample_at(t_us: int) -> tuple[int, int, int]:
    """Three counts, positive and negative, that differ from one microsecond to the next."""
    return t_us % 32768, -(t_us % 32769), (7 * t_us) % 65536 - 32768


class Rig:
    def __init__(self, *, protection: bool = True, fd: bool = False, booted: bool = True) -> None:
        self.clock = Lockstep()
        self.plant = RecordingPlant()
        self.sent: list[tuple[int, Frame]] = []
        self.node = AmplifierNode(
            NODE_ID,
            self.clock,
            lambda frame: self.sent.append((self.clock.now_us, frame)),
            self.plant,
            EDS,
            turnaround_us=TURNAROUND_US,
            fd=fd,
            protection=protection,
        )
        self._counter = 0
        self._sync = 0
        self.node.power_on()
        if booted:
            self.run(10_000)
            self.forget()

    @property
    def now_us(self) -> int:
        return self.clock.now_us

    def run(self, us: int) -> None:
        self.clock.run_until(self.clock.now_us + us)

    def forget(self) -> None:
        self.sent.clear()
        self.plant.driven.clear()
        self.plant.sampled_us.clear()

    def give(self, cob_id: int, data: bytes = b"") -> None:
        self.node.on_frame(Frame(cob_id, data), self.clock.now_us)

    def ask(self, request: bytes) -> bytes:
        """The node's reply to one SDO request, which it gives at once."""
        before = len(self.sent)
        self.give(REQUEST, request)
        replies = [frame.data for _, frame in self.sent[before:] if frame.can_id == REPLY]
        assert len(replies) == 1
        return replies[0]

    def write(self, index: int, subindex: int, value: int, length: int) -> int:
        """Expedited download; the abort code, 0 if it was accepted."""
        head = bytes((0x23 | (4 - length) << 2, index & 0xFF, index >> 8, subindex))
        reply = self.ask(head + (value % (1 << 8 * length)).to_bytes(4, "little"))
        assert reply[1:4] == head[1:]
        assert reply[0] in (0x60, 0x80)
        return int.from_bytes(reply[4:], "little") if reply[0] == 0x80 else 0

    def read(self, index: int, subindex: int) -> int:
        """Expedited upload of an unsigned value."""
        reply = self.ask(bytes((0x40, index & 0xFF, index >> 8, subindex, 0, 0, 0, 0)))
        assert reply[0] & 0xE3 == 0x43
        return int.from_bytes(reply[4 : 8 - (reply[0] >> 2 & 3)], "little")

    def nmt(self, command: int, node_id: int = NODE_ID) -> None:
        self.give(NMT, bytes((command, node_id)))

    def start(self) -> None:
        self.nmt(1)

    def sync(self) -> None:
        self._sync = self._sync % 240 + 1
        self.give(SYNC, bytes((self._sync,)))

    def drive(self, counts: tuple[int, int, int]) -> None:
        self.give(DRIVE, protected(DRIVE, counts, self._counter))
        self._counter = (self._counter + 1) % 256

    def cycle(self, counts: tuple[int, int, int] | None = None, period_us: int = 200) -> None:
        """SYNC now, the drive PDO in the middle, and on to the next SYNC."""
        self.sync()
        self.run(period_us // 2)
        if counts is not None:
            self.drive(counts)
        self.run(period_us - period_us // 2)

    def energise(self, counts: tuple[int, int, int] = (100, 200, 300)) -> None:
        """Operational with ``counts`` at the combs."""
        self.start()
        self.cycle(counts)
        self.cycle(counts)
        assert self.node.outputs == counts
        assert self.plant.driven[-1][1] == counts

    def of(self, cob_id: int) -> list[bytes]:
        return [frame.data for _, frame in self.sent if frame.can_id == cob_id]

    def times(self, cob_id: int) -> list[int]:
        return [t_us for t_us, frame in self.sent if frame.can_id == cob_id]


def emergencies(rig: Rig) -> list[int]:
    """Codes of what was sent."""
    return [int.from_bytes(data[:2], "little") for data in rig.of(EMCY)]


def operational(**options: bool) -> Rig:
    rig = Rig(**options)
    rig.start()
    rig.forget()
    return rig


def in_state(state: NmtState, **options: bool) -> Rig:
    rig = Rig(booted=state is not NmtState.INITIALISING, **options)
    if state is not NmtState.INITIALISING:
        rig.nmt(COMMAND_OF[state])
    assert rig.node.state is state
    rig.forget()
    return rig


def assert_only_zero_energises(rig: Rig, counts: tuple[int, int, int]) -> None:
    """Combs that the node has released by itself get a voltage again only after a frame with 0 V."""
    rig.cycle(counts)
    rig.sync()
    assert rig.node.outputs == (0, 0, 0)
    rig.cycle((0, 0, 0))
    rig.cycle(counts)
    rig.sync()
    assert rig.node.outputs == counts


class LockstepNetwork(canopen.Network):  # type: ignore[misc]
    """The canopen library as master: no threads, and a reply is there before ``send_message`` returns."""

    def __init__(self, rig: Rig) -> None:
        super().__init__()
        self._rig = rig
        self._read = len(rig.sent)

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        rig = self._rig
        rig.node.on_frame(Frame(can_id, bytes(data), is_remote=remote), rig.clock.now_us)
        self.run(100)

    def run(self, us: int) -> None:
        self._rig.run(us)
        while self._read < len(self._rig.sent):
            t_us, frame = self._rig.sent[self._read]
            self._read += 1
            self.notify(frame.can_id, bytearray(frame.data), t_us * 1e-6)


def master(rig: Rig) -> tuple[LockstepNetwork, canopen.RemoteNode]:
    network = LockstepNetwork(rig)
    return network, network.add_node(NODE_ID, str(EDS))

"""Hostile frames and broken documents in numbers: ``make fuzz FRAMES=10000000 DOCUMENTS=100000``.

Own seeded generators that bend valid frames and files, since most of what is random is refused at the first byte. A
session is named by target, seed and number, and can be run again alone. What is demanded: no exception but the named
ones, and never a voltage that nobody validly asked for.
"""

import argparse
import random
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "rigs"))  # where pytest has not put it
from conformance_defects import StillPlant

from hil.bus.clock import Lockstep
from hil.node.amplifier import AmplifierNode, NmtState
from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.driver import AmplifierDriver
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.emergency import decode_emergency
from pkxyz_ctrl.can.frame import ERROR, EXTENDED, FD_FAST, REMOTE, UNUSUAL, Frame
from pkxyz_ctrl.can.sdo import ReplyKind, kind_of, value_of
from pkxyz_ctrl.can.startup import configuration_steps, identity_steps
from pkxyz_ctrl.safety.gate import GateConfig, TransmitGate
from pkxyz_ctrl.safety.modes import Mode

EDS = Path(__file__).parents[2] / "configs" / "comb_amplifier.eds"
SESSION_FRAMES = 2000  # then a new node, driver or gate: states that need a fresh start are met again and again
DRIVE, SENSE = ProcessCodec(0x30A, True), ProcessCodec(0x28A, True)
# Objects that may change what drives the combs are left to tests/node/test_node_sdo.py: with them anything is allowed.
_CHANGE_THE_DRIVE = (0x1401, 0x1601, 0x6443, 0x6444)
_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 8, 8, 8, 12, 16, 20, 24, 32, 48, 64)


def _sdo_frames() -> list[Frame]:
    """What a start-up writes and reads, the server's answers, segments and aborts."""
    frames = []
    for step in (*identity_steps(DriverConfig()), *configuration_steps(DriverConfig())):
        head = step.index.to_bytes(2, "little") + bytes((step.subindex,))
        value = (step.value or 0).to_bytes(4, "little")
        command = 0x23 | (4 - step.size) << 2 if step.write else 0x40
        frames.append(Frame(0x60A, bytes((command,)) + head + (value if step.write else bytes(4))))
        answer = 0x60 if step.write else 0x43 | (4 - step.size) << 2
        frames.append(Frame(0x58A, bytes((answer,)) + head + (bytes(4) if step.write else value)))
    for first in (0x60, 0x70, 0x00, 0x10, 0x01, 0x21, 0x41, 0x80, 0xA0, 0xC0, 0xE0):
        frames += [Frame(can_id, bytes((first, 8, 16, 0, 0, 0, 4, 5))) for can_id in (0x58A, 0x60A)]
    return frames


@cache
def corpus() -> list[Frame]:
    """What is bent."""
    return (
        [Frame(0, bytes((command, node))) for command in (1, 2, 128, 129, 130) for node in (0, 10, 11)]
        + [Frame(0x080, bytes((counter,))) for counter in (0, 1, 2, 240, 241)]
        + [Frame(0x70A, bytes((state,))) for state in (0, 4, 5, 127)]
        + [Frame(0x77F, b"\5"), Frame(0x77F, b"\0"), Frame(0x8A, bytes(8)), Frame(0x8A, b"\x10\x23\3\0\0\0\0\0")]
        + [Frame(0x30A, DRIVE.encode((0, 0, 0), 1)), Frame(0x30A, DRIVE.encode((9, 8, 7), 2))]
        + [Frame(0x28A, SENSE.encode((0, -5, 900), 1))]
        + _sdo_frames()
    )


class Traffic:
    """Frames: some valid and in sequence, so that something happens, most of them bent."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._sync = 0
        self._counters = {DRIVE.cob_id: 0, SENSE.cob_id: 0}

    def frame(self) -> Frame:
        rng = self._rng
        dice = rng.random()
        if dice < 0.2:
            self._sync = self._sync % 240 + 1
            return Frame(0x080, bytes((self._sync,)), True, True)
        if dice < 0.35:
            return self._process(DRIVE)
        if dice < 0.45:
            return self._process(SENSE)
        frame = rng.choice(corpus())
        if dice < 0.6:
            return frame
        return self._bent(self._process(rng.choice((DRIVE, SENSE))) if dice < 0.7 else frame)

    def _process(self, codec: ProcessCodec) -> Frame:
        rng = self._rng
        counter = self._counters[codec.cob_id] = self._counters[codec.cob_id] + 1 & 0xFF
        most = rng.choice((0, 3, 40, 32767))
        least = -most - 1 if rng.random() < 0.1 else 0
        a, b, c = rng.randint(least, most), rng.randint(least, most), rng.randint(least, most)
        return Frame(codec.cob_id, codec.encode((a, b, c), counter), True, True)

    def _bent(self, frame: Frame) -> Frame:
        rng = self._rng
        can_id, data, flags = frame
        match rng.randrange(6):
            case 0 | 1:
                changed = bytearray(data)
                for _ in range(rng.randint(1, 3)):
                    if changed:
                        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
                data = bytes(changed)
            case 2:
                data = rng.randbytes(rng.choice(_LENGTHS))
            case 3:
                data = (data + rng.randbytes(64))[: rng.choice(_LENGTHS)]
            case 4:
                can_id = rng.randrange(0x800) if rng.random() < 0.8 else rng.randrange(1 << 29)
            case 5:
                flags = flags & FD_FAST | sum(flag for flag in (REMOTE, EXTENDED, ERROR) if rng.random() < 0.4)
        return Frame._make((can_id, data, flags))


class ViolationError(AssertionError):
    """Something was let through that nobody validly asked for."""


class WatchedPlant(StillPlant):
    """Lets nothing be driven but 0 and what a valid drive PDO has asked for, in operational."""

    def __init__(self) -> None:
        super().__init__()
        self.allowed: set[tuple[int, int, int]] = {(0, 0, 0)}
        self.node: AmplifierNode | None = None
        self.driven = 0

    def drive(self, counts: tuple[int, int, int]) -> None:
        if counts not in self.allowed:
            raise ViolationError(f"the node drives {counts}, which nobody asked for")
        if any(counts):
            self.driven += 1
            if self.node is None or self.node.state is not NmtState.OPERATIONAL:
                raise ViolationError(f"the node drives {counts} outside operational")


def fuzz_node(rng: random.Random, frames: int, node_type: type[AmplifierNode] = AmplifierNode) -> int:
    """The amplifier node. Returns how often a comb was driven: a fuzz that never gets that far shows nothing."""
    clock, plant = Lockstep(), WatchedPlant()
    node = node_type(10, clock, lambda frame: None, plant, EDS, turnaround_us=2, fd=True, protection=True)
    plant.node = node
    node.power_on()
    clock.run_until(5000)
    node.on_frame(Frame(0, b"\1\n"), clock.now_us)
    traffic = Traffic(rng)
    for _ in range(frames):
        frame = traffic.frame()
        if node.state is not NmtState.OPERATIONAL and rng.random() < 0.1:
            frame = Frame(0, b"\1\n")
        if frame.can_id == 0x60A and int.from_bytes(frame.data[1:3], "little") in _CHANGE_THE_DRIVE:
            continue
        if frame.can_id == 0x30A and len(frame.data) == 8 and not frame.flags & UNUSUAL:
            a, b, c, _, right = DRIVE.decode(frame.data)
            if right and min(a, b, c) >= 0:
                plant.allowed.add((a, b, c))
        node.on_frame(frame, clock.now_us)
        if node.state is not NmtState.OPERATIONAL and any(node.outputs):
            raise ViolationError(f"outputs {node.outputs} in {node.state.name}")
        if rng.random() < 0.4:
            clock.run_until(clock.now_us + rng.choice((1, 40, 100, 200, 3000)))
    return plant.driven


def fuzz_driver(rng: random.Random, frames: int) -> int:
    """Our side of the connection: whatever comes, it asks for no voltage. Returns the ticks in operational."""
    driver, traffic, t_us, ticks = AmplifierDriver(DriverConfig()), Traffic(rng), 0, 0
    permitted = {0x000, 0x080, 0x30A, 0x60A, 0x77F}
    answers = {frame.data[1:4]: frame for frame in corpus() if frame.can_id == 0x58A}
    replies = list(driver.start(t_us))
    helpful = rng.random() < 0.7  # a node that answers, so that the dialogue gets further than its first step
    for _ in range(frames):
        t_us += rng.choice((0, 1, 50, 200, 5000)) if rng.random() < 0.5 else 0
        frame = traffic.frame()
        if helpful and driver.state is DriverState.TRYING and rng.random() < 0.2:
            frame = Frame(0x70A, b"\x7f")  # it misses our heartbeat
        elif helpful and replies and rng.random() < 0.8:
            frame = _answer(replies[-1], answers) or frame
        out = list(driver.receive(frame, t_us))
        if rng.random() < 0.3:
            out += driver.poll(t_us)
        if driver.state is DriverState.OPERATIONAL and rng.random() < 0.5:
            out.append(driver.sync(t_us))
            a, b, c, _ = driver.sense.take()
            if not all(-32768 <= count <= 32767 for count in (a, b, c)):
                raise ViolationError(f"the driver believes {a}, {b}, {c}")
            out.append(driver.drive((0, 0, 0), t_us))
            ticks += 1
        elif driver.state is DriverState.FAILED:
            if not driver.failure:
                raise ViolationError("failed without a reason")
            out += driver.start(t_us)
        for sent in out:
            if sent.can_id not in permitted or len(sent.data) > 8:
                raise ViolationError(f"the driver sends {sent}")
            if sent.can_id == 0x30A and any(sent.data[:6]):
                raise ViolationError(f"the driver asks for a voltage: {sent}")
        replies = out or replies
    return ticks


def _answer(asked: Frame, answers: dict[bytes, Frame]) -> Frame | None:
    """What a good node says: to a reset, a request, a start."""
    if asked.can_id == 0:
        return Frame(0x70A, b"\5" if asked.data[:1] == b"\1" else b"\0")
    if asked.can_id != 0x60A:
        return None
    if asked.data[0] != 0x40:
        return Frame(0x58A, b"\x60" + asked.data[1:4] + bytes(4))
    return answers.get(asked.data[1:4]) or Frame(0x58A, b"\x43" + asked.data[1:4] + bytes(4))


def fuzz_gate(rng: random.Random, frames: int, gate_type: type[TransmitGate] = TransmitGate) -> int:
    """The transmit gate: no voltage beyond limit, slew, mode or spacing. Returns how many voltages passed."""
    count_max, slew = rng.choice((0, 50, 5000, 32767)), rng.choice((1, 30, 32767))
    gate = gate_type(GateConfig(count_max=count_max, count_slew_max=slew, period_us=200))
    traffic, t_us, held, counter, passed = Traffic(rng), 0, (0, 0, 0), 0, 0
    mode: int = Mode.TRACKING
    for _ in range(frames):
        t_us += rng.choice((0, 60, 100, 200))
        if rng.random() < 0.02:
            mode = rng.choice((*Mode, Mode.TRACKING, Mode.TRACKING, 99))
        if gate.latched and rng.random() < 0.3:
            gate.clear()
        frame = traffic.frame()
        if rng.random() < 0.5:  # the next drive frame of a good controller
            a, b, c = (min(max(count + rng.randint(-slew, slew), 0), count_max) for count in held)
            if rng.random() < 0.1:
                a, b, c = 0, 0, 0
            frame = Frame(0x30A, DRIVE.encode((a, b, c), counter + 1 & 0xFF))
        if gate.check(frame, mode, t_us) is not None:
            continue
        if frame.can_id == 0x30A:
            a, b, c, counter, right = DRIVE.decode(frame.data)
            counts = (a, b, c)
            steps = [abs(new - old) for new, old in zip(counts, held, strict=True)]
            if any(counts):
                passed += 1
                limits = right and min(counts) >= 0 and max(counts) <= count_max and max(steps) <= slew
                if not limits or mode not in (Mode.ENABLED, Mode.TRACKING, Mode.LANDING):
                    raise ViolationError(f"the gate lets {frame} pass after {held}, mode {mode}")
            held = counts
        elif frame.can_id not in (0x000, 0x080, 0x60A, 0x77F) or frame.flags & UNUSUAL:
            raise ViolationError(f"the gate lets {frame} pass")
    return passed


def fuzz_codec(rng: random.Random, frames: int) -> int:
    """Decoders take any bytes; what a codec calls right, it would have encoded. Returns how many were right."""
    traffic, right_ones = Traffic(rng), 0
    for _ in range(frames):
        data = traffic.frame().data
        decode_emergency(data, 0)
        if len(data) == 8:
            word = int.from_bytes(data, "little", signed=True)
            ReplyKind(kind_of(word))
            if not 0 <= value_of(word) <= 0xFFFF_FFFF:
                raise ViolationError(f"{data.hex(' ')}: no value of an object")
            for codec in (DRIVE, SENSE):
                a, b, c, counter, right = codec.decode(data)
                if right != (codec.encode((a, b, c), counter) == data):
                    raise ViolationError(f"{data.hex(' ')}: right = {right}")
                right_ones += right
    return right_ones


TARGETS: dict[str, tuple[Callable[[random.Random, int], int], float]] = {
    "node": (fuzz_node, 0.4),
    "driver": (fuzz_driver, 0.3),
    "gate": (fuzz_gate, 0.2),
    "codec": (fuzz_codec, 0.1),
}


def fuzz_frames(target: str, frames: int, seed: int) -> tuple[int, int]:
    """At least ``frames`` frames in sessions; (frames, what the target counts). Raises with the session's name."""
    run, _ = TARGETS[target]
    sessions = -(-frames // SESSION_FRAMES)
    reached = 0
    for number in range(sessions):
        try:
            reached += run(random.Random(f"{target} {seed} {number}"), SESSION_FRAMES)
        except Exception as error:
            error.add_note(f"target {target}, seed {seed}, session {number}")
            raise
    return sessions * SESSION_FRAMES, reached


def main() -> int:
    from fuzz_documents import fuzz_documents

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--documents", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    for target, (_, share) in TARGETS.items():
        begin_s = time.monotonic()
        frames, reached = fuzz_frames(target, round(share * arguments.frames), arguments.seed)
        print(f"{target}: {frames} frames, {reached} of interest, {time.monotonic() - begin_s:.0f} s", flush=True)
    begin_s = time.monotonic()
    told = fuzz_documents(arguments.documents, arguments.seed)
    print(f"documents: {told}, {time.monotonic() - begin_s:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Process frames that are damaged, replayed, stale or swapped, imposed on each of the three that receive or check them.

Payloads are made with crccheck (``node_rig.protected``), so that none of the three is held to its own CRC.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import pytest
from gate_frames import CONFIG, sync
from hypothesis import given, settings
from hypothesis import strategies as st
from node_rig import DRIVE, SENSE, Rig, protected

from pkxyz_ctrl.can.codec import Counts, ProcessCodec
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.can.sense_input import SENSE_MISSING, SenseInput
from pkxyz_ctrl.safety.gate import TransmitGate
from pkxyz_ctrl.safety.modes import Mode

FRAME_BITS = 11 + 64  # identifier and payload


def counts_of(number: int) -> Counts:
    """What frame number 0, 1, 2, ... carries: no two of 30 000 alike, and never 0 V."""
    return number % 30_000 + 1, 7, number % 256


class Receiver(ABC):
    """Somebody who takes process frames of one identifier, one a period; ``number`` is that of the next one due."""

    cob_id: int

    def __init__(self) -> None:
        self.number = 0

    @abstractmethod
    def period(self, *payloads: bytes) -> list[Counts]:
        """One period, in which these arrive: the counts that were put to use."""

    def step(self, *payloads: bytes) -> list[Counts]:
        used = self.period(*payloads)
        self.number += 1
        return used

    def frame(self, number: int) -> bytes:
        return protected(self.cob_id, counts_of(number), number % 256)

    def own(self) -> bytes:
        return self.frame(self.number)

    def goes_on(self) -> bool:
        """Whether two good frames are enough after whatever was."""
        for _ in range(2):
            due = counts_of(self.number)
            used = self.step(self.own())
        return used == [due]


class Controller(Receiver):
    """Sense frames as the driver believes them."""

    cob_id = SENSE

    def __init__(self) -> None:
        super().__init__()
        self.sense = SenseInput(ProcessCodec(SENSE, protected=True))

    def period(self, *payloads: bytes) -> list[Counts]:
        self.sense.on_sync()
        for payload in payloads:
            self.sense.receive(payload)
        a, b, c, status = self.sense.take()
        return [] if status & SENSE_MISSING else [(a, b, c)]


class Node(Receiver):
    """Drive frames as the amplifier applies them, by what its plant is driven with."""

    cob_id = DRIVE

    def __init__(self) -> None:
        super().__init__()
        self.rig = Rig()
        self.rig.start()

    def period(self, *payloads: bytes) -> list[Counts]:
        before = len(self.rig.plant.driven)
        for payload in payloads:
            self.rig.give(DRIVE, payload)
        self.rig.sync()
        self.rig.run(200)
        return [counts for _, counts in self.rig.plant.driven[before:] if any(counts)]


class Gate(Receiver):
    """Drive frames as the gate lets them out; only counter and CRC are in their way. What it blocks is sent again
    before the next SYNC.
    """

    cob_id = DRIVE

    def __init__(self) -> None:
        super().__init__()
        self.gate = TransmitGate(replace(CONFIG, count_max=32767, count_slew_max=32767))
        self.t_us = 0
        assert self.period(protected(DRIVE, (0, 0, 0), 255)) == [(0, 0, 0)]

    def period(self, *payloads: bytes) -> list[Counts]:
        passed = []
        self.t_us += 200
        for payload in payloads:
            if self.gate.check(Frame(DRIVE, payload), Mode.TRACKING, self.t_us) is None:
                a, b, c = (int.from_bytes(payload[k : k + 2], "little") for k in (0, 2, 4))
                passed.append((a, b, c))
            self.gate.clear()
        if passed:
            assert self.gate.check(sync(), Mode.TRACKING, self.t_us) is None
        return passed

    def step(self, *payloads: bytes) -> list[Counts]:
        used = self.period(*payloads)
        self.number += counts_of(self.number) in used
        return used


def damages() -> Iterator[int]:
    """Every error of one and of two bits in identifier and payload, as a mask of 75 bits, the identifier's highest."""
    yield from (1 << a for a in range(FRAME_BITS))
    yield from (1 << a | 1 << b for a, b in combinations(range(FRAME_BITS), 2))


class ProcessFrames(ABC):
    """What holds for each receiver."""

    receiver: type[Receiver]

    def running(self, frames: int) -> Receiver:
        """A receiver that has taken so many good frames."""
        receiver = self.receiver()
        for _ in range(frames):
            due = counts_of(receiver.number)
            assert receiver.step(receiver.own()) == [due]
        return receiver

    def test_damaged_in_one_or_two_bits(self) -> None:
        """Identifier included: the frame was sent under another one, and came under this."""
        receiver = self.running(3)
        tried = 0
        for mask in damages():
            sent = protected(receiver.cob_id ^ mask >> 64, counts_of(receiver.number), receiver.number % 256)
            damaged = int.from_bytes(sent, "little") ^ mask & (1 << 64) - 1
            assert receiver.step(damaged.to_bytes(8, "little")) == [], hex(mask)
            assert receiver.goes_on(), hex(mask)
            tried += 1
        assert tried == 75 + 2775

    def test_replayed(self) -> None:
        """Each of the last 255 instead of the next one. An eight-bit alive counter cannot tell the 256th from it."""
        receiver = self.running(300)
        for back in range(1, 256):
            assert receiver.step(receiver.frame(receiver.number - back)) == [], back
            assert receiver.goes_on(), back

    def test_replayed_beside_the_right_one(self) -> None:
        receiver = self.running(300)
        for back in range(1, 255):
            due, old = counts_of(receiver.number), receiver.frame(receiver.number - back)
            assert receiver.step(receiver.own(), old) == [due], back
            assert receiver.goes_on(), back
            due, old = counts_of(receiver.number), receiver.frame(receiver.number - back)
            assert receiver.step(old, receiver.own()) in ([due], []), back
            assert receiver.goes_on(), back

    def test_from_the_future(self) -> None:
        receiver = self.running(3)
        for ahead in range(1, 256):
            assert receiver.step(receiver.frame(receiver.number + ahead)) == [], ahead
            assert receiver.goes_on(), ahead

    def test_swapped(self) -> None:
        """Two frames in exchanged order, in two periods: neither is used; in one: at most the one that is due."""
        receiver = self.running(3)
        for _ in range(300):
            assert receiver.step(receiver.frame(receiver.number + 1)) == []
            assert receiver.step(receiver.frame(receiver.number - 1)) == []
            assert receiver.goes_on()
            due = counts_of(receiver.number)
            assert receiver.step(receiver.frame(receiver.number + 1), receiver.own()) in ([due], [])
            assert receiver.goes_on()

    def test_drive_and_sense_swapped(self) -> None:
        receiver = self.running(3)
        other = {SENSE: DRIVE, DRIVE: SENSE}[receiver.cob_id]
        for _ in range(256):
            assert receiver.step(protected(other, counts_of(receiver.number), receiver.number % 256)) == []
            assert receiver.goes_on()


class TestController(ProcessFrames):
    receiver = Controller

    def test_stale(self) -> None:
        """A sense frame that comes ``late`` periods after its SYNC, and all that follow as late."""
        for late in range(1, 254):
            receiver = self.running(3)
            assert all(receiver.step() == [] for _ in range(late))
            for _ in range(3):
                assert receiver.step(receiver.frame(receiver.number - late)) == [], late


class TestNode(ProcessFrames):
    receiver = Node


class TestGate(ProcessFrames):
    receiver = Gate


def test_every_receiver_is_tried() -> None:
    assert {case.receiver for case in ProcessFrames.__subclasses__()} == set(Receiver.__subclasses__())


@pytest.mark.parametrize("kind", [Controller, Gate])
@settings(max_examples=100)
@given(periods=st.lists(st.lists(st.integers(-4, 4), max_size=3), max_size=40))
def test_whatever_comes_only_what_is_due_is_used(kind: type[Receiver], periods: list[list[int]]) -> None:
    """``periods``: which frames come, counted from the one that is due.

    The node is not asked: a second frame in sequence is a new beginning to it, since it cannot know what was lost.
    """
    receiver = kind()
    assert receiver.step(receiver.own()) == [counts_of(0)]
    for offsets in periods:
        due = counts_of(receiver.number)
        used = receiver.step(*(receiver.frame(receiver.number + offset) for offset in offsets))
        assert used in ([due], [])
        assert used == [] or 0 in offsets

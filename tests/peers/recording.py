"""Exchanges with programs that CI can't fetch, as candump logged them: one side is played, the other is ours.

A line of a log is ``(seconds) interface identifier#data``, as ``candump -L`` writes it.
"""

import re
from collections import deque
from pathlib import Path

from hil.bus.clock import Lockstep
from pkxyz_ctrl.can.frame import Frame

RECORDED = Path(__file__).parent / "recorded"
NMT, REQUEST, REPLY = 0x000, 0x60A, 0x58A
_LINE = re.compile(r"\((\d+\.\d+)\) \S+ ([0-9A-F]{3})#([0-9A-F]*)")


def frames_of(name: str) -> list[tuple[int, Frame]]:
    """(microseconds from the first, frame) of each line."""
    found = [_LINE.match(line) for line in (RECORDED / name).read_text(encoding="ascii").splitlines()]
    times = [round(1e6 * float(match[1])) for match in found if match]
    frames = [Frame(int(match[2], 16), bytes.fromhex(match[3])) for match in found if match]
    return [(t_us - times[0], frame) for t_us, frame in zip(times, frames, strict=True)]


class RecordedNode:
    """A node that says what it said when it was recorded: to each SDO request the answer that it gave to this request,
    after each NMT command what it sent by itself until the next.
    """

    def __init__(self, name: str, own: frozenset[int]) -> None:
        self._answers: dict[bytes, deque[Frame]] = {}
        self._after: deque[tuple[bytes, list[tuple[int, Frame]]]] = deque()
        asked, began_us = b"", 0
        for t_us, frame in frames_of(name):
            if frame.can_id == NMT:
                self._after.append((frame.data, []))
                began_us = t_us
            elif frame.can_id == REQUEST:
                asked = frame.data
                self._answers.setdefault(asked, deque())  # or none
            elif frame.can_id == REPLY:
                self._answers[asked].append(frame)
            elif frame.can_id in own and self._after:
                self._after[-1][1].append((t_us - began_us, frame))
        self.waiting: list[tuple[int, Frame]] = []

    def receive(self, frame: Frame, t_us: int) -> None:
        """What a master sends."""
        if frame.can_id == REQUEST:
            answers = self._answers.get(frame.data)
            assert answers is not None, f"{frame.data.hex(' ')} was not asked when this was recorded: record it again"
            if answers:
                self.waiting.append((t_us + 1000, answers[0] if len(answers) == 1 else answers.popleft()))
        elif frame.can_id == NMT:
            while self._after and self._after[0][0] != frame.data:
                self._after.popleft()
            assert self._after, f"NMT {frame.data.hex(' ')} was not sent when this was recorded: record it again"
            self.waiting = [(t_us + after_us, said) for after_us, said in self._after.popleft()[1]]

    def due(self, t_us: int) -> list[Frame]:
        """What the node has sent by now."""
        ready = [frame for at_us, frame in self.waiting if at_us <= t_us]
        self.waiting = [entry for entry in self.waiting if entry[0] > t_us]
        return ready


class RecordedPort:
    """A port with such a node at the other end, on the clock of lockstep."""

    def __init__(self, node: RecordedNode, clock: Lockstep) -> None:
        self._node, self._clock = node, clock

    def send(self, frame: Frame) -> None:
        self._node.receive(frame, self._clock.now_us)

    def receive(self, deadline_us: int) -> Frame | None:
        waiting = sorted(self._node.waiting, key=lambda entry: entry[0])
        if not waiting or waiting[0][0] > deadline_us:
            self._clock.run_until(max(self._clock.now_us, deadline_us))
            return None
        at_us, frame = waiting[0]
        self._node.waiting.remove(waiting[0])
        self._clock.run_until(max(self._clock.now_us, at_us))
        return frame

    def unsent(self) -> int:
        return 0

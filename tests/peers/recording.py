"""Exchanges with programs that CI can't fetch, as candump logged them: one side is played, the other is ours.

A line of a log is ``(seconds) interface identifier#data``, as ``candump -L`` writes it.
"""

import re
from collections import deque
from pathlib import Path

from hil.bus.clock import Lockstep
from pkxyz_ctrl.can.frame import Frame

RECORDED = Path(__file__).parent / "recorded"
NMT, REQUEST, REPLY, HEARTBEAT = 0x000, 0x60A, 0x58A, 0x77F
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


class FollowedNode:
    """A node whose log is followed from its beginning: what a master sends is looked for from there to the next reset,
    and what the node said behind it is said again. So it is asked in the order of the log, and ``misses`` counts what
    is not there.
    """

    def __init__(self, name: str, own: frozenset[int]) -> None:
        self._frames, self._own, self._at = frames_of(name), own, 0
        self.waiting: list[tuple[int, Frame]] = []
        self.misses = 0

    def receive(self, frame: Frame, t_us: int) -> None:
        """What a master sends."""
        if frame.can_id == HEARTBEAT:  # at times of its own
            return
        if _is_reset(frame):
            self.waiting.clear()
        for at in range(self._at, len(self._frames)):
            sent_us, sent = self._frames[at]
            if (sent.can_id, sent.data) == (frame.can_id, frame.data):
                self._answer(at + 1, t_us - sent_us)
                return
            if _is_reset(sent) and not _is_reset(frame):
                break
        self.misses += 1

    def _answer(self, at: int, later_us: int) -> None:
        while at < len(self._frames) and self._frames[at][1].can_id in self._own:
            said_us, said = self._frames[at]
            self.waiting.append((said_us + later_us, said))
            at += 1
        self._at = at


def _is_reset(frame: Frame) -> bool:
    return frame.can_id == NMT and frame.data[0] in (0x81, 0x82)


class RecordedPort:
    """A port with such a node at the other end, on the clock of lockstep."""

    def __init__(self, node: RecordedNode | FollowedNode, clock: Lockstep) -> None:
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

"""The loop in C, and beside it the session, in a process that it waits for in nothing but simulated time.

Once a tick, if it is in time, the session looks at what the tick left and hands in what is decided. The loop leads the
stage down and ends where set-points run out while it moves, and where nobody reads the pipe any more.
"""

import os
import select
from collections.abc import Callable
from pathlib import Path

from hil.lanes.ending import Ended, Ending
from hil.lanes.setup import Setup
from hil.lanes.wall import COMPANY_S, require_real_bus
from hil.native.held_pipe import HeldPipe
from hil.native.loop_process import LoopProcess
from hil.native.mapped import RING_BYTES, Mapped, text_of
from hil.native.ring_recorder import RingBytes
from hil.operate.memory import StageMemory
from hil.operate.running.at_rate import KEPT_S, Counted, OperatedLoop, description, session_of
from hil.operate.running.ordered import Ordered
from hil.operate.running.sheets import Sheets
from hil.operate.setpoints import planned_rows_of, rows_of
from hil.operate.settings import Settings
from hil.recording.writer_process import END_KIND, ROW_KIND, entries_of, frame_at
from pkxyz_ctrl.client import place
from pkxyz_ctrl.export.shared import Phase
from pkxyz_ctrl.io.realtime import FIFO_PRIORITY, go_real_time, leave_real_time, settle_memory

_PRIORITY = FIFO_PRIORITY - 10
"""Below the loop's and the plant's, which wait for nothing of it."""
_LOOK_MS, _LOOK_TICKS = 20, 50


class _Beside:
    """What is done once a tick: look, decide, hand in, write down."""

    def __init__(
        self, ordered: Ordered, setpoints: Sheets, joined: OperatedLoop, counted: Counted, ring: RingBytes
    ) -> None:
        self._ordered, self._setpoints, self._joined = ordered, setpoints, joined
        self._counted, self._ring = counted, ring
        self._pending = b""
        self._stepped_us: int | None = None
        ordered.hand_in(setpoints)

    def after(self) -> None:
        """Some ticks may be over."""
        ordered, setpoints = self._ordered, self._setpoints
        if ordered.look():
            if ordered.answered(setpoints):
                self._joined.step(self._missed())
            ordered.hand_in(setpoints)
            setpoints.extend()
        self._write_down()

    def _missed(self) -> int:
        """Periods between the last step and this one, and not its own, nor such as its row says were skipped."""
        began_us, period_us = int(self._ordered.exchange["begun_us"][0]), self._ordered.period_us
        before_us, self._stepped_us = self._stepped_us, began_us
        if before_us is None:
            return 0
        passed = round((began_us - before_us) / period_us)
        return max(0, passed - 1 - int(self._ordered.memory["row"]["overrun"][0]))

    def _write_down(self) -> None:
        """Rows and frames of all ticks, also of those that the session was late for."""
        if not (part := self._ring.take()):
            return
        pending, end = self._pending + part, 0
        for at, end in entries_of(pending):
            if pending[at] == ROW_KIND:
                self._joined.tell(pending[at + 1 : end])
            elif pending[at] != END_KIND:
                self._counted.frame(*frame_at(pending, at, end))
        self._pending = pending[end:]


def operate_natively(
    program: Path, setup: Setup, settings: Settings, name: str, files: dict[str, str], say: Callable[[str], object]
) -> int:
    """As ``at_rate.operate``, by the native loop that is compiled in ``program``. Returns an exit code: 1, with a line,
    where the loop ended without being asked.
    """
    can = require_real_bus(setup.bus)
    with Ending() as ending:
        counted, held, wake = Counted(can), HeldPipe(), os.eventfd(0, os.EFD_NONBLOCK)
        mapped = Mapped(blocks=1, ring_bytes=RING_BYTES)
        ordered = Ordered(setup, mapped.shared[0])
        loop = LoopProcess(program, setup, can, mapped, ordered, held, ending)
        memory = StageMemory.made(name, round(KEPT_S / setup.bus.period_s))
        try:
            sheets = mapped.shared["operated"]["sheets"][0, 0]
            setpoints = Sheets(
                setup.bus.period_us, *rows_of(ordered.law), sheets, ordered.present_row, planned_rows_of(ordered.law)
            )
            session = session_of(setup, settings, ordered, memory, setpoints)
            operated = OperatedLoop(session, memory, counted, lambda: int(loop.state["stood_us"]))
            beside = _Beside(ordered, setpoints, operated, counted, RingBytes(mapped))
            loop.begin(say, COMPANY_S, wake=wake)
            place.write(name, "loop", description(setup, settings, memory, files))
            say(text_of(loop.state["real_time"]))
            go_real_time(_PRIORITY)
            settle_memory()
            loop.start(say)
            _go_on(loop, beside, wake)
            loop.raise_outcome()
        except Ended:
            if ending.signal_number:
                return 0
        finally:
            try:
                loop.close()
            finally:
                held.handed_over()
                os.close(held.alive)
                os.close(wake)
                place.forget(name, "loop")
                memory.remove()
                leave_real_time()
    say(f"pkxyz: {ordered.faults[-1]}")
    return 1


def _go_on(loop: LoopProcess, beside: _Beside, wake: int) -> None:
    """Until the loop has ended. Raises ``Ended`` where it was killed."""
    poll = select.poll()
    poll.register(wake, select.POLLIN)
    ticks = 0
    while loop.state["phase"] != Phase.ENDED:
        if poll.poll(_LOOK_MS):
            os.eventfd_read(wake)
            ticks += 1
        else:
            ticks = _LOOK_TICKS
        if ticks >= _LOOK_TICKS:
            ticks = 0
            if not loop.look():
                break
        beside.after()

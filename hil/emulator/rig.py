"""The loop closed with a controller on an emulated board; bus, amplifier, plant and time are those of lockstep.

Nothing there happens while the board computes: it asks for a time or a frame, the scheduler runs until then, and the
answer says what time it is. So the bits do not depend on how fast either side is.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.emulator.board import DISCARD, INSTRUCTIONS_A_COUNT, SPEND, WAIT_UNTIL, Board, BoardGoneError, Request
from hil.emulator.image import built
from hil.emulator.told import ToldController
from hil.faults.clock import ControllerKilledError
from hil.lanes.blocks import Blocks, Handout
from hil.lanes.in_process import LaneResult
from hil.lanes.lane import Lane
from hil.lanes.lockstep import LockstepRig
from hil.lanes.setup import Setup
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.export.calls import Call
from pkxyz_ctrl.loop.controller import StartUpError
from pkxyz_ctrl.loop.cycle import new_memory
from pkxyz_ctrl.loop.runtime import Clock
from pkxyz_ctrl.safety.modes import Mode

_LOOK_US = 1_000
_LOOKED_AT_MOST_US = 200_000
DISCHARGED_V = 1.0
"""All combs below: nothing moves the stage."""


TAKEN = np.dtype([("mode", "i4"), ("cycle", "u4"), ("period", "u4")])
"""Of a tick: its mode, and instructions of the cycle, and of all calls, frames and gate included."""


class EmulatedRig(LockstepRig):
    """A board between bus and nothing: it is switched on for ``run``. ``image``: as ``image_of`` gives it for this
    setup; ``scratch``: a folder for what the board notes, of its own; ``taken`` (ticks,) of ``TAKEN``.
    """

    def __init__(self, setup: Setup, image: Path, scratch: Path, frame_log: Path | None = None) -> None:
        super().__init__(setup, frame_log, whole_ticks=False, controller=ToldController)
        assert isinstance(self.controller, ToldController)
        self._told = self.controller
        self._image, self._scratch = image, scratch
        self.taken: NDArray[np.void] = np.zeros(setup.ticks, TAKEN)

    def run(self, blocks: Blocks) -> tuple[int, float]:
        """As in lockstep; the board is switched on and off here."""
        with Board(self._image, self._scratch) as board:
            self.board = board
            return super().run(blocks)

    def _bring_up(self) -> None:
        try:
            while True:
                self._request = self._asked(self.clock)
                if self._told.is_up:
                    return
                self._answer(self.clock)
        except BoardGoneError as error:
            raise StartUpError(f"the emulated board {error}") from None

    def _run_ticks(self, clock: Clock, reference: Any, taking: Callable[[int], object], record: Any) -> None:
        tick = 0
        try:
            while True:
                self._answer(clock)
                self._request = self._asked(clock)
                if self._told.finished > tick:
                    reference(tick)  # none is needed here; the rows of a full block are handed on
                    taking(tick)
                    tick += 1
                    if tick == record.ticks:
                        return
        except ControllerKilledError:
            self.board.kill()
            raise
        except BoardGoneError as error:
            self._outlive(str(error), tick)

    def _asked(self, clock: Clock) -> Request:
        """What the board asks next; the frames before go out, and what it noted is taken in."""
        told = self._told
        while True:
            said = self.board.said()
            if isinstance(said, Frame):
                self.port.send(said)
            elif said.what == SPEND:
                clock.spend(said.us)
            elif said.what == DISCARD:
                self._endpoint.flush()
            else:
                for head, memory in self.board.notes(said.notes, told.held):
                    told.take(head, memory)
                    if int(head["call"]) == Call.FINISH:
                        cycle, period = (int(head[name]) for name in ("cycle_counts", "period_counts"))
                        taken = (told.mode, cycle * INSTRUCTIONS_A_COUNT, period * INSTRUCTIONS_A_COUNT)
                        self.taken[told.finished - 1] = taken
                return said

    def _answer(self, clock: Clock) -> None:
        told, what, until_us = self._told, self._request.what, self._request.us
        told.handed = None
        if what == WAIT_UNTIL:
            clock.wait_until(until_us)
        else:
            told.handed = self.port.receive(until_us)
        self.board.tell(clock.now_us, self.port.unsent(), told.asked, told.handed)
        told.asked = None

    def _outlive(self, how: str, tick: int) -> None:
        """The board is gone: bus and amplifier go on, and somebody looks when the combs are at 0 V."""
        clock, begin_us = self.clock, self.clock.now_us
        while clock.now_us < begin_us + _LOOKED_AT_MOST_US:
            clock.run_until(clock.now_us + _LOOK_US)
            self.plant.look(clock.now_us)
            if float(self.plant.plant.voltage_v.max()) < DISCHARGED_V:
                after = f"all combs at 0 V within {(clock.now_us - begin_us) / 1000:g} ms"
                break
        else:
            after = f"combs still driven {_LOOKED_AT_MOST_US / 1000:g} ms later"
        self.controller.faults.append(f"at {tick * self.setup.bus.period_s:.4f} s: the emulated board {how}; {after}")


def image_of(setup: Setup, place: Path) -> Path:
    """The firmware for a setup, in a folder of images, where one of the same content is used again.

    Raises ``ConfigError`` for what can't go on the board, or without the programs.
    """
    if setup.bus.can is None:
        raise ConfigError(f"bus {setup.bus.name!r} has no [can], and a board is all about frames; give another --bus")
    if setup.learning is not None:
        raise ConfigError("the board has its path in flash and can't learn: take [learning] out, or use `pkxyz sil`")
    handout = Handout(setup.trajectory, setup.bus.period_us, setup.excitation)
    reference = handout.rows(new_memory(Mode.IDLE), setup.ticks)
    controller = ToldController(setup.law.copy(), setup.bus, setup.gate)
    return built(controller.record, reference, setup.new_outputs(), setup.bus.can, setup.controller.name, place)


class Emulation:
    """A scenario's firmware, and its run. ``taken``: that of the rig."""

    def __init__(self, setup: Setup, scratch: Path) -> None:
        """Raises ``ConfigError``, as ``image_of``; nothing has been run or written then but in ``scratch``."""
        self.taken: NDArray[np.void] = np.zeros(0, TAKEN)
        self._scratch, self._image = scratch, image_of(setup, scratch)

    def run(
        self, setup: Setup, lane: Lane, *, on_block: Callable[[NDArray[np.void]], None],
        on_progress: Callable[[int, int], None], frame_log: Path,
    ) -> LaneResult:  # fmt: skip
        """As ``in_process.run``."""
        blocks = Blocks(setup.trajectory, setup.bus.period_us, setup.ticks, on_block, on_progress, setup.excitation)
        rig = EmulatedRig(setup, self._image, self._scratch, frame_log)
        begin_s = time.perf_counter()
        missed, load = rig.run(blocks)
        factor = setup.ticks * setup.bus.period_s / (time.perf_counter() - begin_s)
        controller, self.taken = rig.controller, rig.taken
        adaptation = controller.memory["tick"]["adaptation"].copy()
        return LaneResult(
            setup.ticks, missed, load, tuple(controller.faults), factor, None, controller.driver.lost, adaptation
        )

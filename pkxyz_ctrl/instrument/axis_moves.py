"""Moves of single axes that overlap: one of y begun while x is on its way is one motion of both."""

import asyncio
from dataclasses import dataclass
from typing import NamedTuple

from pkxyz_ctrl.client.reply import AbortedError, Command, RefusedError, Status
from pkxyz_ctrl.client.stage import AsyncStage, Axis

AXES: tuple[Axis, ...] = ("x", "y", "z")


class MotionLimits(NamedTuple):
    """Limits of a move of one axis."""

    velocity_m_per_s: float
    acceleration_m_per_s2: float
    jerk_m_per_s3: float


@dataclass
class _Move:
    axis: Axis
    limits: MotionLimits
    asked: "asyncio.Task[Command]"

    @property
    def was_refused(self) -> bool:
        return self.asked.done() and not self.asked.cancelled() and isinstance(self.asked.exception(), RefusedError)


class AxisMoves:
    """Of one stage. Control is taken with the first thing that needs it, and kept."""

    def __init__(self, stage: AsyncStage) -> None:
        self.stage = stage
        self._moves: list[_Move] = []  # since all stood
        self._under_way = 0
        self._has_control = False
        self.stops = 0
        """how often ``stand_still`` was asked for"""

    async def take_control(self) -> None:
        """Raises ``RefusedError`` while another has it."""
        if not self._has_control:
            await self.stage.take_control()
            self._has_control = True

    async def give_control(self) -> None:
        """Let others have it."""
        self._has_control = False
        await self.stage.give_control()

    async def move(self, axis: Axis, target_m: float, limits: MotionLimits) -> Command:
        """Bring an axis to a target, until the stage is in position; other axes go on to theirs, none of them faster
        than the slowest of those on their way. Raises ``RefusedError`` and ``AbortedError``.
        """
        await self.take_control()
        slowest = MotionLimits(*(min(each) for each in zip(limits, *(m.limits for m in self._moves), strict=True)))
        asking = self.stage.move_to(*(target_m if each == axis else None for each in AXES), **slowest._asdict())
        own = _Move(axis, limits, asyncio.create_task(asking))
        self._moves.append(own)
        self._under_way += 1
        try:
            return await self._end_of(own)
        finally:
            self._under_way -= 1
            if self._under_way == 0:
                self._moves.clear()

    async def _end_of(self, move: _Move) -> Command:
        """Of a move, or of a later one that has taken it up."""
        while True:
            try:
                return await asyncio.shield(move.asked)
            except AbortedError:
                later = [m for m in self._moves[self._moves.index(move) + 1 :] if not m.was_refused]
                if not later:
                    raise
                move = later[-1]

    async def stand_still(self) -> Status:
        """Stop all axes, and wait until their set-points stand."""
        self.stops += 1
        await self.stage.stop()
        status = await self.stage.next_status()
        while status.activity in ("moving", "jogging", "stopping", "scanning"):
            status = await self.stage.next_status()
        return status

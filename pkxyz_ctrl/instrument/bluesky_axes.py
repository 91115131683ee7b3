"""The stage's axes as devices of a bluesky plan, in the plan's own process; by their methods, so nothing is imported.

Positions are in m. For plans that are shared with other machines there is ``pkxyz ioc``.
"""

import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from pkxyz_ctrl.client.plain import Stage, begun_in
from pkxyz_ctrl.client.reply import Command, StageError
from pkxyz_ctrl.client.stage import AsyncStage, Axis
from pkxyz_ctrl.instrument.axis_moves import AXES, AxisMoves, MotionLimits


class MoveStatus:
    """Bluesky's ``Status`` of a move: done when the stage is in position, or will not be."""

    def __init__(self, future: "Future[Command]") -> None:
        self._future = future

    def add_callback(self, callback: Callable[["MoveStatus"], None]) -> None:
        """Called with this at its end."""
        self._future.add_done_callback(lambda _: callback(self))

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:
        """What went wrong. Raises ``TimeoutError`` while it is not done."""
        return self._future.exception(timeout)

    @property
    def done(self) -> bool:
        """Whether it has ended."""
        return self._future.done()

    @property
    def success(self) -> bool:
        """Whether it has ended well."""
        return self.done and self._future.exception() is None


class StageAxis:
    """One axis: bluesky's Readable, Movable, Locatable, Stoppable and Checkable."""

    parent = None

    def __init__(self, name: str, axis: Axis, stage: Stage, moves: AxisMoves) -> None:
        self.name = name
        self._axis, self._n, self._stage, self._moves = axis, AXES.index(axis), stage, moves

    # -- what bluesky reads --------------------------------------------------------------------------------------------

    @property
    def position(self) -> float:
        """In m, as estimated."""
        return float(self._stage.next_status().position_m[self._n])

    @property
    def hints(self) -> dict[str, Any]:
        """What a plot shows."""
        return {"fields": [self.name]}

    def read(self) -> dict[str, dict[str, Any]]:
        """Position and set-point, of one instant."""
        status, now_s = self._stage.next_status(), time.time()
        values = {self.name: status.position_m, f"{self.name}_setpoint": status.target_m}
        return {key: {"value": float(value[self._n]), "timestamp": now_s} for key, value in values.items()}

    def describe(self) -> dict[str, dict[str, Any]]:
        """Of what ``read`` gives."""
        source = f"pkxyz:{self._stage.description['stage']}.{self._axis}"
        about = {"source": source, "dtype": "number", "shape": [], "units": "m", "precision": 10}
        return {self.name: about, f"{self.name}_setpoint": dict(about)}

    def read_configuration(self) -> dict[str, dict[str, Any]]:
        """The limits of moves."""
        values = zip(MotionLimits._fields, self._stage.description["limits"], strict=True)
        return {f"{self.name}_{key}": {"value": value, "timestamp": time.time()} for key, value in values}

    def describe_configuration(self) -> dict[str, dict[str, Any]]:
        """Of what ``read_configuration`` gives."""
        about = {"source": "pkxyz:limits", "dtype": "number", "shape": []}
        return {f"{self.name}_{key}": dict(about) for key in MotionLimits._fields}

    # -- what it does --------------------------------------------------------------------------------------------------

    def set(self, value: float) -> MoveStatus:
        """To a position in m; axes that are set together move together."""
        limits = MotionLimits(*self._stage.description["limits"])
        return MoveStatus(begun_in(self._stage, lambda _: self._moves.move(self._axis, float(value), limits)))

    def locate(self) -> dict[str, float]:
        """Where it should be, and where it is."""
        status = self._stage.next_status()
        return {"setpoint": float(status.target_m[self._n]), "readback": float(status.position_m[self._n])}

    def check_value(self, value: float) -> None:
        """Raises ``StageError`` for what the combs can't hold while the other axes stay where they are."""
        low, high = self._stage.next_status().range_m[self._n]
        if not low <= value <= high:
            raise StageError(f"{self.name} = {value:g} m, limits {low:g} to {high:g} m")

    def stop(self, *, success: bool = True) -> None:
        """Stop all axes, if something moves."""
        if self._stage.next_status().activity != "holding":
            begun_in(self._stage, lambda _: self._moves.stand_still()).result()


def axes(stage: Stage, prefix: str = "") -> tuple[StageAxis, StageAxis, StageAxis]:
    """x, y and z of a connected stage.

    >>> with pkxyz_ctrl.connect() as stage:
    ...     x, y, z = axes(stage)
    ...     RE(grid_scan([], y, -1e-6, 1e-6, 11, x, -1e-6, 1e-6, 11))
    """

    async def moves(behind: AsyncStage) -> AxisMoves:
        return AxisMoves(behind)

    shared = begun_in(stage, moves).result()
    x, y, z = (StageAxis(f"{prefix}{axis}", axis, stage, shared) for axis in AXES)
    return x, y, z

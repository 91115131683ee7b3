"""A stage in operation, for programs without asyncio: ``AsyncStage``, each call waiting for its end."""

import asyncio
import threading
from collections.abc import Coroutine, Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Self, TypeVar

from pkxyz_ctrl.client import place
from pkxyz_ctrl.client.protocol import Block
from pkxyz_ctrl.client.reply import Command, Status
from pkxyz_ctrl.client.stage import AsyncStage, Axis, connect_async
from pkxyz_ctrl.client.trigger import Trigger

T = TypeVar("T")


class Stage:
    """A stage in operation. Made by ``connect``; lengths are in m, times in s.

    >>> with pkxyz_ctrl.connect() as stage:
    ...     stage.home()
    ...     stage.enable()
    ...     stage.move_to(z=18e-6)
    ...     stage.move_to(x=1e-6)
    """

    def __init__(self, stage: AsyncStage) -> None:
        self._stage = stage
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        try:
            self._now(self._stage.__aenter__())
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._now(self._stage.__aexit__(kind, error, trace))
        finally:
            self._end()

    def home(self) -> Command:
        """Average the sense offsets at rest, at 0 V."""
        return self._now(self._stage.home())

    def enable(self) -> Command:
        """Close the loop; the stage then holds its rest pose."""
        return self._now(self._stage.enable())

    def disable(self) -> Command:
        """Open the loop: 0 V."""
        return self._now(self._stage.disable())

    def move_to(
        self,
        x: float | None = None,
        y: float | None = None,
        z: float | None = None,
        *,
        velocity_m_per_s: float | None = None,
        acceleration_m_per_s2: float | None = None,
        jerk_m_per_s3: float | None = None,
        wait: bool = True,
    ) -> Command:
        """Go to a point, in m; axes left out keep their target. A move in flight takes the new target up.

        ``wait``: until the stage is in position, else until the move has begun. Raises ``RefusedError`` for what the
        combs can't hold, before anything moves.
        """
        return self._now(
            self._stage.move_to(
                x, y, z, velocity_m_per_s=velocity_m_per_s, acceleration_m_per_s2=acceleration_m_per_s2,
                jerk_m_per_s3=jerk_m_per_s3, wait=wait,
            )
        )  # fmt: skip

    def move_by(
        self,
        x: float | None = None,
        y: float | None = None,
        z: float | None = None,
        *,
        velocity_m_per_s: float | None = None,
        acceleration_m_per_s2: float | None = None,
        jerk_m_per_s3: float | None = None,
        wait: bool = True,
    ) -> Command:
        """Go by a way, in m, from the present target."""
        return self._now(
            self._stage.move_by(
                x, y, z, velocity_m_per_s=velocity_m_per_s, acceleration_m_per_s2=acceleration_m_per_s2,
                jerk_m_per_s3=jerk_m_per_s3, wait=wait,
            )
        )  # fmt: skip

    def jog(self, axis: Axis, direction: float, seconds: float, *, velocity_m_per_s: float) -> Command:
        """Go along an axis for a time, as long as this program says so again and again."""
        return self._now(self._stage.jog(axis, direction, seconds, velocity_m_per_s=velocity_m_per_s))

    def follow(
        self,
        scenario: str | None = None,
        *,
        segments: Sequence[Mapping[str, Any]] | None = None,
        table_csv: str | None = None,
        velocity_m_per_s: float = 0.5e-3,
        acceleration_m_per_s2: float = 0.5,
        jerk_m_per_s3: float = 300.0,
        wait: bool = True,
    ) -> Command:
        """Follow the path of a shipped scenario, of segments as in a scenario file, or of a table (the text of a CSV
        file, whose limits are the three below). The stage goes to its first point before.
        """
        return self._now(
            self._stage.follow(
                scenario, segments=segments, table_csv=table_csv, velocity_m_per_s=velocity_m_per_s,
                acceleration_m_per_s2=acceleration_m_per_s2, jerk_m_per_s3=jerk_m_per_s3, wait=wait,
            )
        )  # fmt: skip

    def pause(self) -> Command:
        """Stop on the path, without leaving it."""
        return self._now(self._stage.pause())

    def resume(self) -> Command:
        """Go on along the path."""
        return self._now(self._stage.resume())

    def abort(self) -> Command:
        """End what runs: stop on the path, then hold."""
        return self._now(self._stage.abort())

    def stop(self) -> Command:
        """Stop by the shortest way and hold. Needs no control."""
        return self._now(self._stage.stop())

    def release(self) -> Command:
        """0 V at once, whatever runs; a fault that has to be cleared. Needs no control."""
        return self._now(self._stage.release())

    def park(self) -> Command:
        """Go to the rest pose, then 0 V."""
        return self._now(self._stage.park())

    def clear(self) -> Command:
        """Forget the fault and start the amplifier again."""
        return self._now(self._stage.clear())

    def auto_zero(self) -> Command:
        """Park, home, and go back."""
        return self._now(self._stage.auto_zero())

    def settle_window(self, window_m: float, dwell_s: float) -> Command:
        """In position is: each axis within ``window_m`` of its target for ``dwell_s``."""
        return self._now(self._stage.settle_window(window_m, dwell_s))

    def limits(self, *, velocity_m_per_s: float, acceleration_m_per_s2: float, jerk_m_per_s3: float) -> Command:
        """Of moves that name none, for each axis."""
        return self._now(
            self._stage.limits(
                velocity_m_per_s=velocity_m_per_s, acceleration_m_per_s2=acceleration_m_per_s2,
                jerk_m_per_s3=jerk_m_per_s3,
            )
        )  # fmt: skip

    def take_control(self) -> Command:
        """Be the one who may move the stage. Raises ``RefusedError`` while another is."""
        return self._now(self._stage.take_control())

    def give_control(self) -> Command:
        """Let another have it."""
        return self._now(self._stage.give_control())

    @property
    def status(self) -> Status:
        """Where the stage stood a tenth of a second ago at most."""
        return self._stage.status

    @property
    def description(self) -> dict[str, Any]:
        """What the loop says of itself: stage, controller, bus, period_us, limits, middle_m, ..."""
        return self._stage.description

    def wait_in_position(self, timeout_s: float = 10.0) -> Status:
        """Until the stage is in position. Raises ``StageError`` after ``timeout_s``."""
        return self._now(self._stage.wait_in_position(timeout_s))

    def telemetry(self, *fields: str) -> Iterator[Block]:
        """Blocks of rows as they come, every tick of them: fields such as "reference_m", "estimate_m", "voltage_v"."""
        blocks = self._stage.telemetry(*fields)
        try:
            while True:
                yield self._now(_next(blocks))
        finally:
            self._now(_closed(blocks))

    def capture(
        self, *fields: str, seconds: float, trigger: Trigger | None = None, before_s: float = 0.0,
        timeout_s: float = 60.0,
    ) -> Block:  # fmt: skip
        """Rows of so many seconds, without a gap; with a trigger, from ``before_s`` before it.

        Raises ``StageError`` where rows were lost or the trigger did not come in ``timeout_s``.
        """
        return self._now(
            self._stage.capture(*fields, seconds=seconds, trigger=trigger, before_s=before_s, timeout_s=timeout_s)
        )

    def _now(self, doing: Coroutine[Any, Any, T]) -> T:
        future = asyncio.run_coroutine_threadsafe(doing, self._loop)
        try:
            return future.result()
        except KeyboardInterrupt:
            future.cancel()
            raise

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)
        self._loop.close()


def connect(
    url: str | None = None, token: str | None = None, *, name: str = place.DEFAULT, control: bool = True
) -> Stage:
    """The stage of ``pkxyz serve`` on this machine, or at a URL with the token that it printed.

    ``control``: take control, without which one can only look on. Raises ``NoStageError``.

    >>> with pkxyz_ctrl.connect() as stage:
    ...     stage.move_to(x=1e-6)
    """
    return Stage(connect_async(url, token, name=name, control=control))


async def _next(blocks: Any) -> Block:
    block: Block = await blocks.__anext__()
    return block


async def _closed(blocks: Any) -> None:
    await blocks.aclose()

"""A stage in operation, for asyncio programs; ``pkxyz_ctrl.client.plain`` is the same for programs without."""

import asyncio
from collections.abc import AsyncIterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.client import place
from pkxyz_ctrl.client.connection import FINAL, Connection
from pkxyz_ctrl.client.protocol import Block
from pkxyz_ctrl.client.reply import Command, NoStageError, StageError, Status
from pkxyz_ctrl.client.trigger import Trigger, beginning, column_of

Axis = Literal["x", "y", "z"]


class AsyncStage:
    """A stage in operation. Made by ``connect_async``; lengths are in m, times in s.

    >>> async with pkxyz_ctrl.connect_async() as stage:
    ...     await stage.home()
    ...     await stage.enable()
    ...     await stage.move_to(z=18e-6)
    """

    def __init__(self, url: str, token: str, *, control: bool) -> None:
        self._connection = Connection(url, token)
        self._wants_control = control

    async def __aenter__(self) -> Self:
        try:
            await self._connection.open()
            if self._wants_control:
                await self.take_control()
        except BaseException:
            await self._connection.close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._connection.close()

    async def _done(self, verb: str, wait: bool = True, **arguments: Any) -> Command:
        return await self._connection.done(verb, arguments, wait=wait)

    # -- verbs ---------------------------------------------------------------------------------------------------------

    async def home(self) -> Command:
        """Average the sense offsets at rest, at 0 V."""
        return await self._done("home")

    async def enable(self) -> Command:
        """Close the loop; the stage then holds its rest pose."""
        return await self._done("enable")

    async def disable(self) -> Command:
        """Open the loop: 0 V."""
        return await self._done("disable")

    async def move_to(
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
        limits = _limits(velocity_m_per_s, acceleration_m_per_s2, jerk_m_per_s3)
        return await self._done("move", wait=wait, x_m=x, y_m=y, z_m=z, relative=False, **limits)

    async def move_by(
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
        limits = _limits(velocity_m_per_s, acceleration_m_per_s2, jerk_m_per_s3)
        return await self._done("move", wait=wait, x_m=x, y_m=y, z_m=z, relative=True, **limits)

    async def ended(self, command: Command) -> Command:
        """Wait for the end of what was asked with ``wait=False``. Raises ``AbortedError``."""
        return await self._connection.ended(command)

    async def jog(self, axis: Axis, direction: float, seconds: float, *, velocity_m_per_s: float) -> Command:
        """Go along an axis for a time, as long as this program says so again and again."""
        link, now_s = self._connection, asyncio.get_running_loop().time
        tag, queue = link.asked()
        way = {"axis": axis, "direction": direction, "velocity_m_per_s": velocity_m_per_s}
        await link.say({"do": "jog", "tag": tag, **way})
        (await link.until(queue, ("running", *FINAL))).require_done()
        end_s = now_s() + seconds
        while (left_s := end_s - now_s()) > 0 and queue.empty():
            await link.say({"do": "jog_again"})
            await asyncio.sleep(min(left_s, 0.05))
        await link.say({"do": "jog_end"})
        return (await link.until(queue, FINAL)).require_done()

    async def follow(
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
        source = {"scenario": scenario, "segments": segments, "table": table_csv}
        given: dict[str, Any] = {key: value for key, value in source.items() if value is not None}
        if len(given) != 1:
            raise StageError("give one of scenario, segments and table_csv")
        if table_csv is not None:
            given |= _limits(velocity_m_per_s, acceleration_m_per_s2, jerk_m_per_s3)
        return await self._done("path", wait=wait, **given)

    async def pause(self) -> Command:
        """Stop on the path, without leaving it."""
        return await self._done("pause")

    async def resume(self) -> Command:
        """Go on along the path."""
        return await self._done("resume")

    async def abort(self) -> Command:
        """End what runs: stop on the path, then hold."""
        return await self._done("abort")

    async def stop(self) -> Command:
        """Stop by the shortest way and hold. Needs no control."""
        return await self._done("stop")

    async def release(self) -> Command:
        """0 V at once, whatever runs; a fault that has to be cleared. Needs no control."""
        return await self._done("release")

    async def park(self) -> Command:
        """Go to the rest pose, then 0 V."""
        return await self._done("park")

    async def clear(self) -> Command:
        """Forget the fault and start the amplifier again."""
        return await self._done("clear")

    async def auto_zero(self) -> Command:
        """Park, home, and go back."""
        return await self._done("auto_zero")

    async def settle_window(self, window_m: float, dwell_s: float) -> Command:
        """In position is: each axis within ``window_m`` of its target for ``dwell_s``."""
        return await self._done("settle", window_m=window_m, dwell_s=dwell_s)

    async def limits(self, *, velocity_m_per_s: float, acceleration_m_per_s2: float, jerk_m_per_s3: float) -> Command:
        """Of moves that name none, for each axis."""
        return await self._connection.done("limits", _limits(velocity_m_per_s, acceleration_m_per_s2, jerk_m_per_s3))

    async def save(self, seconds: float = 60.0) -> Command:
        """Keep what was in the last ``seconds``, at most 60, in a folder that the answer names. Needs no control."""
        return await self._done("save", seconds=seconds)

    async def take_control(self) -> Command:
        """Be the one who may move the stage. Raises ``RefusedError`` while another is."""
        return await self._done("take_control")

    async def give_control(self) -> Command:
        """Let another have it."""
        return await self._done("give_control")

    # -- what is so ----------------------------------------------------------------------------------------------------

    @property
    def status(self) -> Status:
        """Where the stage stood a tenth of a second ago at most."""
        assert self._connection.status is not None, "known since we were connected"
        return self._connection.status

    @property
    def description(self) -> dict[str, Any]:
        """What the loop says of itself: stage, controller, bus, period_us, limits, middle_m, ..."""
        return self._connection.description

    async def next_status(self) -> Status:
        """The next one that comes, within a tenth of a second. Raises ``NoStageError``."""
        return await self._connection.next_status()

    async def wait_in_position(self, timeout_s: float = 10.0) -> Status:
        """Until the stage is in position. Raises ``StageError`` after ``timeout_s``."""
        try:
            async with asyncio.timeout(timeout_s):
                while not (await self._connection.next_status()).in_position:
                    pass
        except TimeoutError:
            raise StageError(f"not in position after {timeout_s:g} s: {self.status.words}") from None
        return self.status

    async def telemetry(self, *fields: str) -> AsyncIterator[Block]:
        """Blocks of rows as they come, every tick of them: fields such as "reference_m", "estimate_m", "voltage_v"."""
        link = self._connection
        queue = link.listen()
        tag, answers = link.asked()
        await link.say({"do": "subscribe", "fields": ["tick", *fields], "precision": "f8", "tag": tag})
        try:
            while True:
                if not answers.empty():
                    (await link.until(answers, FINAL)).require_done()
                try:
                    block = await asyncio.wait_for(queue.get(), 0.5)
                except TimeoutError:
                    continue
                if block is None:
                    raise NoStageError("the server has closed the connection")
                if all(field in block.columns for field in fields):  # not those of an earlier wish
                    yield block
        finally:
            link.forget(tag)
            await link.unlisten(queue)

    async def capture(
        self, *fields: str, seconds: float, trigger: Trigger | None = None, before_s: float = 0.0,
        timeout_s: float = 60.0,
    ) -> Block:  # fmt: skip
        """Rows of so many seconds, without a gap; with a trigger, from ``before_s`` before it.

        Raises ``StageError`` where rows were lost or the trigger did not come in ``timeout_s``.
        """
        period_s = self.description["period_us"] * 1e-6
        wanted, before = max(1, round(seconds / period_s)), round(before_s / period_s)
        column = None if trigger is None else column_of(trigger[0])
        asked = tuple(dict.fromkeys([*fields, *([column[0]] if column else [])]))
        rows: dict[str, list[NDArray[np.floating]]] = {}
        begin: int | None = 0 if trigger is None else None
        try:
            async with asyncio.timeout(timeout_s):
                async for block in self.telemetry(*asked):
                    if block.lost and rows:
                        raise StageError("rows were lost, as this program was too slow: ask for fewer fields")
                    for name, values in block.columns.items():
                        rows.setdefault(name, []).append(values)
                    joined = {name: np.concatenate(parts) for name, parts in rows.items()}
                    rows = {name: [values] for name, values in joined.items()}
                    if begin is None and trigger is not None and column is not None:
                        begin = beginning(joined, trigger, column, before)
                    if begin is not None and len(joined["tick"]) >= begin + wanted:
                        cut = {name: values[begin : begin + wanted] for name, values in joined.items()}
                        return Block(int(cut["tick"][0]), cut)
        except TimeoutError:
            raise StageError(f"nothing triggered, or came, in {timeout_s:g} s") from None
        raise NoStageError("the server has closed the connection")


def connect_async(
    url: str | None = None, token: str | None = None, *, name: str = place.DEFAULT, control: bool = True
) -> AsyncStage:
    """The stage of ``pkxyz serve`` on this machine, or at a URL with the token that it printed.

    ``control``: take control, without which one can only look on. Raises ``NoStageError``.
    """
    if url is None:
        found = place.read(name, "server")
        if found is None:
            raise NoStageError(
                f"no server for {name!r} runs on this machine: start `pkxyz serve`, or give url and token"
            )
        url, token = found["url"], token or found["token"]
    url, _, behind = url.partition("#")
    return AsyncStage(url, token or behind, control=control)


def _limits(v: float | None, a: float | None, j: float | None) -> dict[str, float]:
    given = {"velocity_m_per_s": v, "acceleration_m_per_s2": a, "jerk_m_per_s3": j}
    return {key: value for key, value in given.items() if value is not None}

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
from pkxyz_ctrl.client.scan import PATH_ROW, Frames, PathPreview, ScanFrame, limits_of, path_of
from pkxyz_ctrl.client.settings import Metres, Point, StageSettings, who
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
        x: Metres | None = None,
        y: Metres | None = None,
        z: Metres | None = None,
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
        limits = limits_of(velocity_m_per_s, acceleration_m_per_s2, jerk_m_per_s3)
        return await self._done("move", wait=wait, x_m=x, y_m=y, z_m=z, relative=False, **limits)

    async def move_by(
        self,
        x: Metres | None = None,
        y: Metres | None = None,
        z: Metres | None = None,
        *,
        velocity_m_per_s: float | None = None,
        acceleration_m_per_s2: float | None = None,
        jerk_m_per_s3: float | None = None,
        wait: bool = True,
    ) -> Command:
        """Go by a way, in m, from the present target."""
        limits = limits_of(velocity_m_per_s, acceleration_m_per_s2, jerk_m_per_s3)
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
        pixels: int = 0,
        wait: bool = True,
    ) -> Command:
        """Follow the path of a shipped scenario, of segments as in a scenario file, or of a table (the text of a CSV
        file, whose limits are the three below). The stage goes to its first point before. Lines and frames of a raster
        trigger the node's digital outputs, and ``pixels`` of each line.
        """
        limits = limits_of(velocity_m_per_s, acceleration_m_per_s2, jerk_m_per_s3)
        path = path_of(scenario, segments, table_csv, limits)
        return await self._done("path", wait=wait, pixels=pixels or None, **path)

    async def preview(
        self,
        scenario: str | None = None,
        *,
        segments: Sequence[Mapping[str, Any]] | None = None,
        table_csv: str | None = None,
        velocity_m_per_s: float = 0.5e-3,
        acceleration_m_per_s2: float = 0.5,
        jerk_m_per_s3: float = 300.0,
    ) -> PathPreview:
        """What ``follow`` would do: how long it takes, and where it leads. Nothing moves, and it needs no control.
        Raises ``RefusedError`` for what the combs can't follow.
        """
        limits = limits_of(velocity_m_per_s, acceleration_m_per_s2, jerk_m_per_s3)
        return PathPreview.of(await self._connection.preview(path_of(scenario, segments, table_csv, limits)))

    async def trigger_at(
        self, axis: Axis, start_m: Metres, pitch_m: float, count: int, direction: Literal[-1, 0, 1] = 0
    ) -> Command:
        """From now on pulse a digital output of the node, for one period, where the stage passes one of ``count``
        positions along one of its own axes, to larger (1) or smaller (-1) coordinates or both; of 0: no longer.
        """
        where: dict[str, Any] = {"axis": axis, "start_m": start_m, "pitch_m": pitch_m}
        return await self._done("trigger", count=count, direction=direction, **where)

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

    async def settle_window(self, window_m: float, dwell_s: float, sigmas: float | None = None) -> Command:
        """In position is: each axis, ``sigmas`` standard deviations of its estimate included, within ``window_m`` of
        its target for ``dwell_s``.
        """
        return await self._set("settle", window_m=window_m, dwell_s=dwell_s, sigmas=sigmas)

    async def limits(self, *, velocity_m_per_s: float, acceleration_m_per_s2: float, jerk_m_per_s3: float) -> Command:
        """Of moves that name none, for each axis."""
        return await self._set("limits", **limits_of(velocity_m_per_s, acceleration_m_per_s2, jerk_m_per_s3))

    async def set_sample(
        self,
        origin_m: Point | None = None,
        rotation_deg: float | None = None,
        slope_x: float | None = None,
        slope_y: float | None = None,
        scale: tuple[float, float, float] | None = None,
    ) -> Command:
        """Where the sample lies on the stage; what is left out stays. Nothing moves: all targets and positions are in
        the sample's coordinates from now on.
        """
        turn = {"rotation_deg": rotation_deg, "slope_x": slope_x, "slope_y": slope_y}
        return await self._set("sample", origin_m=origin_m, scale=scale, **turn)

    async def tilt_plane(self, a_m: Point, b_m: Point, c_m: Point) -> Command:
        """Tilt the sample's axes so that these three points, in present coordinates, are at z = 0."""
        return await self._set("tilt_plane", points_m=[list(a_m), list(b_m), list(c_m)])

    async def name_position(
        self, name: str, x: Metres | None = None, y: Metres | None = None, z: Metres | None = None
    ) -> Command:
        """Give a place a name, in m; axes left out are where the target is. Nothing moves."""
        return await self._set("name_position", name=name, x_m=x, y_m=y, z_m=z)

    async def forget_position(self, name: str) -> Command:
        """It has no name any more."""
        return await self._set("forget_position", name=name)

    async def move_to_position(self, name: str, *, wait: bool = True) -> Command:
        """Go to a place that has a name."""
        return await self._done("move", wait=wait, to=name)

    async def restore_settings(self, digest: str) -> Command:
        """Go back to the settings of a digest of ``settings.history``, or of its beginning."""
        return await self._set("restore", digest=digest)

    async def change_law(self, controller: str | None = None, *, toml: str | None = None) -> Command:
        """Another law, a shipped one or that of the text of a controller file, taken over without a jump. Refused while
        the stage moves. Its design may take some seconds.
        """
        return await self._done("law", controller=controller, toml=toml)

    async def quiet_holds(self, on: bool = True) -> Command:
        """Less noise and less rejection while the set-point stands; or no longer."""
        return await self._done("quiet", on=on)

    async def _set(self, verb: str, **arguments: Any) -> Command:
        return await self._done(verb, who=who(), **arguments)

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
    def settings(self) -> StageSettings:
        """Axes of the sample, named positions, limits of moves, settle window, and their history."""
        return StageSettings.of(self._connection.settings)

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
        queue, (tag, answers) = link.listen(), link.asked()
        await link.say({"do": "subscribe", "fields": ["tick", *fields], "precision": "f8", "tag": tag})
        try:
            while True:
                if not answers.empty():
                    (await link.until(answers, FINAL)).require_done()
                try:
                    async with asyncio.timeout(0.5):  # ``wait_for`` forgets to be cancelled where a block comes then
                        block = await queue.get()
                except TimeoutError:
                    continue
                if block is None:
                    raise NoStageError("the server has closed the connection")
                if all(field in block.columns for field in fields):  # not those of an earlier wish
                    yield block
        finally:
            link.forget(tag)
            await link.unlisten(queue)

    async def frames(
        self,
        scenario: str | None = None,
        *,
        segments: Sequence[Mapping[str, Any]] | None = None,
        fields: Sequence[str] = ("reference_m", "estimate_m"),
        pixels: int = 128,
    ) -> AsyncIterator[ScanFrame]:
        """Follow a scan, whose pixels trigger the node's digital outputs, and give each of its frames as soon as its
        last line is over. Raises ``StageError`` for a path without lines, or where rows were lost.
        """
        path = path_of(scenario, segments, None, {})
        shown = await self._connection.preview(path)
        if not shown["lines"]:
            raise StageError(f"{shown['name']} has no lines: frames are those of a raster")
        backward = np.array(shown["backward"]) != shown["backward"][0]
        frames = Frames([(a, b, n) for a, b, n in shown["lines"]], backward.tolist(), pixels)
        command: Command | None = None
        async for block in self.telemetry(PATH_ROW, *fields):
            if command is None:  # now that we listen
                command = await self._done("path", wait=False, pixels=pixels, **path)
                continue
            if block.lost:
                raise StageError("rows were lost, as this program was too slow: ask for fewer fields")
            done = frames.take(block, fields)
            for frame in done:
                yield frame
            if done and done[-1].number == frames.count - 1:
                await self.ended(command)
                return
            if command.answers is not None and not command.answers.empty():
                await self.ended(command)

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
        if (found := place.read(name, "server")) is None:
            words = f"no server for {name!r} runs on this machine: start `pkxyz serve`, or give url and token"
            raise NoStageError(words)
        url, token = found["url"], token or found["token"]
    url, _, behind = url.partition("#")
    return AsyncStage(url, token or behind, control=control)

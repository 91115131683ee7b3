"""A stage in operation, for programs without asyncio: ``AsyncStage``, each call waiting for its end."""

import asyncio
import functools
import threading
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Mapping, Sequence
from concurrent.futures import Future
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

from pkxyz_ctrl.client import place
from pkxyz_ctrl.client.protocol import Block
from pkxyz_ctrl.client.reply import Status
from pkxyz_ctrl.client.scan import ScanFrame
from pkxyz_ctrl.client.settings import StageSettings
from pkxyz_ctrl.client.stage import AsyncStage, connect_async

P = ParamSpec("P")
T = TypeVar("T")


def _waited(verb: Callable[Concatenate[AsyncStage, P], Coroutine[Any, Any, T]]) -> Callable[Concatenate["Stage", P], T]:
    """A method of ``Stage`` from one of ``AsyncStage``: the same arguments and words, and its end is waited for."""

    @functools.wraps(verb)
    def waiting(stage: "Stage", /, *args: P.args, **kwargs: P.kwargs) -> T:
        return stage._now(verb(stage._stage, *args, **kwargs))

    waiting.__module__, waiting.__qualname__ = __name__, f"Stage.{verb.__name__}"
    return waiting


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

    home = _waited(AsyncStage.home)
    enable = _waited(AsyncStage.enable)
    disable = _waited(AsyncStage.disable)
    move_to = _waited(AsyncStage.move_to)
    move_by = _waited(AsyncStage.move_by)
    ended = _waited(AsyncStage.ended)
    jog = _waited(AsyncStage.jog)
    follow = _waited(AsyncStage.follow)
    preview = _waited(AsyncStage.preview)
    trigger_at = _waited(AsyncStage.trigger_at)
    pause = _waited(AsyncStage.pause)
    resume = _waited(AsyncStage.resume)
    abort = _waited(AsyncStage.abort)
    stop = _waited(AsyncStage.stop)
    release = _waited(AsyncStage.release)
    park = _waited(AsyncStage.park)
    clear = _waited(AsyncStage.clear)
    auto_zero = _waited(AsyncStage.auto_zero)
    settle_window = _waited(AsyncStage.settle_window)
    limits = _waited(AsyncStage.limits)
    set_sample = _waited(AsyncStage.set_sample)
    tilt_plane = _waited(AsyncStage.tilt_plane)
    name_position = _waited(AsyncStage.name_position)
    forget_position = _waited(AsyncStage.forget_position)
    move_to_position = _waited(AsyncStage.move_to_position)
    restore_settings = _waited(AsyncStage.restore_settings)
    change_law = _waited(AsyncStage.change_law)
    quiet_holds = _waited(AsyncStage.quiet_holds)
    save = _waited(AsyncStage.save)
    take_control = _waited(AsyncStage.take_control)
    give_control = _waited(AsyncStage.give_control)
    next_status = _waited(AsyncStage.next_status)
    wait_in_position = _waited(AsyncStage.wait_in_position)
    capture = _waited(AsyncStage.capture)

    @property
    def status(self) -> Status:
        """Where the stage stood a tenth of a second ago at most."""
        return self._stage.status

    @property
    def settings(self) -> StageSettings:
        """Axes of the sample, named positions, limits of moves, settle window, and their history."""
        return self._stage.settings

    @property
    def description(self) -> dict[str, Any]:
        """What the loop says of itself: stage, controller, bus, period_us, limits, middle_m, ..."""
        return self._stage.description

    def telemetry(self, *fields: str) -> Iterator[Block]:
        """Blocks of rows as they come, every tick of them: fields such as "reference_m", "estimate_m", "voltage_v"."""
        blocks = self._stage.telemetry(*fields)
        try:
            while True:
                yield self._now(_next(blocks))
        finally:
            self._now(_closed(blocks))

    def frames(
        self,
        scenario: str | None = None,
        *,
        segments: Sequence[Mapping[str, Any]] | None = None,
        fields: Sequence[str] = ("reference_m", "estimate_m"),
        pixels: int = 128,
    ) -> Iterator[ScanFrame]:
        """Follow a scan and give each of its frames as soon as its last line is over."""
        frames = self._stage.frames(scenario, segments=segments, fields=fields, pixels=pixels)
        try:
            while (frame := self._now(_next_if_any(frames))) is not None:
                yield frame
        finally:
            self._now(_closed(frames))

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


def begun_in(stage: Stage, of: Callable[[AsyncStage], Coroutine[Any, Any, T]]) -> "Future[T]":
    """Begin something with the ``AsyncStage`` behind a ``Stage``, where that lives, and do not wait for its end."""
    return asyncio.run_coroutine_threadsafe(of(stage._stage), stage._loop)


async def _next_if_any(frames: AsyncIterator[ScanFrame]) -> ScanFrame | None:
    return await anext(frames, None)


async def _next(blocks: Any) -> Block:
    block: Block = await blocks.__anext__()
    return block


async def _closed(blocks: Any) -> None:
    await blocks.aclose()

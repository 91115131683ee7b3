"""One client's connection to the server of a stage in operation: asks, and hands on what comes back."""

import asyncio
import contextlib
import itertools
import json
from collections.abc import Sequence
from typing import Any

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.typing import Subprotocol

from pkxyz_ctrl.client.protocol import SUBPROTOCOL, TOKEN_PREFIX, Block, unpacked
from pkxyz_ctrl.client.reply import Command, NoStageError, Status

FINAL = ("done", "refused", "aborted")
_BLOCKS_MOST = 256
_GONE = "the server has closed the connection"


class Connection:
    """``status``, ``settings``: the newest; ``description``: what the loop says of itself."""

    def __init__(self, url: str, token: str) -> None:
        self._url, self._token = url, token
        self._socket: ClientConnection | None = None
        self._tags = itertools.count(1)
        self._waiting: dict[int, asyncio.Queue[Command]] = {}
        self._status_came = asyncio.Condition()
        self._blocks: list[asyncio.Queue[Block | None]] = []
        self._hearing: asyncio.Task[None] | None = None
        self._is_gone = False
        self.status: Status | None = None
        self.description: dict[str, Any] = {}
        self.settings: dict[str, Any] = {}
        self._previews: dict[int, dict[str, Any]] = {}

    async def open(self) -> None:
        """Connect, and wait for the first status. Raises ``NoStageError``."""
        address = self._url.replace("http", "ws", 1).rstrip("/") + "/stage"
        offered = [Subprotocol(SUBPROTOCOL), Subprotocol(TOKEN_PREFIX + self._token)]
        try:
            self._socket = await connect(address, subprotocols=offered, max_size=None, proxy=None, open_timeout=10)
        except InvalidStatus as error:
            raise NoStageError(
                f"{self._url} does not let us in ({error.response.status_code}): its token is a new one at each start"
            ) from None
        except (OSError, InvalidHandshake, TimeoutError) as error:
            raise NoStageError(f"nobody answers at {self._url} ({error}): is `pkxyz serve` running?") from None
        self._hearing = asyncio.create_task(self._hear(self._socket))
        await self.next_status()

    async def close(self) -> None:
        """Leave."""
        if self._socket is not None:
            await self._socket.close()
        if self._hearing is not None:
            await asyncio.wait([self._hearing])

    async def done(self, verb: str, arguments: dict[str, Any], *, wait: bool = True) -> Command:
        """Ask, and wait for the end, or else until it runs. Raises ``RefusedError`` and ``AbortedError``."""
        tag, queue = self.asked()
        told = {key: value for key, value in arguments.items() if value is not None}
        await self.say({"do": verb, "tag": tag, **told})
        command = await self.until(queue, FINAL if wait else ("running", *FINAL))
        command.answers = None if wait else queue
        return command.require_done()

    async def ended(self, command: Command) -> Command:
        """The end of one that was not waited for. Raises ``RefusedError`` and ``AbortedError``."""
        if command.answers is None or command.state in FINAL:
            return command.require_done()
        return (await self.until(command.answers, FINAL)).require_done()

    async def preview(self, path: dict[str, Any]) -> dict[str, Any]:
        """A path before it is followed. Raises ``RefusedError``."""
        tag, queue = self.asked()
        await self.say({"do": "preview", "tag": tag, **path})
        (await self.until(queue, FINAL)).require_done()
        self.forget(tag)
        return self._previews.pop(tag)

    def asked(self) -> tuple[int, asyncio.Queue[Command]]:
        """A tag for a message, and where answers to it will be."""
        tag = next(self._tags)
        self._waiting[tag] = asyncio.Queue()
        if self._is_gone:
            self._waiting[tag].put_nowait(Command(None, "", "gone"))
        return tag, self._waiting[tag]

    async def until(self, queue: asyncio.Queue[Command], states: Sequence[str]) -> Command:
        """The first answer in one of the states. Raises ``NoStageError``."""
        while True:
            command = await queue.get()
            if command.state == "gone":
                raise NoStageError(_GONE)
            if command.state in states:
                return command

    def forget(self, tag: int | None) -> None:
        """No further answers to that one."""
        if tag is not None:
            self._waiting.pop(tag, None)

    async def say(self, message: dict[str, Any]) -> None:
        """Send a message. Raises ``NoStageError``."""
        assert self._socket is not None, "within `with`"
        try:
            await self._socket.send(json.dumps(message))
        except ConnectionClosed:
            raise NoStageError(_GONE) from None

    async def next_status(self) -> Status:
        """The next one that comes."""
        try:
            async with asyncio.timeout(10.0), self._status_came:
                if not self._is_gone:
                    await self._status_came.wait()
        except TimeoutError:
            raise NoStageError(f"{self._url} has said nothing for 10 s") from None
        if self.status is None or self._is_gone:
            raise NoStageError(_GONE)
        return self.status

    def listen(self) -> asyncio.Queue[Block | None]:
        """Where blocks of telemetry will be from now on; None after the last."""
        queue: asyncio.Queue[Block | None] = asyncio.Queue(_BLOCKS_MOST)
        self._blocks.append(queue)
        return queue

    async def unlisten(self, queue: asyncio.Queue[Block | None]) -> None:
        """No more of them."""
        self._blocks.remove(queue)
        if not self._blocks:
            with contextlib.suppress(NoStageError):
                await self.say({"do": "subscribe", "fields": []})

    async def _hear(self, socket: ClientConnection) -> None:
        try:
            async for said in socket:
                if isinstance(said, bytes):
                    self._take_block(unpacked(said))
                else:
                    await self._take(json.loads(said))
        except ConnectionClosed:
            pass
        finally:
            self._is_gone = True  # whoever asks from now on is told so, whatever ended it
            async with self._status_came:
                self._status_came.notify_all()
            for queue in self._waiting.values():
                queue.put_nowait(Command(None, "", "gone"))
            for blocks in self._blocks:
                with contextlib.suppress(asyncio.QueueFull):
                    blocks.put_nowait(None)

    def _take_block(self, block: Block) -> None:
        for queue in self._blocks:
            if queue.full():
                queue.get_nowait()
            queue.put_nowait(block)

    async def _take(self, message: dict[str, Any]) -> None:
        if "status" in message:
            self.status = Status.of(message["status"])
            async with self._status_came:
                self._status_came.notify_all()
        elif "answer" in message:
            answer = message["answer"]
            queue = self._waiting.get(answer["tag"]) if isinstance(answer.get("tag"), int) else None
            if queue is not None:
                queue.put_nowait(Command(answer["id"], answer["verb"], answer["state"], answer["words"]))
                if answer["state"] in FINAL:
                    self.forget(answer["tag"])
        elif "preview" in message:
            tag = message["preview"]["tag"]
            if tag in self._waiting:
                self._previews[tag] = message["preview"]
                self._waiting[tag].put_nowait(Command(None, "preview", "done"))
        elif "settings" in message:
            self.settings = message["settings"]
        elif "hello" in message:
            self.description = message["hello"]

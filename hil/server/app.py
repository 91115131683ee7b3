"""The server's outside: HTTP for the page, one WebSocket a client. Nothing gets in without the token of this start."""

import asyncio
import contextlib
import hmac
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.responses import PlainTextResponse
from starlette.routing import Mount, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from hil.server.client import Client
from hil.server.designing import give_up
from hil.server.desk import Desk
from hil.server.messages import is_urgent
from pkxyz_ctrl.client.protocol import SUBPROTOCOL, TEXT_MAX_BYTES, TOKEN_PREFIX

PAGE = Path(__file__).parent / "page"
CLIENTS_MOST = 32
_ASKED_MOST = 1000
"""Messages of a client that wait for those before them."""
_LOOK_S = 1 / 60
"""Between two looks for answers while somebody waits for one; else it looks whenever it shows."""
_SHOW_EACH, _STATUS_EACH = 2, 6
_KEEP_S = 0.2
_ROWS_MOST = 2000
_LOG = logging.getLogger(__name__)
_HEADERS = [
    (b"content-security-policy", b"default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:"),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cache-control", b"no-cache"),
]


class OnlyOurHost:
    """Answers only under the names that this server is meant to have: a page of another host can't reach it by a name
    that was made to point here.
    """

    def __init__(self, app: ASGIApp, hosts: frozenset[str]) -> None:
        self._app, self._hosts = app, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = dict(scope["headers"])
        host = headers.get(b"host", b"").decode("latin-1")
        origin = headers.get(b"origin")
        ours = {f"http://{name}" for name in self._hosts}
        if host not in self._hosts or (origin is not None and origin.decode("latin-1") not in ours):
            if scope["type"] == "websocket":
                await WebSocket(scope, receive, send).close(4403)
            else:
                await PlainTextResponse("not from here", 403)(scope, receive, send)
            return
        if scope["type"] == "websocket":
            await self._app(scope, receive, send)
            return

        async def with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *_HEADERS]
            await send(message)

        await self._app(scope, receive, with_headers)


def app_of(desk: Desk, token: str, hosts: frozenset[str]) -> Starlette:
    """``hosts``: names with port under which it answers."""

    async def talk(socket: WebSocket) -> None:
        offered = socket.scope.get("subprotocols", [])
        tokens = [name.removeprefix(TOKEN_PREFIX) for name in offered if name.startswith(TOKEN_PREFIX)]
        if SUBPROTOCOL not in offered or not any(hmac.compare_digest(g.encode(), token.encode()) for g in tokens):
            await socket.close(4401)
            return
        if len(desk.clients) >= CLIENTS_MOST:
            await socket.close(4429)
            return
        await socket.accept(SUBPROTOCOL)
        client = desk.enter()
        asked: asyncio.Queue[tuple[str, int]] = asyncio.Queue(_ASKED_MOST)
        tasks = [asyncio.create_task(_speak(socket, client)), asyncio.create_task(_serve(desk, client, asked))]
        try:
            while not client.is_hopeless:
                message = await socket.receive()
                if message["type"] == "websocket.disconnect":
                    break
                text = message.get("text")
                if text is None or len(text) > TEXT_MAX_BYTES:
                    break
                if is_urgent(text):
                    await desk.ask(client, text)
                elif asked.full():
                    break
                else:
                    asked.put_nowait((text, desk.stops))
        except (WebSocketDisconnect, RuntimeError):
            pass
        finally:
            for task in tasks:
                task.cancel()
            desk.leave(client)
            with contextlib.suppress(Exception):
                await socket.close()

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        tasks = [asyncio.create_task(go_rounds(desk)), asyncio.create_task(keep_faults(desk))]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            give_up()  # the combs are at 0 V once the server has ended

    return Starlette(
        routes=[WebSocketRoute("/stage", talk), Mount("/", StaticFiles(directory=PAGE, html=True))],
        middleware=[Middleware(OnlyOurHost, hosts=hosts)],
        lifespan=lifespan,
    )


async def _serve(desk: Desk, client: Client, asked: asyncio.Queue[tuple[str, int]]) -> None:
    """One after another: some take seconds, and a stop does not wait for them."""
    try:
        while True:
            text, stops = await asked.get()
            await desk.ask(client, text, stops)
    except Exception:
        client.is_hopeless = True
        raise


async def _speak(socket: WebSocket, client: Client) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while True:
            said = await client.next_said()
            if isinstance(said, bytes):
                await socket.send_bytes(said)
            else:
                await socket.send_text(said)


async def go_rounds(desk: Desk) -> None:
    """Look, show and tell again and again, in one awakening as far as possible."""
    look, show, tell = (
        Round("look for answers", desk.look),
        Round("show telemetry", lambda: desk.show_telemetry(_ROWS_MOST)),
        Round("tell where the stage is", lambda: desk.tell_status(is_in_turn=True)),
    )
    passed = 0
    while True:
        await look.go()
        if passed % _SHOW_EACH == 0:
            await show.go()
        if passed % _STATUS_EACH == 0:
            await tell.go()
        step = 1 if desk.is_waited_for else _SHOW_EACH - passed % _SHOW_EACH
        await _next_period(_LOOK_S, step)
        passed += step


async def keep_faults(desk: Desk) -> None:
    """It takes its time, and nobody waits for it."""
    keep = Round("keep what was around a fault", desk.keep_fault)
    while True:
        await keep.go()
        await asyncio.sleep(_KEEP_S)


class Round:
    """What is done again and again. Where it fails it is told with its trace, once until it succeeds, and ends
    nothing.
    """

    def __init__(self, what: str, work: Callable[[], Awaitable[None] | None]) -> None:
        self._what, self._work = what, work
        self._failed = False

    async def go(self) -> None:
        """Once."""
        try:
            if (slow := self._work()) is not None:
                await slow
            self._failed = False
        except Exception:
            if not self._failed:
                _LOG.exception("the server could not %s, and goes on trying", self._what)
            self._failed = True


async def _next_period(period_s: float, count: int) -> None:
    """Until the loop's clock has passed so many whole periods."""
    await asyncio.sleep(count * period_s - asyncio.get_running_loop().time() % period_s)

"""The server of ``pkxyz serve``: over what was started beside it, until SIGINT or SIGTERM."""

import asyncio
import contextlib
import signal
import sys
from collections.abc import Callable, Generator

import uvicorn
import uvloop

from hil.server.app import app_of
from hil.server.beside import Beside, Served, in_url
from hil.server.desk import Desk
from hil.server.link import Link
from hil.server.paths import Planner
from hil.server.stored_settings import SettingsStore, default_folder
from pkxyz_ctrl.client.protocol import TEXT_MAX_BYTES

_LOOKS_S = 0.2
_LOOPBACK = ("127.0.0.1", "localhost", "::1")


def serve(served: Served, beside: Beside, tell: Callable[[str], object]) -> int:
    """Serve until SIGINT or SIGTERM; ``tell`` is told where. Returns an exit code. Raises ``ConfigError``."""
    link = Link(served.name)
    planner = Planner(served.stage, served.controller, served.bus)
    store = SettingsStore((served.settings or default_folder()) / f"{served.name}.settings.jsonl")
    desk = Desk(link, planner, asyncio.to_thread, served.saves, store)
    hosts = frozenset(f"{in_url(host)}:{beside.port}" for host in {*_LOOPBACK, served.host})
    tell(f"{beside.url}#{beside.token}")
    config = uvicorn.Config(
        app_of(desk, beside.token, hosts), log_level="error", access_log=False, ws_max_size=TEXT_MAX_BYTES,
        ws_max_queue=8, ws_ping_interval=10, ws_ping_timeout=30, limit_concurrency=128,
        timeout_graceful_shutdown=1, lifespan="on", ws_per_message_deflate=False,  # costs more than it carries
    )  # fmt: skip
    return _run(_Server(config), beside)


class _Server(uvicorn.Server):
    """Signals end it through ``should_exit`` alone: uvicorn's own would be raised anew inside its task."""

    @contextlib.contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Nothing is captured: ``_run`` does."""
        yield


def _run(server: uvicorn.Server, beside: Beside) -> int:
    async def main() -> str | None:
        def end() -> None:
            server.should_exit = True

        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, end)
        serving = asyncio.create_task(server.serve([beside.bound]))
        ended = None
        while not serving.done() and ended is None:
            await asyncio.sleep(_LOOKS_S)
            ended = beside.ended
        server.should_exit = True
        await serving
        return ended

    ended = uvloop.run(main())
    if ended is not None:
        print(f"pkxyz: the {ended} has ended by itself; the combs are at 0 V", file=sys.stderr)
        return 1
    return 0

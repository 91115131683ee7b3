"""``pkxyz serve``: amplifier and plant, loop and server, each a process of its own, started and ended together."""

import asyncio
import contextlib
import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path

import tomlkit
import uvicorn
import uvloop

from hil.lanes.standstill import STANDSTILL_US
from hil.server.app import app_of
from hil.server.desk import Desk
from hil.server.link import Link
from hil.server.paths import Planner
from hil.server.stored_settings import SettingsStore, default_folder
from pkxyz_ctrl.client import place
from pkxyz_ctrl.client.protocol import TEXT_MAX_BYTES
from pkxyz_ctrl.config.files import ConfigError, find
from pkxyz_ctrl.config.refused import reason

_ENDS_S, _LOOKS_S = 3.0, 0.2
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
SENT_AHEAD_BYTES = 32_768
"""That the system keeps for one who reads slowly: a third of a second of the page's telemetry. With the megabytes that
it takes otherwise such a one is told half a minute later what became of a command, and its pings come too late.
"""


@dataclass(frozen=True)
class Served:
    """What to serve, by names or files."""

    name: str
    stage: str
    controller: str
    plant: str
    bus: str
    on_silence: str
    silence_s: float
    saves: Path
    host: str
    port: int
    is_simulated: bool
    """whether amplifier and plant are to be started, too"""
    settings: Path | None = None
    """folder in which they are kept; None: the user's"""
    report: Path | None = None
    """on the amplifier"""
    native: bool | None = None
    """whether the loop is the one in C; None: if it is there"""


class _Children:
    """The processes beside the server. ``ended`` names one that ended by itself."""

    def __init__(self) -> None:
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, what: str, *arguments: str) -> int:
        """Start ``pkxyz`` with arguments; Ctrl-C reaches the server alone, which ends the others in their order."""
        process = subprocess.Popen(
            [sys.executable, "-m", "hil", *arguments], stdout=subprocess.DEVNULL, start_new_session=True
        )
        self._processes[what] = process
        return process.pid

    @property
    def ended(self) -> str | None:
        """Which has ended."""
        return next((what for what, process in self._processes.items() if process.poll() is not None), None)

    def end(self) -> None:
        """The loop first, so that the combs are at 0 V while the amplifier still listens."""
        for what in ("loop", "plant"):
            process = self._processes.get(what)
            if process is not None and process.poll() is None:
                process.send_signal(signal.SIGTERM)
                try:
                    process.wait(_ENDS_S)
                except subprocess.TimeoutExpired:
                    process.kill()


def serve(served: Served, tell: Callable[[str], object]) -> int:
    """Serve until SIGINT or SIGTERM; ``tell`` is told where. Returns an exit code. Raises ``ConfigError``."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # while it starts, too, nothing is left behind
    children = _Children()
    is_new = place.read(served.name, "loop") is None
    if place.read(served.name, "server") is not None:
        raise ConfigError(f"a server for {served.name!r} is running already; give another --name, or end that one")
    bound = _bound(served.host, served.port)
    port = int(bound.getsockname()[1])
    token = secrets.token_urlsafe(24)
    try:
        if is_new:
            _start(children, served)
        link = Link(served.name)
        planner = Planner(served.stage, served.controller, served.bus)
        store = SettingsStore((served.settings or default_folder()) / f"{served.name}.settings.jsonl")
        desk = Desk(link, planner, asyncio.to_thread, served.saves, store)
        hosts = frozenset(f"{_in_url(host)}:{port}" for host in {*_LOOPBACK, served.host})
        url = f"http://{_in_url(served.host)}:{port}/"
        place.write(served.name, "server", {"pid": os.getpid(), "url": url, "token": token})
        tell(f"{url}#{token}")
        config = uvicorn.Config(
            app_of(desk, token, hosts), log_level="error", access_log=False, ws_max_size=TEXT_MAX_BYTES,
            ws_max_queue=8, ws_ping_interval=10, ws_ping_timeout=30, limit_concurrency=128,
            timeout_graceful_shutdown=1, lifespan="on", ws_per_message_deflate=False,  # costs more than it carries
        )  # fmt: skip
        server = _Server(config)
        return _run(server, bound, children)
    except KeyboardInterrupt:
        return 0
    finally:
        place.forget(served.name, "server")
        children.end()
        if not is_new:
            _end_loop(served.name)
        place.forget(served.name, "plant")
        bound.close()


class _Server(uvicorn.Server):
    """Signals end it through ``should_exit`` alone: uvicorn's own would be raised anew inside its task."""

    @contextlib.contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Nothing is captured: ``_run`` does."""
        yield


def _run(server: uvicorn.Server, bound: socket.socket, children: _Children) -> int:
    async def main() -> str | None:
        def end() -> None:
            server.should_exit = True

        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, end)
        serving = asyncio.create_task(server.serve([bound]))
        ended = None
        while not serving.done() and ended is None:
            await asyncio.sleep(_LOOKS_S)
            ended = children.ended
        server.should_exit = True
        await serving
        return ended

    ended = uvloop.run(main())
    if ended is not None:
        print(f"pkxyz: the {ended} has ended by itself; the combs are at 0 V", file=sys.stderr)
        return 1
    return 0


def _start(children: _Children, served: Served) -> None:
    common = ["--bus", served.bus, "--stage", served.stage]
    if (left := place.read(served.name, "plant")) is not None:  # of a server that was killed before it had a loop
        os.kill(left["pid"], signal.SIGTERM)
    if served.is_simulated:
        pid = children.start("plant", "plant", *common, "--plant", served.plant)
        place.write(served.name, "plant", {"pid": pid})
    children.start(
        "loop", "operate", *common, "--controller", served.controller, "--name", served.name, "--on-silence",
        served.on_silence, "--silence-s", str(served.silence_s),
        *(("--report", str(served.report)) if served.report is not None else ()),
        *(("--native" if served.native else "--no-native",) if served.native is not None else ()),
    )  # fmt: skip


def bus_of_its_own(name: str, shipped: str, standstill_us: int = STANDSTILL_US) -> str:
    """A shipped bus among processes, with a folder that no other stage uses: the file of it. With ``standstill_us`` 0
    in real time.
    """
    folder = place.folder() / f"{name}.wire"
    bus = tomlkit.parse(find("buses", shipped).read_text(encoding="utf-8"))
    bus["can"] |= {"channel": str(folder), "standstill_max_us": standstill_us}  # type: ignore[operator]
    file = place.folder() / f"{name}.bus.toml"
    file.write_text(tomlkit.dumps(bus), encoding="utf-8")
    return str(file)


def _end_loop(name: str) -> None:
    """Of a server before this one: what it started ends with this one."""
    for kind in ("loop", "plant"):
        found = place.read(name, kind)
        if found is None:
            continue
        os.kill(found["pid"], signal.SIGTERM)
        end_s = time.monotonic() + _ENDS_S
        while place.read(name, kind) is not None and time.monotonic() < end_s:
            time.sleep(0.02)


def _bound(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    bound = socket.socket(family, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SENT_AHEAD_BYTES)  # of every connection that is accepted
    try:
        bound.bind((host, port))
        bound.listen(128)  # whoever is told the address may connect at once, and waits until the server is there
    except OSError as error:
        bound.close()
        raise ConfigError(f"--port {port}: {reason(error)}; give another, or 0 for any that is free") from None
    return bound


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host

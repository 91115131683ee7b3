"""What runs beside a server: amplifier and plant, and the loop, each a process, started before it and ended after it.

They take longest until a stage lives, so they are begun first: this loads nothing that the server alone needs.
"""

import contextlib
import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tomlkit

from hil.lanes.standstill import STANDSTILL_US
from pkxyz_ctrl.client import place
from pkxyz_ctrl.config.files import ConfigError, find
from pkxyz_ctrl.config.refused import reason

SENT_AHEAD_BYTES = 32_768
"""That the system keeps for one who reads slowly: a third of a second of the page's telemetry. With the megabytes that
it takes otherwise such a one is told half a minute later what became of a command, and its pings come too late.
"""
_ENDS_S = 3.0


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


class Beside:
    """The processes beside a server, and where it is found: ``url`` and ``token``, which is another at each start;
    ``bound`` listens there already. ``ended`` names a process that ended by itself. Raises ``ConfigError`` where it
    can't be there.
    """

    def __init__(self, host: str, port: int) -> None:
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self.bound = _bound(host, port)
        self.port = int(self.bound.getsockname()[1])
        self.url = f"http://{in_url(host)}:{self.port}/"
        self.token = secrets.token_urlsafe(24)

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


@contextlib.contextmanager
def started(served: Served) -> Iterator[Beside]:
    """All that is beside a server while it serves, unless a loop of that name runs already; in the end nothing is left
    of it, and of a loop that was found neither. SIGTERM is as Ctrl-C from here on. Raises ``ConfigError``, and has
    started nothing then.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # while it starts, too, nothing is left behind
    is_new = place.read(served.name, "loop") is None
    if place.read(served.name, "server") is not None:
        raise ConfigError(f"a server for {served.name!r} is running already; give another --name, or end that one")
    beside = Beside(served.host, served.port)
    try:
        place.write(served.name, "server", {"pid": os.getpid(), "url": beside.url, "token": beside.token})
        if is_new:
            _start(beside, served)
        yield beside
    finally:
        place.forget(served.name, "server")
        beside.end()
        if not is_new:
            _end_loop(served.name)
        place.forget(served.name, "plant")
        beside.bound.close()


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


def in_url(host: str) -> str:
    """A host's name or address, as it stands in a URL."""
    return f"[{host}]" if ":" in host else host


def _start(beside: Beside, served: Served) -> None:
    common = ["--bus", served.bus, "--stage", served.stage]
    if (left := place.read(served.name, "plant")) is not None:  # of a server that was killed before it had a loop
        os.kill(left["pid"], signal.SIGTERM)
    if served.is_simulated:
        pid = beside.start("plant", "plant", *common, "--plant", served.plant)
        place.write(served.name, "plant", {"pid": pid})
    beside.start(
        "loop", "operate", *common, "--controller", served.controller, "--name", served.name, "--on-silence",
        served.on_silence, "--silence-s", str(served.silence_s),
        *(("--report", str(served.report)) if served.report is not None else ()),
        *(("--native" if served.native else "--no-native",) if served.native is not None else ()),
    )  # fmt: skip


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

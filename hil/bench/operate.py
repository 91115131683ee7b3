"""A stage that is served, as people meet it: how soon there is something to see and a command acts, and what eight who
look on cost.
"""

import asyncio
import contextlib
import json
import os
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hil.bench.rigs.figure import Figure
from hil.bench.rigs.running import running
from hil.lanes.setup import bare_setup
from hil.operate.memory import StageMemory
from hil.operate.setpoints import rows_of
from hil.server.beside import bus_of_its_own
from pkxyz_ctrl.client import place
from pkxyz_ctrl.client.stage import AsyncStage, connect_async
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load

CLIENTS, LOOKS_S, REPEATS = 8, 6.0, 3
FIELDS = ("reference_m", "estimate_m", "voltage_v", "disturbance_n")
"""What the page asks for, 30 times a second."""
MOVES, _PAUSE_S, _CLEAR_M, _WAY_M = 40, 0.06, 10e-6, 100e-9
_NAME = f"bench-{os.getpid()}"  # nobody else's: what bears it is ended here


def operate() -> list[Figure]:
    """Times by the clock, of a simulated stage as it is served; ticks that are missed in real time, at 0 V, so that a
    late one ends nothing.
    """
    return [*asyncio.run(_soon()), *asyncio.run(_unnoticed())]


async def _soon() -> list[Figure]:
    begin_s = time.monotonic()
    with _served() as (url, _):
        async with connect_async(url) as stage:
            while stage.status.activity == "starting":
                await stage.next_status()
            living_s = time.monotonic() - begin_s
            pictures_s = [await _first_picture_s(url) for _ in range(REPEATS)]
            acts_ticks = await _first_set_points(stage)
    return [
        Figure("operate.living", living_s, "s", 5.0, "at most", detail="from starting pkxyz serve to a living stage"),
        Figure("operate.picture", min(pictures_s), "s", 1.0, "at most", sorted(pictures_s)[REPEATS // 2],
               "from connecting to the first block of telemetry"),
        Figure("operate.first_set_point", acts_ticks[round(0.9 * (MOVES - 1))], "ticks", 2.0, "at most",
               acts_ticks[MOVES // 2],
               f"from the one in which a move came to the one that acts on it, 9 of 10; at most {acts_ticks[-1]}"),
    ]  # fmt: skip


async def _unnoticed() -> list[Figure]:
    with _served("--bus", bus_of_its_own(_NAME, "unix_2k", 0)) as (url, server):
        async with connect_async(url) as stage:
            while stage.status.activity == "starting":
                await stage.next_status()
            alone, beside, shares = 0, 0, []
            for _ in range(REPEATS):  # in turn, so that both see the same machine
                alone += (await _looked_on(stage, url, 0, server))[0]
                missed, share = await _looked_on(stage, url, CLIENTS, server)
                beside += missed
                shares.append(share)
    ratio = (beside + 1) / (alone + 1)
    ticks = f"{beside} beside {CLIENTS} clients, {alone} without, in {REPEATS * LOOKS_S:g} s each"
    return [
        Figure("operate.server", 100 * min(shares), "% of a core", 5.0, "at most", 100 * sorted(shares)[REPEATS // 2],
               f"the server with {CLIENTS} clients, 30 blocks a second each"),
        Figure("operate.missed", ratio, "x", 1.1, "at most", detail=f"missed ticks: {ticks}"),
    ]  # fmt: skip


async def _first_picture_s(url: str) -> float:
    begin_s = time.monotonic()
    async with connect_async(url, control=False) as client:
        blocks = client.telemetry(*FIELDS)
        await anext(blocks)
        taken_s = time.monotonic() - begin_s
        await blocks.aclose()  # type: ignore[attr-defined]
    return taken_s


async def _first_set_points(stage: AsyncStage) -> list[int]:
    """How many ticks after the one in which a move was taken the law first saw a row of it, sorted; one move at a time,
    as whoever works by hand asks for them.
    """
    described = place.read(_NAME, "loop")
    assert described is not None
    controller = load("controllers", described["controller"], ControllerConfig)
    bus = load("buses", described["bus"], BusConfig)
    law = bare_setup(described["stage"], "nominal", controller, bus, seed=1, autostart=False).law
    seen_rows = rows_of(law)[0] + 2
    ticks = StageMemory(Path(described["memory"])).reader("ticks")
    await stage.home()
    await stage.enable()
    for n in range(1 + MOVES):
        await stage.move_by(z=_WAY_M if n else _CLEAR_M)
        await asyncio.sleep(_PAUSE_S)
    rows = ticks.before(ticks.newest, ticks.newest - ticks.next)
    await stage.disable()
    moves = np.flatnonzero(np.diff(rows["session"]["commands"].astype(np.int64)))[-MOVES:] + 1
    tick, changed = rows["row"]["tick"], np.diff(rows["row"]["reference_m"][:, 2]) != 0.0
    return sorted(int(tick[n + 1 + np.argmax(changed[n:])]) - seen_rows - int(tick[n]) for n in moves)


async def _looked_on(stage: AsyncStage, url: str, clients: int, server: int) -> tuple[int, float]:
    """Ticks that were missed while so many looked on, and the server's share of a core."""

    async def look() -> None:
        async with connect_async(url, control=False) as client:
            async for _ in client.telemetry(*FIELDS):
                pass

    looking = [asyncio.create_task(look()) for _ in range(clients)]
    await asyncio.sleep(0.5)
    before, used_s, begin_s = (await stage.next_status()).missed_ticks, _processor_s(server), time.monotonic()
    await asyncio.sleep(LOOKS_S)
    share = (_processor_s(server) - used_s) / (time.monotonic() - begin_s)
    missed = (await stage.next_status()).missed_ticks - before
    for task in looking:
        task.cancel()
    await asyncio.gather(*looking, return_exceptions=True)
    return missed, share


def _processor_s(pid: int) -> float:
    """Processor time of a process, user's and system's, in s."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def _served(*more: str) -> Iterator[tuple[str, int]]:
    """Its address, and the server's process."""
    with tempfile.TemporaryDirectory(prefix="pkxyz-bench-") as folder:
        words = ("serve", "--name", _NAME, "--port", "0", "--json", "--saves", folder, "--settings", folder, *more)
        try:
            with running(*words, is_heard=True) as server:
                assert server.stdout is not None
                yield json.loads(server.stdout.readline())["url"], server.pid
        finally:
            for kind in ("loop", "plant"):
                if (found := place.read(_NAME, kind)) is not None:
                    os.kill(found["pid"], signal.SIGKILL)

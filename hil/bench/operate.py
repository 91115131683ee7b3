"""A stage that is served, as people meet it: how soon there is something to see, and what eight who look on cost."""

import asyncio
import contextlib
import json
import os
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from hil.bench.rigs.figure import Figure
from hil.bench.rigs.running import running
from pkxyz_ctrl.client import place
from pkxyz_ctrl.client.stage import AsyncStage, connect_async

CLIENTS, LOOKS_S, REPEATS = 8, 6.0, 3
FIELDS = ("reference_m", "estimate_m", "voltage_v", "disturbance_n")
"""What the page asks for, 30 times a second."""
_NAME = f"bench-{os.getpid()}"  # nobody else's: what bears it is ended here


def operate() -> list[Figure]:
    """Times by the clock, of a simulated stage whose loop ticks at 0 V, so that a late tick ends nothing."""
    return asyncio.run(_measured())


async def _measured() -> list[Figure]:
    begin_s = time.monotonic()
    with _served() as (url, server):
        async with connect_async(url) as stage:
            while stage.status.activity == "starting":
                await stage.next_status()
            living_s = time.monotonic() - begin_s
            pictures_s = [await _first_picture_s(url) for _ in range(REPEATS)]
            alone, beside, shares = 0, 0, []
            for _ in range(REPEATS):  # in turn, so that both see the same machine
                alone += (await _looked_on(stage, url, 0, server))[0]
                missed, share = await _looked_on(stage, url, CLIENTS, server)
                beside += missed
                shares.append(share)
    ratio = (beside + 1) / (alone + 1)
    ticks = f"{beside} beside {CLIENTS} clients, {alone} without, in {REPEATS * LOOKS_S:g} s each"
    return [
        Figure("operate.living", living_s, "s", 5.0, "at most", detail="from starting pkxyz serve to a living stage"),
        Figure("operate.picture", min(pictures_s), "s", 1.0, "at most", sorted(pictures_s)[REPEATS // 2],
               "from connecting to the first block of telemetry"),
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
def _served() -> Iterator[tuple[str, int]]:
    """Its address, and the server's process."""
    with tempfile.TemporaryDirectory(prefix="pkxyz-bench-") as folder:
        words = ("serve", "--name", _NAME, "--port", "0", "--json", "--saves", folder, "--settings", folder)
        try:
            with running(*words, is_heard=True) as server:
                assert server.stdout is not None
                yield json.loads(server.stdout.readline())["url"], server.pid
        finally:
            for kind in ("loop", "plant"):
                if (found := place.read(_NAME, kind)) is not None:
                    os.kill(found["pid"], signal.SIGKILL)

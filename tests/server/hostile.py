"""Hostile clients against `pkxyz serve` itself: ``python tests/server/hostile.py [MESSAGES]``; writes hostile.json.

The stage holds in the middle, in closed loop: once as it is served, where no tick may be missed, and once in real time,
under a law and on a bus that bear a machine which stands still. Eight connections send random messages as fast as they
are taken, others subscribe and never read, others come without a token or from another page. Nobody stops or releases
the stage, which anyone may. Meanwhile one looks on. Reported are what moved, the server's memory, and the ticks missed
in each of five rounds, beside as long with the same clients at a server without a stage; their medians are compared, as
a machine that stands still for a moment spoils a round.
"""

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidStatus

sys.path.append(str(Path(__file__).parents[1] / "rigs"))
from patience import patient_bus, patient_law

from hil.operate.commands import Verb
from pkxyz_ctrl.client.protocol import SUBPROTOCOL, TOKEN_PREFIX
from pkxyz_ctrl.client.stage import AsyncStage, connect_async

ROUNDS, SENDERS, NOT_READING, STRANGERS = 5, 8, 12, 40
FREE = ("stop", "release")  # need no control, and do what they say
MEMORY_MORE_MB, SOME_TICKS = 200.0, 10  # of some 20 000 in a round
REPORT = Path(__file__).with_suffix(".json")
NAME = f"hostile-{os.getpid()}"
BARE, ENDLESS = "--bare", 1 << 60


def random_text(rng: np.random.Generator) -> str:
    """Text, JSON, or something that looks like a wish."""
    words = [v.name.lower() for v in Verb] + ["subscribe", "preview", "take", "", "jog_again", "jog_end", "__class__"]
    values = [0, -1, 1e300, float("nan"), "x", None, True, [], {}, [[[]]], "raster", "../../etc/passwd", 10**400]
    keys = ["x_m", "axis", "direction", "window_m", "scenario", "segments", "fields", "relative", "tag", "precision"]
    kind = rng.integers(4)
    if kind == 0:
        return bytes(rng.integers(32, 127, rng.integers(0, 60)).tolist()).decode()
    message = {keys[rng.integers(len(keys))]: values[rng.integers(len(values))] for _ in range(3)}
    return json.dumps(message | ({"do": words[rng.integers(len(words))]} if kind > 1 else {}))


def resident_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


async def sending(address: str, token: str, count: int, seed: int) -> dict[str, int]:
    """So many messages; comes back where it is thrown out."""
    rng, sent, thrown_out = np.random.default_rng(seed), 0, 0
    while sent < count:
        with contextlib.suppress(ConnectionClosed, OSError, InvalidStatus):
            async with connect(address, subprotocols=[SUBPROTOCOL, TOKEN_PREFIX + token], max_size=None) as socket:  # type: ignore[list-item]
                reading = asyncio.create_task(_read(socket))
                try:
                    while sent < count:
                        text = random_text(rng)
                        if not any(f'"{word}"' in text for word in FREE):
                            await socket.send(text)
                        sent += 1
                        await asyncio.sleep(0)
                finally:
                    reading.cancel()
        thrown_out += sent < count
    return {"sent": sent, "thrown_out": thrown_out}


async def _read(socket: object) -> None:
    with contextlib.suppress(ConnectionClosed):
        async for _ in socket:  # type: ignore[attr-defined]
            pass


async def strangers(address: str) -> int:
    """Without a token, with a wrong one, from another page: how many got in."""
    inside = 0
    for n in range(STRANGERS):
        offered = [SUBPROTOCOL, TOKEN_PREFIX + "x" * (n % 3)]
        origin = "http://example.org" if n % 2 else None
        try:
            async with connect(address, subprotocols=offered, origin=origin) as socket:  # type: ignore[arg-type]
                await asyncio.wait_for(socket.recv(), 1.0)
                inside += 1
        except (InvalidStatus, ConnectionClosed, OSError, TimeoutError):
            pass
    return inside


async def measured(url: str, token: str, server: int, messages: int) -> dict[str, Any]:
    """The stage holds in closed loop, one looks on, the others come; then they go elsewhere; in rounds."""
    address = url.replace("http", "ws", 1).rstrip("/") + "/stage"
    async with connect_async(url, token, control=True) as stage:
        while stage.status.activity == "starting":
            await stage.next_status()
        for verb in (stage.home, stage.enable):
            await verb()
        await stage.move_to(*stage.description["middle_m"])
        at_rest_mb, begun = resident_mb(server), await stage.next_status()
        rounds = [await _round(stage, address, token, server, messages // ROUNDS, n) for n in range(ROUNDS)]
        ended = await stage.next_status()
        return {
            "messages": sum(r["messages"] for r in rounds), "thrown_out": sum(r["thrown_out"] for r in rounds),
            "strangers": ROUNDS * STRANGERS, "strangers_inside": sum(r["strangers_inside"] for r in rounds),
            "not_reading": NOT_READING, "seconds": round(sum(r["seconds"] for r in rounds), 1),
            "activities": sorted(set().union(*(r["activities"] for r in rounds))), "last_fault": ended.last_fault,
            "target_moved_m": float(np.abs(ended.target_m - begun.target_m).max()),
            "position_moved_m": float(np.abs(ended.position_m - begun.position_m).max()),
            "memory_before_mb": round(at_rest_mb, 1), "memory_most_mb": round(max(r["most_mb"] for r in rounds), 1),
            "ticks": round(sum(r["seconds"] for r in rounds) * 1e6 / stage.description["period_us"]),
            "ticks_missed": [r["missed"] for r in rounds],
            "ticks_missed_while_they_were_elsewhere": [r["missed_elsewhere"] for r in rounds],
            "load_average": round(os.getloadavg()[0], 1), "cores": os.cpu_count(),
        }  # fmt: skip


async def _round(
    stage: AsyncStage, address: str, token: str, server: int, messages: int, number: int
) -> dict[str, Any]:
    """So many messages to the server of a stage, then for as long to one that has none."""
    begun, begin_s = await stage.next_status(), time.monotonic()
    activities, most_mb = {begun.activity}, 0.0
    deaf = [await _deaf(address, token) for _ in range(NOT_READING)]
    each, seeds = messages // SENDERS, range(number * SENDERS, (number + 1) * SENDERS)
    senders = asyncio.gather(*(sending(address, token, each, seed) for seed in seeds))
    others = asyncio.create_task(strangers(address))
    while not (senders.done() and others.done()):
        await asyncio.sleep(0.2)
        activities.add(stage.status.activity)
        most_mb = max(most_mb, resident_mb(server))
    sent, inside = await senders, await others
    lasted_s, ended = time.monotonic() - begin_s, await stage.next_status()
    for socket in deaf:
        socket.transport.abort()
    await asyncio.sleep(1.0)
    quiet_from = (await stage.next_status()).missed_ticks
    await _as_busy(lasted_s)
    quiet_to = (await stage.next_status()).missed_ticks
    return {
        "messages": sum(s["sent"] for s in sent), "thrown_out": sum(s["thrown_out"] for s in sent),
        "strangers_inside": inside, "seconds": lasted_s, "activities": activities | {ended.activity},
        "most_mb": most_mb, "missed": ended.missed_ticks - begun.missed_ticks,
        "missed_elsewhere": quiet_to - quiet_from,
    }  # fmt: skip


async def _deaf(address: str, token: str) -> ClientConnection:
    """One that asks for telemetry and takes none."""
    socket = await connect(address, subprotocols=[SUBPROTOCOL, TOKEN_PREFIX + token], max_queue=1)  # type: ignore[list-item]
    await socket.send('{"do": "subscribe", "fields": ["estimate_m", "voltage_v", "reference_m"]}')
    socket.transport.pause_reading()
    return socket


@contextlib.contextmanager
def _bare_server() -> Iterator[str]:
    """Its address: a server in a process of its own that has no stage, and answers what it is told."""
    with subprocess.Popen([sys.executable, __file__, BARE], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield f"ws://127.0.0.1:{process.stdout.readline().strip()}"
        finally:
            process.kill()


async def _answer() -> None:
    async def echo(socket: ServerConnection) -> None:
        async for text in socket:
            await socket.send(text)

    async with serve(echo, "127.0.0.1", 0, subprotocols=[SUBPROTOCOL]) as server:  # type: ignore[list-item]
        print(server.sockets[0].getsockname()[1], flush=True)
        await asyncio.Future()


async def _as_busy(seconds: float) -> None:
    """The same clients with the same messages at a server that has no stage: what they cost the machine by themselves,
    which keep one core busy and a server another.
    """
    with _bare_server() as address, contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await asyncio.gather(*(sending(address, "", ENDLESS, seed) for seed in range(SENDERS)))


def attacked(folder: Path, messages: int, *more: str) -> dict[str, Any]:
    """A server of its own, with such words, and what became of its stage."""
    words = ["serve", "--name", NAME, "--port", "0", "--json", *more, "--silence-s", "10"]
    words += ["--saves", str(folder), "--settings", str(folder)]
    process = subprocess.Popen([sys.executable, "-m", "hil", *words], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        url, _, token = json.loads(process.stdout.readline())["url"].partition("#")
        return asyncio.run(measured(url, token, process.pid, messages))
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30)


def main() -> None:
    messages = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        law, bus = patient_law(folder, "youla"), patient_bus(folder / "bus.toml", "unix_2k")
        both = {
            "as_served": attacked(folder, messages),
            "in_real_time": attacked(folder, messages, "--controller", str(law), "--bus", str(bus)),
        }
    REPORT.write_text(json.dumps(both, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(both, indent=1))
    for found in both.values():
        assert found["messages"] == messages
        assert found["activities"] == ["holding"]
        assert found["target_moved_m"] == 0.0
        assert found["position_moved_m"] < 30e-9
        assert found["strangers_inside"] == 0
        assert found["memory_most_mb"] < found["memory_before_mb"] + MEMORY_MORE_MB
        missed, elsewhere = found["ticks_missed"], found["ticks_missed_while_they_were_elsewhere"]
        assert median(missed) <= 1.1 * median(elsewhere) + SOME_TICKS
    assert not any(both["as_served"]["ticks_missed"])


if __name__ == "__main__":
    if sys.argv[1:] == [BARE]:
        asyncio.run(_answer())
    else:
        main()

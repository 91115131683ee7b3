"""SCPI over TCP, as VISA's ``TCPIP::host::port::SOCKET`` speaks it: lines that end with a newline."""

import asyncio
import contextlib
from collections.abc import Callable

from pkxyz_ctrl.client.reply import NoStageError
from pkxyz_ctrl.client.stage import AsyncStage
from pkxyz_ctrl.instrument.axis_moves import AxisMoves
from pkxyz_ctrl.instrument.scpi import LINE_MOST, ScpiSession
from pkxyz_ctrl.instrument.scpi_errors import ScpiError

PORT = 5025
CLIENTS_MOST = 8


async def serve_scpi(
    stage: AsyncStage, host: str, port: int, tell: Callable[[str], object], ended: asyncio.Event
) -> None:
    """Serve until ``ended``. Raises ``NoStageError`` once the stage is gone, and ``OSError`` for the port."""
    async with stage:
        moves = AxisMoves(stage)
        clients: set[asyncio.Task[None]] = set()

        async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            task = asyncio.current_task()
            assert task is not None
            clients.add(task)
            try:
                if len(clients) <= CLIENTS_MOST:
                    await _talk(ScpiSession(moves), reader, writer)
            except (ConnectionError, NoStageError):
                pass
            finally:
                clients.discard(task)
                with contextlib.suppress(ConnectionError):
                    writer.close()

        server = await asyncio.start_server(talk, host, port, limit=LINE_MOST)
        try:
            tell(f"TCPIP::{host}::{server.sockets[0].getsockname()[1]}::SOCKET")
            while not ended.is_set():
                await stage.next_status()
        finally:
            server.close()
            for task in clients:
                task.cancel()
            await asyncio.gather(*clients, return_exceptions=True)


async def _talk(session: ScpiSession, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while line := await _line(session, reader):
            answer = await session.answer_to(line.strip())
            if answer is not None:
                writer.write((answer if isinstance(answer, bytes) else answer.encode("ascii", "replace")) + b"\n")
                await writer.drain()
    finally:
        await session.end()


async def _line(session: ScpiSession, reader: asyncio.StreamReader) -> str:
    """The next line with its end; what is too long is an error, and left out. Empty at the end."""
    is_too_long = False
    while True:
        try:
            data = await reader.readuntil(b"\n")
        except asyncio.IncompleteReadError:
            return ""
        except asyncio.LimitOverrunError as error:
            await reader.readexactly(error.consumed)
            is_too_long = True
            continue
        if not is_too_long:
            return data.decode("ascii", "replace")
        session.errors.put(ScpiError(-223, f"a line has at most {LINE_MOST} bytes"))
        is_too_long = False

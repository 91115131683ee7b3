"""``pkxyz ioc`` and ``pkxyz scpi``: a stage that ``pkxyz serve`` operates, for other laboratory software."""

import asyncio
import signal
import sys
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Annotated, Any

import typer

from hil.screen.options import ListenAt, ListenPort, ServedAt, StageCalled
from pkxyz_ctrl.config.files import ConfigError


def ioc(
    prefix: Annotated[str, typer.Option(help="Before the names of all channels.")] = "pkxyz:",
    name: StageCalled = "stage",
    url: ServedAt = None,
    host: ListenAt = "127.0.0.1",
    port: Annotated[int, typer.Option(help="For Channel Access.", min=1, max=65535)] = 5064,
) -> None:
    """Serve a stage in operation to EPICS: a motor record per axis, and its verbs, until Ctrl-C."""
    import pkxyz_ctrl

    try:
        from pkxyz_ctrl.instrument.ioc import serve_ioc
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error.name} is missing: pip install 'pkxyz-ctrl[epics]'") from None
    stage = pkxyz_ctrl.connect_async(url, name=name, control=False)
    _until_ended(partial(serve_ioc, stage, prefix, host, port, _tell))


def scpi(
    name: StageCalled = "stage",
    url: ServedAt = None,
    host: ListenAt = "127.0.0.1",
    port: ListenPort = 5025,
) -> None:
    """Serve a stage in operation to programs that speak SCPI over TCP, until Ctrl-C."""
    import pkxyz_ctrl
    from pkxyz_ctrl.instrument.scpi_server import serve_scpi

    stage = pkxyz_ctrl.connect_async(url, name=name, control=False)
    _until_ended(partial(serve_scpi, stage, host, port, _tell))


def _tell(words: str) -> None:
    print(words, flush=True)


def _until_ended(serve: Callable[[asyncio.Event], Coroutine[Any, Any, None]]) -> None:
    from pkxyz_ctrl.client.reply import StageError

    async def main() -> None:
        ended = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, ended.set)
        await serve(ended)

    try:
        asyncio.run(main())
    except (StageError, OSError) as error:
        print(f"pkxyz: {error}", file=sys.stderr)
        raise typer.Exit(1) from None

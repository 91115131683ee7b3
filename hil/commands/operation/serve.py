"""``pkxyz serve``: a stage in operation, with a page and clients."""

import contextlib
import json
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.screen.first_run import say_if_compiling
from hil.screen.options import (
    ControllerFile,
    ListenAt,
    ListenPort,
    NativeLoop,
    OnSilence,
    Report,
    SilentFor,
    StageCalled,
    StageFile,
)

if TYPE_CHECKING:
    from hil.server.beside import Served


def serve(
    bus: Annotated[
        str | None, typer.Option(help="Name or file of the bus of real hardware; without it a stage is simulated.")
    ] = None,
    stage: StageFile = "reconstructed",
    controller: ControllerFile = "youla",
    plant: Annotated[str, typer.Option(help="Name or file of the simulated plant.")] = "nominal",
    name: StageCalled = "stage",
    on_silence: OnSilence = "hold",
    silence_s: SilentFor = 0.06,
    saves: Annotated[Path, typer.Option(help="Folder for what was around each fault.")] = Path("runs"),
    settings: Annotated[
        Path | None, typer.Option(help="Folder for what is set, with its history; the user's if not given.")
    ] = None,
    host: ListenAt = "127.0.0.1",
    port: ListenPort = 8765,
    report: Report = None,
    native: NativeLoop = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print where it is as JSON.")] = False,
) -> None:
    """Operate a stage: a loop at rate, and beside it a page and clients, until Ctrl-C. At the end the combs are at 0 V.

    What it prints is the address of the page; what stands behind # in it lets people in, so keep it to yourself.
    """
    from hil.server.beside import Served, bus_of_its_own
    from pkxyz_ctrl.config.bus import BusConfig
    from pkxyz_ctrl.config.files import load

    bus = bus or bus_of_its_own(name, _SIMULATED_BUS)
    config = load("buses", bus, BusConfig)
    is_simulated = config.can is not None and config.can.interface == "pkxyz-unix"
    if report is not None:
        from hil.conformance.proven import with_report

        with_report(config, report)  # said here, before anything is started
    if host not in ("127.0.0.1", "localhost", "::1"):
        print(f"everybody who can reach {host} and has the address below can move the stage", file=sys.stderr)

    def tell(url: str) -> None:
        print(json.dumps({"url": url}) if as_json else f"the stage is at {url}", flush=True)

    served = Served(
        name, stage, controller, plant, bus, on_silence, silence_s, saves, host, port, is_simulated, settings, report,
        native,
    )  # fmt: skip
    raise typer.Exit(serve_beside(served, tell, quiet=as_json))


def serve_beside(served: "Served", tell: Callable[[str], object], *, quiet: bool) -> int:
    """Start what takes longest, load the server meanwhile, and serve until SIGINT or SIGTERM; ``tell`` is told where.
    Returns an exit code. Raises ``ConfigError``.
    """
    from hil.server.beside import started

    try:
        with started(served) as beside:
            with _loaded_whole():
                say_if_compiling(quiet=quiet)
                from hil.server.serving import serve

            return serve(served, beside, tell)
    except KeyboardInterrupt:
        return 0


@contextlib.contextmanager
def _loaded_whole() -> Iterator[None]:
    """Ctrl-C and SIGTERM act afterwards: an import that is interrupted may end in anything."""
    signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING)


_ENDING = (signal.SIGINT, signal.SIGTERM)
_SIMULATED_BUS = "unix_2k"

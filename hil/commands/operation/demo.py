"""``pkxyz demo``: the page with a scan running."""

import contextlib
import threading
import time
from pathlib import Path
from typing import Annotated

import typer

from hil.commands.operation.serve import serve_beside
from hil.screen.options import ControllerFile, ListenPort

_NAME = "demo"


def demo(
    port: ListenPort = 8765,
    scenario: Annotated[str, typer.Option(help="The shipped scenario whose path is followed again and again.")] = (
        "raster"
    ),
    controller: ControllerFile = "youla",
    bus: Annotated[str | None, typer.Option(help="Name or file of a bus between processes.")] = None,
) -> None:
    """Operate a simulated stage that scans, until Ctrl-C: take control on the page and the scan gives way to you."""
    from hil.server.beside import Served, bus_of_its_own

    served = Served(
        name=_NAME, stage="reconstructed", controller=controller, plant="nominal",
        bus=bus or bus_of_its_own(_NAME, "unix_2k"),
        on_silence="hold", silence_s=0.25, saves=Path("runs"), host="127.0.0.1", port=port, is_simulated=True,
        report=None,
    )  # fmt: skip

    def tell(url: str) -> None:
        print(f"a stage that scans is at {url}", flush=True)
        threading.Thread(target=_scan, args=(scenario,), daemon=True).start()

    raise typer.Exit(serve_beside(served, tell, quiet=False))


def _scan(scenario: str) -> None:
    """Scan whenever nobody has control and nothing else moves."""
    import pkxyz_ctrl
    from pkxyz_ctrl.client.plain import Stage
    from pkxyz_ctrl.client.reply import AbortedError, NoStageError, RefusedError

    def scanned(stage: Stage) -> None:
        status = stage.next_status()
        if status.activity == "starting":
            return
        stage.take_control()
        try:
            if status.activity == "fault":
                stage.clear()
            if not status.driven:
                stage.home()
                stage.enable()
            command = stage.follow(scenario, wait=False)
        finally:
            stage.give_control()
        stage.ended(command)

    while True:
        with contextlib.suppress(NoStageError), pkxyz_ctrl.connect(name=_NAME, control=False) as stage:
            while True:
                with contextlib.suppress(RefusedError, AbortedError):  # somebody has control, or has stopped it
                    scanned(stage)
                time.sleep(0.5)
        time.sleep(0.2)

"""``pkxyz check-amplifier``: may this amplifier be enabled?"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.screen.options import AsJson
from hil.screen.outputs import folder_to_write, writing
from hil.screen.terminal import bad, faint, good, say
from pkxyz_ctrl.config.files import CONFIG_DIR, load

if TYPE_CHECKING:
    from hil.conformance.talker import Talker
    from hil.conformance.verdict import CheckResult
    from pkxyz_ctrl.config.bus import BusConfig

_STYLES = {
    "PASS": good, "UNSAFE": bad, "MEASURE": bad, "AGAINST CIA": bad, "OTHER CONTRACT": bad, "NOT TESTED": faint,
}  # fmt: skip


def check_amplifier(
    bus: Annotated[str, typer.Option(help="A shipped bus's name or a TOML file.")] = "fd_5k",
    eds: Annotated[Path | None, typer.Option(help="The amplifier's EDS; default: the shipped contract.")] = None,
    allow_voltage: Annotated[
        bool, typer.Option("--allow-voltage", help="Also drive a few volts; with the high voltage off, device removed.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for conformance.md and conformance.json.")] = None,
    as_json: AsJson = False,
) -> None:
    """Conformance run for a CANopen amplifier; exit code 1 if it is unsafe here, or a voltmeter has to tell, else 0."""
    from datetime import UTC, datetime

    from hil.conformance import report
    from hil.conformance.objects import identity_of
    from hil.conformance.run import run_all
    from pkxyz_ctrl.config.bus import BusConfig

    config = load("buses", bus, BusConfig)
    path = eds if eds is not None else CONFIG_DIR / "comb_amplifier.eds"
    if out is not None:
        folder_to_write(out)
    with _talker(config, path, allow_voltage) as talker:
        lines = run_all(talker, (lambda line: None) if as_json else _show)
        result = report.as_json(talker, path.name, lines, identity_of(talker), datetime.now(UTC))
    if out is not None:
        _save(out, "conformance.json", json.dumps(result, indent=1) + "\n")
        _save(out, "conformance.md", report.as_markdown(result))
    if as_json:
        print(json.dumps(result))
    else:
        say(f"{report.counted(result)}. {report.conclusion(result)}")
    raise typer.Exit(0 if result["ok"] else 1)


@contextmanager
def _talker(config: "BusConfig", eds: Path, allow_voltage: bool) -> "Iterator[Talker]":
    """On the simulated bus with node and plant, which are made here; elsewhere with whoever is there."""
    if config.can is None or config.can.interface == "pkxyz-sim":
        from hil.conformance.simulated import simulated_talker

        yield simulated_talker(config, eds, allow_voltage=allow_voltage)
        return
    from hil.conformance.eds import read_eds
    from hil.conformance.talker import Talker
    from pkxyz_ctrl.io.can_port import CanPort, open_bus
    from pkxyz_ctrl.io.clocks import WallClock

    variables = read_eds(eds, config.can.driver.node_id)
    clock = WallClock()
    with open_bus(config.can, config.name) as opened:
        port = CanPort(opened, clock)
        yield Talker(
            clock, port, config, variables, allow_voltage=allow_voltage, stamp_us=lambda: port.last_us
        )  # fmt: skip


def _show(line: "CheckResult") -> None:
    name = f"{line.group}: {line.name}"
    say(_STYLES[line.verdict.value](f"{line.verdict.value:14}"), f" {name:45} {line.got}")
    if line.verdict.value not in ("PASS", "NOT TESTED"):
        say(f"{'':14} {'expected':45} {line.expected} ({line.basis})")


def _save(out: Path, name: str, text: str) -> None:
    with writing(out):
        (out / name).write_text(text, encoding="utf-8")

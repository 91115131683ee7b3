"""A report of ``pkxyz check-amplifier`` on one very module, taken by a run in place of trying that module."""

import json
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hil.conformance.report import digest_of
from hil.conformance.verdict import Verdict
from pkxyz_ctrl.can.driver_config import ProvenModule
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import ConfigError, read_bounded

_MAX_BYTES = 10_000_000
_SIMULATED = ("pkxyz-sim", "pkxyz-unix")
_AGAIN = "make it again: pkxyz check-amplifier --allow-voltage --out DIR"


def with_report(bus: BusConfig, path: Path) -> BusConfig:
    """The bus with what the report (``conformance.json``) has shown of the module on it.

    Raises ``ConfigError`` for a file that is no report, was changed, has nothing to show, or is of a simulated module
    where the bus leads to a real one.
    """
    if bus.can is None:
        raise ConfigError(f"--report: bus {bus.name!r} has no [can], so there is no amplifier on it")
    report = _read(path)
    try:
        proven = _module(report)
        interface, made = str(report["interface"]), datetime.fromisoformat(report["made"])
    except (AttributeError, KeyError, TypeError, ValueError):
        raise ConfigError(f"--report: {path}: not a whole report of this version on a module that tells its identity "
                          f"and serial number (0x1018:1 to 4); {_AGAIN}") from None  # fmt: skip
    if not report["ok"]:
        raise ConfigError(f"--report: {path}, of {made:%Y-%m-%d}: the module did not pass, and must not be enabled")
    if interface in _SIMULATED and interface != bus.can.interface:
        raise ConfigError(
            f"--report: {path}: made over {interface}, of a simulated module; {bus.can.interface} leads to another one"
        )
    driver = bus.can.driver.model_copy(update={"proven": proven})
    return bus.model_copy(update={"can": bus.can.model_copy(update={"driver": driver})})


def _read(path: Path) -> dict[str, Any]:
    try:
        report = json.loads(read_bounded(path, _MAX_BYTES))
    except (ConfigError, OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"--report: {path}: cannot be read: {error}") from None
    if not isinstance(report, dict) or "digest" not in report:
        raise ConfigError(f"--report: {path}: no conformance.json of `pkxyz check-amplifier --out`")
    if report["digest"] != digest_of(report):
        raise ConfigError(f"--report: {path}: it was changed since it was made; {_AGAIN}")
    return report


def _module(report: dict[str, Any]) -> ProvenModule:
    passed = tuple(line["name"] for line in report["lines"] if line["verdict"] == Verdict.PASS)
    try:
        return ProvenModule(**report["module"], lines=passed, digest=report["digest"])
    except ValidationError as error:
        raise ValueError(str(error)) from None

"""All measurements by name, in the order in which they are shown."""

import os
import platform
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hil.bench import (
    beside,
    control,
    lanes,
    learning,
    limits,
    margins,
    native,
    operate,
    parts,
    plant,
    quality,
    startup,
    study,
    tick,
)
from hil.bench.rigs.figure import Figure
from hil.runs.versions import versions
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.io.realtime import cores

Measurement = Callable[[], list[Figure]]

MEASUREMENTS: dict[str, Measurement] = {
    "tick": tick.tick,
    "plant": plant.plant,
    "lockstep": lanes.lockstep,
    "fast": lanes.fast,
    "batch": lanes.batch,
    "study": study.study,
    "spread": study.spread,
    "sil": startup.sil,
    "nominal": quality.nominal,
    "mild": quality.mild,
    "harsh": quality.harsh,
    "beside": beside.beside,
    "learning": learning.learning,
    "control": control.control,
    "margins": margins.margins,
    "controller": parts.controller,
    "codec": parts.codec,
    "gate": parts.gate,
    "driver": parts.driver,
    "wire": parts.wire,
    "bus": limits.bus_cycle,
    "limits": limits.limits,
    "native": native.native,
    "operate": operate.operate,
}
"""A measurement's name is what its figures' names begin with."""


def chosen(only: list[str]) -> list[str]:
    """Names of the measurements for what was asked: all for nothing, else those named or holding a named figure.

    Raises ``ConfigError`` for a name that no measurement has.
    """
    for name in only:
        if name.partition(".")[0] not in MEASUREMENTS:
            raise ConfigError(f"--only {name}: no such measurement; there are {', '.join(MEASUREMENTS)}")
    wanted = {name.partition(".")[0] for name in only}
    return [name for name in MEASUREMENTS if not wanted or name in wanted]


def measure(name: str, only: list[str]) -> list[Figure]:
    """Take one measurement; of its figures those that were asked for. Raises ``ConfigError`` for a figure it hasn't."""
    figures = MEASUREMENTS[name]()
    here = {asked for asked in only if asked.partition(".")[0] == name}
    if not here or name in here:
        return figures
    if missing := here - {f.name for f in figures}:
        raise ConfigError(f"--only {missing.pop()}: no such figure; there are {', '.join(f.name for f in figures)}")
    return [f for f in figures if f.name in here]


def results(machine: dict[str, Any], figures: list[Figure]) -> dict[str, Any]:
    """What is printed as JSON: figures, and on what they were taken."""
    return {"machine": machine, "figures": [f.as_json() for f in figures]}


def describe_machine() -> dict[str, Any]:
    """The class of machine, without names: architecture, cores, clock, what else is running now, versions."""
    load = round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None
    return {
        "architecture": platform.machine(),
        "cores": cores(),
        "clock_ghz": next(_clock_ghz(), None),
        "load_average": load,
        "versions": versions(),
    }


def _clock_ghz() -> Iterator[float]:
    """Nominal clock of the first core where the system tells, in GHz."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="ignore").splitlines()
    except OSError:
        return
    for line in lines:
        if line.startswith("cpu MHz"):
            yield round(float(line.partition(":")[2]) * 1e-3, 1)

"""What studies of many devices take beyond one machine: calculated from what the benchmarks measured on one."""

import json
import math
from dataclasses import dataclass
from pathlib import Path

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results.json"
DRAWS = Path(__file__).parents[1] / "tables" / "many_devices.json"
DEVICES_A_PIECE = 256
"""Of a large ``pkxyz yield``: ``PART_DEVICES`` in each of ``PARTS_TOGETHER``."""


@dataclass(frozen=True)
class Plan:
    """A study of so many devices in a given time. A worker is a process on a core of its own."""

    devices: float
    time_s: float
    device_s: float
    """processor time of one device"""
    piece_s: float
    """of the scheduler's process for one piece of work"""
    worker_bytes: float
    sent_bytes: float
    """to a worker with each piece"""
    back_bytes: float
    """from it"""

    @property
    def core_s(self) -> float:
        """Of all workers together."""
        return self.devices * self.device_s

    @property
    def cores(self) -> int:
        """Workers that work all the time."""
        return math.ceil(self.core_s / self.time_s)

    @property
    def memory_bytes(self) -> float:
        """Of all workers."""
        return self.cores * self.worker_bytes

    @property
    def fed(self) -> int:
        """Workers that one scheduler feeds with pieces as they are."""
        return int(DEVICES_A_PIECE * self.device_s / self.piece_s)

    @property
    def schedulers(self) -> int:
        """With numbers of their own each."""
        return math.ceil(self.cores / self.fed)

    @property
    def carried_bytes_per_s(self) -> float:
        """Through all schedulers, both ways."""
        return (self.sent_bytes + self.back_bytes) * self.devices / DEVICES_A_PIECE / self.time_s


def planned(devices: float, time_s: float) -> Plan:
    """By the figures in benchmarks/results.json."""
    figures = {f["name"]: f["value"] for f in json.loads(RESULTS.read_text(encoding="utf-8"))["figures"]}
    return Plan(
        devices, time_s, figures["study.device"] * 1e-3, figures["spread.piece"] * 1e-3,
        figures["spread.worker_memory"] * 1e6, figures["spread.piece_sent"] * 1e3, figures["spread.piece_back"] * 1e3,
    )  # fmt: skip


def million_s() -> float:
    """What a run of 10^6 devices took on two cores, by the clock, with all that belongs to it."""
    draws = {draw["devices"]: draw["seconds"] for draw in json.loads(DRAWS.read_text(encoding="utf-8"))}
    return float(draws[1_000_000])


def rows() -> list[list[str]]:
    """Of the table on docs/do/many-plants.md."""
    million, billion = planned(1e6, 3600.0), planned(1e9, 3600.0)
    return [
        ["a device: margins, and a run with a scan of 0.3 s", "measured", f"{million.device_s * 1e3:.1f} ms of a core"],
        ["a worker's memory", "measured", f"{million.worker_bytes * 1e-6:.0f} MB"],
        [f"a piece of {DEVICES_A_PIECE} devices", "measured",
         f"{million.piece_s * 1e3:.1f} ms of the scheduler; {million.sent_bytes * 1e-3:.0f} kB to a worker, "
         f"{million.back_bytes * 1e-3:.0f} kB back"],
        ["10^6 devices", "calculated", f"{million.core_s / 3600.0:.1f} core-hours"],
        ["10^6 devices on two cores, with compiling and files", "measured",
         f"{million_s() / 60.0:.0f} minutes: {million_s() / 1800.0:.1f} core-hours"],
        ["one scheduler feeds", "calculated", f"{million.fed} workers"],
        ["10^9 devices in an hour", "calculated",
         f"{billion.cores} cores, {billion.memory_bytes * 1e-12:.1f} TB; {billion.schedulers} schedulers with numbers "
         f"of their own, {billion.carried_bytes_per_s * 1e-6:.0f} MB/s through them"],
    ]  # fmt: skip

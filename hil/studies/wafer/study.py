"""Devices of a process, wafer by wafer: what each is, which requirements it meets, kept as Parquet while it goes on.

Wafers are worked at in parts, always the same ones, so that a study has the same bits however it was spread, and one
that was interrupted goes on where it stopped.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hil.studies.spread.cluster import Cluster
from hil.studies.spread.workers import as_done, with_constant, worker_pool
from hil.studies.wafer.table import Table
from pkxyz_ctrl.config import files as config
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.fabrication.devices import Devices, as_drawn, made
from pkxyz_ctrl.fabrication.figures import FIGURES, figures
from pkxyz_ctrl.fabrication.process import SOURCES, Process
from pkxyz_ctrl.fabrication.wafer import Sampled, dies_per_wafer, sample_wafers, sizes

Array = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

PART_WAFERS = 32
"""Wafers of a part: some seconds of work at most."""
_RUNS = 4
"""Of a worker, at least, before parts are handed out together: so that none waits long for the last."""


@dataclass(frozen=True)
class WaferStudy:
    """What is asked: which devices a process makes of a drawing. Raises ``ConfigError`` where that can't be told."""

    process: Process
    stage: StageConfig
    seed: int

    def __post_init__(self) -> None:
        unknown = [name for name in self.process.requirements if name not in FIGURES]
        if unknown:
            raise ConfigError(
                f"{self.process.name}: requirements.{unknown[0]}: no such figure; known: {', '.join(FIGURES)}"
            )
        if self.stage.calibration is not None:
            raise ConfigError(
                f"{self.stage.name}: is one measured device, not a drawing; give the stage file it began as"
            )
        _ = self.as_drawn

    @property
    def together(self) -> int:
        """Parts that a worker is handed at most."""
        return 1

    @cached_property
    def as_drawn(self) -> Devices:
        """One device as drawn."""
        return _told(lambda: as_drawn(self.stage, self.process))

    @property
    def requirement_columns(self) -> tuple[str, ...]:
        """Columns of verdicts, that of all requirements last."""
        return (*(f"ok.{name}" for name in self.process.requirements), "ok")

    def digest(self) -> str:
        """Of all that decides about a device, its number apart."""
        return config.digest(
            {"process": config.plain(self.process), "stage": config.plain(self.stage), "seed": self.seed}
        )

    def made(self, sampled: Sampled) -> Devices:
        """Devices with these random numbers."""
        return _told(lambda: made(self.stage, self.process, sizes(self.process, sampled)))

    def part(self, number: int) -> Columns:
        """``columns`` of the wafers of a part."""
        return self.columns(range(number * PART_WAFERS, (number + 1) * PART_WAFERS))

    def columns(self, wafers: range) -> Columns:
        """All that is kept of the devices of whole wafers: number, place, sizes (of the chains, the mean), figures,
        and of each requirement whether it is met.
        """
        sampled = sample_wafers(self.process, self.seed, wafers)
        size = sizes(self.process, sampled)
        devices = _told(lambda: made(self.stage, self.process, size))
        found = figures(self.stage, self.as_drawn, devices)
        return {
            "device": sampled.device,
            "wafer": sampled.device // dies_per_wafer(self.process),
            "x_m": sampled.place_m[:, 0].copy(),
            "y_m": sampled.place_m[:, 1].copy(),
            **{name: size[name].mean(axis=1) for name in SOURCES},
            **found,
            "film_valid": devices.film_valid,
            **self.verdicts(found),
        }

    def verdicts(self, found: Mapping[str, Array]) -> dict[str, NDArray[np.bool_]]:
        """Of figures (n,): ``ok.NAME`` for each requirement, and ``ok`` for all."""
        each = {f"ok.{name}": within(found[name], bound.min, bound.max) for name, bound in
                self.process.requirements.items()}  # fmt: skip
        return each | {"ok": np.logical_and.reduce(list(each.values()))}

    def alone(self, device: int) -> dict[str, Any]:
        """All of one device by its number, as in a study of any size; the sizes of its three chains."""
        wafer, die = divmod(device, dies_per_wafer(self.process))
        sampled = sample_wafers(self.process, self.seed, [wafer])
        columns = self.columns(range(wafer, wafer + 1))
        size = sizes(self.process, sampled)
        return {name: values[die].item() for name, values in columns.items()} | {
            name: size[name][die].tolist() for name in SOURCES
        }


def within(values: Array, least: float | None, most: float | None) -> NDArray[np.bool_]:
    """Which of the values lie within bounds; what is no number does not."""
    above = np.ones(len(values), np.bool_) if least is None else values >= least
    return np.asarray(above & (np.ones(len(values), np.bool_) if most is None else values <= most))


class Parts(Protocol):
    """Work in numbered parts, each a table's."""

    @property
    def together(self) -> int:
        """Parts that a worker is handed at most."""
        ...

    def part(self, number: int) -> Columns:
        """Columns of a part."""
        ...


def run_study(
    study: Parts,
    parts: int,
    table: Table,
    workers: int,
    cluster: Cluster | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Work out those of the first ``parts`` parts that are not in the table yet. Interrupted, it keeps those that are
    done.
    """
    there = table.parts
    left = [part for part in range(parts) if part not in there]
    on_progress(parts - len(left), parts)
    if workers == 1 and cluster is None:
        pieces = _pieces(left, study.together, 1)
        _keep(((piece, work_at(study, piece)) for piece in pieces), table, parts - len(left), parts, on_progress)
    elif left:
        with worker_pool(workers, cluster) as (pool, width):
            pieces = _pieces(left, study.together, width)
            done = as_done(pool, width, with_constant(work_at, study), pieces, ahead=width)
            _keep(done, table, parts - len(left), parts, on_progress)


def _pieces(left: list[int], together: int, width: int) -> list[range]:
    """Parts that are left, in runs: as many together as leave each worker some runs."""
    most = max(1, min(together, len(left) // (_RUNS * width)))
    found: list[range] = []
    for part in left:
        if found and part == found[-1].stop and len(found[-1]) < most:
            found[-1] = range(found[-1].start, part + 1)
        else:
            found.append(range(part, part + 1))
    return found


def parts_for(process: Process, devices: int) -> int:
    """How many parts hold that many devices."""
    return -(-devices // (PART_WAFERS * dies_per_wafer(process)))


def work_at(study: Parts, parts: range) -> Columns:
    """Columns of a run of parts."""
    found = [study.part(part) for part in parts]
    return {name: np.concatenate([columns[name] for columns in found]) for name in found[0]}


def spread_die(wafer: NDArray[np.int64], dies: int) -> NDArray[np.int64]:
    """A die for each wafer, all dies alike often: steps by the golden ratio."""
    return np.asarray((wafer * 0.6180339887498949 % 1.0 * dies).astype(np.int64))


def _keep(
    done: Iterator[tuple[range, Columns]], table: Table, before: int, parts: int, tell: Callable[[int, int], None]
) -> None:
    for piece, columns in done:
        table.add(piece, columns)
        before += len(piece)
        tell(before, parts)


def _told(work: Callable[[], Devices]) -> Devices:
    try:
        return work()
    except ValueError as error:
        raise ConfigError(str(error)) from None

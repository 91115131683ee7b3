"""Many soaks, each with a seed of its own: as many ticks as cores and machines get through, each kept as it ends."""

import dataclasses
import importlib.metadata
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hil.runs.scenario import Scenario, resolve
from hil.studies.soak import Soaked, as_json, soak
from hil.studies.spread.cluster import Cluster
from hil.studies.spread.kept import Kept
from hil.studies.spread.missing import work_out_missing
from pkxyz_ctrl.config import files as config

_TOTALS = ("ticks", "recorded_ticks", "faults", "decisions", "misled", "returns")
_COUNTS = ("faults_by_case", "undecided", "reasons")
_LARGEST = ("voltage_max_v", "slew_max_v", "rise_max_v", "zero_ticks")
Asked = tuple[Scenario, float]
"""What is soaked, and for how many seconds of stage time."""


class KeptSoaks(Kept[int, Soaked]):
    """A file of soaks by their seeds."""

    def __init__(self, path: Path, asked: Asked) -> None:
        """Raises ``ConfigError`` for the file of another study."""
        scenario, duration_s = asked
        version = importlib.metadata.version("pkxyz-ctrl")
        head = {
            "digest": config.digest(
                {
                    "scenario": resolve(scenario),
                    "duration_s": duration_s,
                    "version": version,
                    "counted": [f.name for f in dataclasses.fields(Soaked)],
                }
            ),
            "duration_s": duration_s,
        }
        super().__init__(path, head, lambda soaked: soaked.seed, _read, as_json)


def soak_each(
    asked: Asked,
    seeds: Sequence[int],
    workers: int,
    kept: KeptSoaks,
    cluster: Cluster | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Soaked]:
    """Soak with those seeds that are not kept yet; all, in the order of seeds. Interrupted, it keeps those that are
    through, and tells of them. Raises ``ConfigError`` for a cluster that can't be had.
    """
    scratch = f"pkxyz-soak-{os.getpid()}-"
    try:
        work_out_missing(_soaked, (asked, scratch), seeds, kept, workers, cluster, on_progress, at_once=1)
    except KeyboardInterrupt:
        if not kept.found:
            raise
    finally:  # a process that is ended leaves what it was at
        for folder in Path(tempfile.gettempdir()).glob(scratch + "*"):
            shutil.rmtree(folder, ignore_errors=True)
    return [kept.found[seed] for seed in seeds if seed in kept.found]


def totals(soaks: Sequence[Soaked]) -> dict[str, Any]:
    """Sums and largest values of all, and what was wrong with which seed."""
    counts: dict[str, Counter[str]] = {name: Counter() for name in _COUNTS}
    for soaked in soaks:
        for name, counted in counts.items():
            counted.update(getattr(soaked, name))
    return {
        "ok": all(soaked.ok for soaked in soaks), "soaks": len(soaks),
        **{name: sum(getattr(soaked, name) for soaked in soaks) for name in _TOTALS},
        **{name: max(getattr(soaked, name) for soaked in soaks) for name in _LARGEST},
        "damaged": any(soaked.damaged for soaked in soaks),
        **{name: dict(counted.most_common()) for name, counted in counts.items()},
        "problems": {soaked.seed: soaked.problems for soaked in soaks if soaked.problems},
    }  # fmt: skip


def decisions_in_words(faults: int, undecided: Mapping[str, int], decisions: int, misled: int) -> str:
    """How many there were of each, and which share of them was not held to the other."""
    return (
        f"{faults} faults, {sum(undecided.values())} without a decision; {decisions} decisions, {misled} excused by a "
        "misled homing"
    )


def _soaked(asked: tuple[Asked, str], seed: int) -> Soaked:
    (scenario, duration_s), scratch = asked
    folder = Path(tempfile.mkdtemp(prefix=scratch))
    try:
        return soak(duration_s, seed, scenario, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _read(data: dict[str, Any]) -> Soaked:
    return Soaked(**{name: value for name, value in data.items() if name != "ok"})

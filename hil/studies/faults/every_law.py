"""Every case of the matrix under every law: spread over workers, each outcome kept as it comes."""

import importlib.metadata
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hil.lanes.setup import Setup
from hil.runs.scenario import load_scenario, resolve
from hil.studies.faults.matrix import Case
from hil.studies.faults.outcome import SCENARIO, Outcome, as_json, run_case, setup_for
from hil.studies.spread.cluster import Cluster
from hil.studies.spread.kept import Kept
from hil.studies.spread.workers import as_done, with_constant, worker_pool
from pkxyz_ctrl.config import files as config
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.design.model.design_error import DesignError

INTERRUPTED = "interrupted"
"""Why a law is not among the results."""
Broken = tuple[str, Case]
"""A law, and what is broken under it."""
_SAVED_AS = "faults"
"""What a file of outcomes is: each line says by its own digest what was run, so a law may be added or changed."""


@dataclass
class Found:
    """``outcomes`` are in the order of laws and cases, of laws that are through; ``refused``: reasons of the others."""

    outcomes: list[Outcome] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)


class KeptOutcomes(Kept[str, tuple[str, Outcome]]):
    """A file of outcomes by the digests of what was run."""

    def __init__(self, path: Path) -> None:
        """Raises ``ConfigError`` for a file of another kind."""
        super().__init__(path, {"digest": _SAVED_AS}, lambda value: value[0], _read, _as_json)


def break_all(
    laws: Sequence[str],
    cases: Sequence[Case],
    workers: int,
    cluster: Cluster | None = None,
    kept: KeptOutcomes | None = None,
    on_progress: Callable[[int, int, str], None] = lambda done, total, law: None,
) -> Found:
    """Run what is not kept yet, in this process if ``workers`` is 1. Interrupted, it tells of the laws that are
    through. Raises ``ConfigError`` for a cluster that can't be had.
    """
    found, setups, known = Found(), {}, {} if kept is None else kept.found
    digests: dict[Broken, str] = {}
    for law in laws:
        try:
            setups[law] = setup_for(law)
        except ConfigError as error:
            found.refused[law] = str(error)
            continue
        described = resolve(load_scenario(SCENARIO, controller=law))
        digests |= {(law, case): _digest(described, case) for case in cases}
    outcomes = {each: known[digest][1] for each, digest in digests.items() if digest in known}
    left = [each for each in digests if each not in outcomes]
    try:
        for (law, case), outcome in _done(setups, left, workers, cluster):
            if isinstance(outcome, str):
                found.refused[law] = outcome
                continue
            outcomes[law, case] = outcome
            if kept is not None:
                kept.add((digests[law, case], outcome))
            on_progress(len(outcomes), (len(laws) - len(found.refused)) * len(cases), law)
    except KeyboardInterrupt:
        for law, case in left:
            if (law, case) not in outcomes:
                found.refused.setdefault(law, INTERRUPTED)
    found.outcomes = [outcomes[each] for each in digests if each[0] not in found.refused]
    return found


def _done(setups: dict[str, Setup], left: list[Broken], workers: int, cluster: Cluster | None) -> Any:
    if workers == 1 and cluster is None:
        yield from ((each, _broken(setups, each)) for each in left)
    elif left:
        with worker_pool(workers, cluster) as (pool, width):
            yield from as_done(pool, width, with_constant(_broken, setups), left, ahead=width)


def _broken(setups: dict[str, Setup], what: Broken) -> Outcome | str:
    """What came of it, or why the law can't be run here. A law is designed once in each process."""
    law, case = what
    setup = setups[law]
    try:
        assert setup.law is not None  # designed here, so that what refuses does so before anything is broken
    except (ConfigError, DesignError) as error:
        return str(error)
    return run_case(law, setup, case)


def _digest(described: dict[str, Any], case: Case) -> str:
    version = importlib.metadata.version("pkxyz-ctrl")
    return config.digest({"scenario": described, "case": repr(case), "version": version})


def _as_json(value: tuple[str, Outcome]) -> dict[str, Any]:
    return {"run": value[0], **as_json(value[1])}


def _read(data: dict[str, Any]) -> tuple[str, Outcome]:
    fields: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in data.items()}
    return fields.pop("run"), Outcome(**{name: value for name, value in fields.items() if name != "ok"})

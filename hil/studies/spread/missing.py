"""The skeleton of a study of independent results: what is not kept yet is worked out, and kept as it comes."""

from collections.abc import Callable, Sequence
from typing import Any

from hil.studies.spread.cluster import Cluster
from hil.studies.spread.kept import Kept, Key, Value
from hil.studies.spread.workers import as_done, with_constant, worker_pool


def work_out_missing(
    function: Callable[[Any, Key], Value],
    asked: object,
    keys: Sequence[Key],
    kept: Kept[Key, Value],
    workers: int,
    cluster: Cluster | None,
    on_progress: Callable[[int, int], None],
    *,
    at_once: int,
) -> None:
    """Keep ``function(asked, key)`` of the keys that are not kept yet. Interrupted, those that are done are kept.

    ``at_once``: keys that a worker is handed together, at most. Raises ``ConfigError`` for a cluster that can't be had.
    """
    left = [key for key in keys if key not in kept.found]
    done = len(keys) - len(left)
    on_progress(done, len(keys))
    if not left:
        return
    with worker_pool(workers, cluster) as (pool, width):
        each = with_constant(_each, (function, asked))
        for _, values in as_done(pool, width, each, pieces(left, width, at_once), ahead=width):
            for value in values:
                kept.add(value)
            done += len(values)
            on_progress(done, len(keys))


def pieces(keys: Sequence[Key], width: int, at_once: int) -> list[Sequence[Key]]:
    """Long enough that a scheduler has little to do, and several for each worker, so that none waits at the end."""
    size = min(at_once, max(1, len(keys) // (4 * width)))
    return [keys[n : n + size] for n in range(0, len(keys), size)]


def _each(asked: tuple[Callable[[Any, Key], Value], object], keys: Sequence[Key]) -> list[Value]:
    function, constant = asked
    return [function(constant, key) for key in keys]

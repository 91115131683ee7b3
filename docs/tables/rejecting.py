"""Keeps what came of the search for taps that bear the changed plants of `youla` and reject slow disturbances further
(docs/understand/margins.md): docs/tables/rejecting.json. Takes a minute, so it is no part of ``make docs``.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hil.studies.tune.taps import TapsSearch, find_axis_taps
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.model.discrete_law import LawError

KEPT = Path(__file__).with_suffix(".json")
LINES_DB = ((10.0, 34.0), (50.0, 20.0))
EDGES_HZ = (70.0, 202.0)
"""With the second `youla` itself is searched."""


def found(edge_hz: float, on_progress: Callable[[str], None] = lambda line: None) -> dict[str, Any]:
    """Axis x: its noise at hold in nm, or none and why, and how much |S| each programme in a row had to concede."""
    search = load("searches", "youla", TapsSearch)
    bounds = search.bounds.model_copy(update={"edge_hz": edge_hz, "reject_db": LINES_DB})
    conceded: list[float] = []

    def note(line: str) -> None:
        (told,) = re.findall(r"([\d.]+) conceded", line)
        conceded.append(float(told))
        on_progress(line)

    outcome: dict[str, Any] = {"edge_hz": edge_hz, "noise_nm": None, "why": None, "conceded": conceded}
    try:
        outcome["noise_nm"] = round(1e9 * find_axis_taps(search, bounds, 0, note)[1], 3)
    except LawError as error:
        outcome["why"] = str(error)
    return outcome


if __name__ == "__main__":
    KEPT.write_text(json.dumps([found(hz, print) for hz in EDGES_HZ], indent=1) + "\n", encoding="utf-8")

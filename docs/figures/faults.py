"""Draws the matrix of faults, and keeps what came of each for docs/lookup/faults.md. The matrix takes a minute or two.

    python docs/figures/faults.py [SOAK.JSON [MANY.JSON]]

The soak's line and picture are taken over only where the result of ``pkxyz soak --out`` is given: that takes some
minutes. Likewise that of ``pkxyz soak --minutes 33.334 --runs 100 --out``, 10^9 ticks, which is kept in docs/tables: an
hour.
"""

import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

from hil.pictures.faults import draw
from hil.screen.progress import progress_bar
from hil.studies.faults.every_law import break_all
from hil.studies.faults.matrix import CASES
from hil.studies.faults.outcome import Outcome
from hil.studies.soaks import decisions_in_words
from pkxyz_ctrl.config.files import names
from pkxyz_ctrl.io.realtime import cores

HERE = Path(__file__).parent
PAGE = HERE.parent / "lookup" / "faults.md"
FOUND = HERE / "faults.json"
"""Of the law of the page; the site's table is made of it."""
LAW = "lqg"
MANY = HERE.parent / "tables" / "soak.json"
"""10^9 ticks, with what came of each kind of fault."""


def plain(outcomes: list[Outcome]) -> list[dict[str, Any]]:
    """What came of each fault under the law of the page, to be kept."""
    return [
        {
            "fault": outcome.case,
            "ticks": outcome.ticks,
            "latched": list(outcome.reason),
            "zero_ms": outcome.zero_ms,
            "excursion_um": outcome.excursion_um,
            "remark": "; ".join(outcome.problems) or case.note,
        }
        for outcome, case in zip(outcomes, CASES, strict=True)
    ]


def matrix(found: list[dict[str, Any]]) -> str:
    """The table of what was kept."""
    rows = [
        "| fault | ticks | latched | 0 V after, ms | off by, um | |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for f in found:
        ticks = "-" if f["ticks"] is None else str(f["ticks"])
        zero = "-" if f["zero_ms"] is None else f"{f['zero_ms']:.1f}"
        rows.append(
            f"| {f['fault']} | {ticks} | {', '.join(f['latched'])} | {zero} | {f['excursion_um']:.2f} | {f['remark']} |"
        )
    return "\n".join(rows)


def soaked(path: Path) -> str:
    """The result of a soak in a sentence."""
    s = json.loads(path.read_text(encoding="utf-8"))
    early, late = min(s["memory_mb"][1:17]), min(s["memory_mb"][-16:])  # least of sixteen, as it is judged
    decided = decisions_in_words(s["faults"], s["undecided"], s["decisions"], s["misled"])
    return (
        f"Measured (seed {s['seed']}, law {s['law']}): {s['ticks']} ticks at {s['realtime_factor']:.1f} times real "
        f"time, {s['recorded_ticks']} read back; {decided}, {s['returns']} times back to tracking; memory "
        f"{early:.0f} MB at first and {late:.0f} MB at last.\n\n"
        f"{many_soaked()}"
        "![memory, faults, decisions and returns, minute by minute](../figures/soak.png)"
    )


def many_soaked() -> str:
    """Likewise of the many that are kept; nothing where none are."""
    if not MANY.is_file():
        return ""
    s = json.loads(MANY.read_text(encoding="utf-8"))
    violations = sum(len(problems) for problems in s["problems"].values())
    return (
        f"Seeds 1 to {s['soaks']}, {s['core_minutes']:.0f} core-minutes: {s['ticks']} ticks, {s['faults']} faults, "
        f"{s['decisions']} decisions, {violations} violations.\n\n"
    )


def filled_in(page: str, part: str, text: str) -> str:
    """``page`` with one generated part."""
    pattern = rf"(<!-- generated: {part} -->\n).*?(<!-- end -->)"
    return re.sub(pattern, lambda match: f"{match[1]}{text}\n{match[2]}", page, flags=re.DOTALL)


def main() -> None:
    laws = names("controllers")
    with progress_bar("faults", quiet=False) as tell:
        broken = break_all(laws, CASES, cores(), on_progress=tell)
    found = broken.outcomes
    print("not run:", broken.refused)
    draw(found, CASES, HERE / "faults.png")
    kept = plain([o for o in found if o.law == LAW])
    FOUND.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    if len(sys.argv) > 2:
        shutil.copy(sys.argv[2], MANY)
    if len(sys.argv) > 1:
        page = filled_in(PAGE.read_text(encoding="utf-8"), "soak", soaked(Path(sys.argv[1])))
        shutil.copy(Path(sys.argv[1]).with_name("soak.png"), HERE / "soak.png")
        PAGE.write_text(page, encoding="utf-8")
    for outcome in found:
        if not outcome.ok:
            print(outcome.law, outcome.case, "; ".join(outcome.problems))


if __name__ == "__main__":
    main()

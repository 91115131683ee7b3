"""What the controller takes on a board, as tests/firmware/measure.py has kept it; fills in the README's table.

python docs/tables/board.py
"""

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "README.md"
KEPT = Path(__file__).with_name("board.json")
MHZ = 480
SHOWN = ("lqg", "youla")
HEADER = [
    "law", "settings, B", "memory, B", "cycle, to the voltages: median", "most",
    "the period, driver, gate and what waits: median", "most", f"at {MHZ} MHz",
]  # fmt: skip


def rows(kept: dict[str, Any]) -> list[list[str]]:
    """A row for each law: bytes, and instructions a tick while it tracks."""
    parts = ("settings_bytes", "memory_bytes", "cycle_median", "cycle_most", "period_median", "period_most")
    return [
        [f"`{law}`", *(str(found[part]) for part in parts), f"{found['period_most'] / MHZ:.1f} us"]
        for law, found in kept["laws"].items()
    ]


def readme(kept: dict[str, Any]) -> list[str]:
    """The README's lines."""
    youla = kept["laws"]["youla"]
    sizes = (kept["code_bytes"], youla["settings_bytes"], youla["memory_bytes"], kept["stack_bytes"])
    cells = [f"{size / 1000:.1f} kB" for size in sizes]
    cells += [
        f"{found['period_median'] / 1000:.1f} k, most {found['period_most'] / 1000:.1f} k"
        for found in (kept["laws"][law] for law in SHOWN)
    ]
    return [
        "| | code | law | memory | stack | instructions a tick, `lqg` | `youla` |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        f"| the whole controller, tracking; law and memory as `youla` needs them | {' | '.join(cells)} |",
    ]


def filled_in(page: str, kept: dict[str, Any]) -> str:
    """The page with the current table."""
    before, _, rest = page.partition("<!-- generated: sizes -->\n")
    after = rest.partition("<!-- end -->")[2]
    return f"{before}<!-- generated: sizes -->\n" + "\n".join(readme(kept)) + f"\n<!-- end -->{after}"


if __name__ == "__main__":
    found = json.loads(KEPT.read_text(encoding="utf-8"))
    PAGE.write_text(filled_in(PAGE.read_text(encoding="utf-8"), found), encoding="utf-8")

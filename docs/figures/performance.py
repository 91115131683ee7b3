"""Writes the generated tables of performance.md and docs/figures/performance.png from benchmarks/results.json.

    python docs/figures/performance.py

Each table stands between ``<!-- generated: NAME -->`` and ``<!-- end -->``.
"""

import json
import re
from pathlib import Path
from typing import Any

from hil.bench.rigs.figure import Figure
from hil.commands.bench import bound_of, in_digits
from hil.pictures.style import BLUE, FAINT, GREEN, MUTED, ORANGE, SKY, TINY_PT, dress, legend, save, sheet

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "lookup" / "performance.md"
PICTURE = Path(__file__).with_suffix(".png")
RESULTS = ROOT / "benchmarks" / "results.json"

TABLES = {
    "speed": ("tick", "lockstep.realtime", "lockstep.events", "fast", "batch", "study", "spread", "plant", "sil",
              "operate", "native"),
    "share": ("lockstep.tick", *(f"lockstep.{part}" for part in
              ("bus_and_node", "driver_and_gate", "cycle", "plant", "recording_and_log"))),
    "parts": ("controller", "driver", "gate", "codec", "wire"),
    "floor": ("limits", "bus"),
    "beside": ("beside",),
    "quality": ("nominal", "mild", "harsh", "learning", "control", "margins"),
}  # fmt: skip
COLOURS = (BLUE, SKY, GREEN, ORANGE, FAINT)


def read_figures(results: dict[str, Any]) -> dict[str, Figure]:
    """Figures by name."""
    return {f["name"]: Figure(**{k: v for k, v in f.items() if k != "met"}) for f in results["figures"]}


def table(figures: dict[str, Figure], wanted: tuple[str, ...]) -> str:
    """Markdown: the figures that have or begin with the wanted names; a missed target is told."""
    rows = [("figure", "value", "target", ""), ("---", "---:", "---", "---")]
    for name, figure in figures.items():
        if name in wanted or name.partition(".")[0] in wanted:
            median = "" if figure.median is None else f" ({in_digits(figure.median)})"
            bound = bound_of(figure).replace("at most ", "≤ ").replace("at least ", "≥ ")
            missed = " **missed**" if figure.met is False else ""
            value = f"{in_digits(figure.value)}{median} {figure.unit}"
            rows.append((name, value, bound + missed, figure.detail))
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def machine_line(results: dict[str, Any]) -> str:
    """On what it was measured, in a sentence."""
    machine = results["machine"]
    versions = ", ".join(f"{name} {machine['versions'][name]}" for name in ("python", "numpy", "numba", "scipy"))
    clock = f" at {machine['clock_ghz']:g} GHz" if machine["clock_ghz"] else ""
    load = "" if machine["load_average"] is None else f", with a load average of {machine['load_average']:g}"
    return f"Measured on {machine['cores']} cores ({machine['architecture']}){clock}{load}; {versions}."


def generated(results: dict[str, Any]) -> dict[str, str]:
    """The blocks of the page by name."""
    figures = read_figures(results)
    return {"machine": machine_line(results)} | {name: table(figures, wanted) for name, wanted in TABLES.items()}


def rewritten(page: str, results: dict[str, Any]) -> str:
    """The page with its generated blocks filled in."""
    for name, text in generated(results).items():
        block = re.search(rf"<!-- generated: {name} -->\n(.*?)<!-- end -->", page, re.DOTALL)
        if block is None:
            if f"<!-- built: {name} -->" in page:
                continue  # is made when the site is built
            raise ValueError(f"{PAGE.name} has no block named {name}")
        page = f"{page[: block.start(1)]}{text}\n{page[block.end(1) :]}"
    return page


def draw(figures: dict[str, Figure]) -> None:
    """Where the time of a tick goes, over the bus event by event and in the compiled lane; and a whole one's."""
    parts = [figures[name] for name in TABLES["share"][1:]]
    fast, kernel, period = (figures[name].value for name in ("fast.tick", "tick.kernel", "plant.period"))
    bars = {
        "lockstep, event by event": [p.value for p in parts],
        "fast": [0.0, 0.0, kernel, period, max(0.0, fast - kernel - period)],
    }
    picture = sheet(9.0, 2.4)
    axes = picture.add_subplot()
    left = [0.0] * len(bars)
    for k, (part, colour) in enumerate(zip(parts, COLOURS, strict=True)):
        widths = [bar[k] for bar in bars.values()]
        label = part.name.partition(".")[2].replace("_", " ")
        axes.barh(list(bars), widths, left=left, color=colour, label=label)
        left = [a + b for a, b in zip(left, widths, strict=True)]
    whole = figures["lockstep.realtime"]
    axes.barh(["lockstep, whole ticks"], [200.0 / whole.value], color=MUTED, label="all in one call")
    target = whole.target or 1.0
    axes.axvline(200.0 / target, color=MUTED, lw=1, ls=":")
    axes.annotate(
        f"{target:g} times real time ", (200.0 / target, -0.47), ha="right", va="bottom", fontsize=TINY_PT,
        annotation_clip=False,
    )  # fmt: skip
    axes.invert_yaxis()
    dress(axes, "µs of processor time a tick of 200 µs", grid="x")
    legend(axes, "lower right", columns=2, anchor=(1.0, 0.05))
    save(picture, PICTURE)


if __name__ == "__main__":
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    PAGE.write_text(rewritten(PAGE.read_text(encoding="utf-8"), found), encoding="utf-8")
    draw(read_figures(found))

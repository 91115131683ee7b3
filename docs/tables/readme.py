"""Fills in the README's tables of what is reached: the default scenario at each place, with the default law and without
feedback; and how the loop answers there, as benchmarked.

python docs/tables/readme.py
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

from hil.bench.rigs.places import followed

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "README.md"
RESULTS = ROOT / "benchmarks" / "results.json"
PLACES = {
    "nominal": "nominal: as the stage file says",
    "mild": "mild: some per cent of mismatch, 200 ppm of sense gain",
    "lab": "lab: a good stage on a good table in a real room, 100 us of sense filter",
    "lab_identified": "identified",
    "harsh": "harsh: 10 % mismatch, strong parasitic mode, charging, drift",
}
ANSWERS = {
    "move": ("1 um move, within 10 nm", "ms"),
    "jump": ("1 um jump of the set-point, likewise", "ms"),
    "sine": ("100 nm at 1262 Hz, twice the first resonance, off by", "dB"),
    "circle": ("circle of 4 um radius at 100 Hz, rms", "nm"),
}


def three(values: Mapping[str, float]) -> str:
    """x / y / z in nm, or in um where all are beyond 100 nm."""
    if min(values.values()) > 100.0:
        return " / ".join(f"{v / 1e3:.2f}" for v in values.values()) + " um"
    return (
        " / ".join(f"{v:.2f}" if v < 2.0 else f"{v:.1f}" if v < 10.0 else f"{v:.0f}" for v in values.values()) + " nm"
    )


def rows() -> Iterator[str]:
    """The first table's lines."""
    yield "| plant | without feedback | default law `youla` | its holds: error, noise |"
    yield "| --- | --- | --- | --- |"
    for place, words in PLACES.items():
        cells = [three(followed("raster", place, law).rms_error_nm) for law in ("open_loop", "youla")]
        held = followed("raster", place, "youla")
        worst, noise = (max(of_axes.values()) for of_axes in (held.hold_rms_nm, held.hold_noise_nm))
        yield f"| {words} | {' | '.join(cells)} | {worst:.1f}, {noise:.1f} nm |"


def answers() -> Iterator[str]:
    """The second table's."""
    kept = {f["name"]: f for f in json.loads(RESULTS.read_text(encoding="utf-8"))["figures"]}
    places = [place for place in PLACES if place != "harsh"]
    yield f"| with the default law (without feedback) | {' | '.join(place.replace('_', ', ') for place in places)} |"
    yield f"| --- |{' --- |' * len(places)}"
    for name, (words, unit) in ANSWERS.items():
        cells = []
        for place in places:
            figure = kept[f"beside.{name}_{place}"]
            ours, _, alone = figure["detail"].partition("; open loop ")
            cells.append(f"{figure['value']:.1f} ({beside(name, ours, alone)}) {unit}")
        yield f"| {words} | {' | '.join(cells)} |"


def beside(name: str, ours: str, alone: str) -> str:
    """What the open loop has, in the axis that is told of the law."""
    if name in ("move", "jump"):
        return "never" if alone.startswith("not") else alone.removesuffix(" ms")
    if name == "sine":
        return f"{max(abs(float(v)) for v in alone.split(', ')):.1f}"
    axis = "xyz".index(ours.split(", in ")[1][0])
    value = float(alone.split(" / ")[axis])
    return f"{value:.1f}" if value < 10.0 else f"{value:.0f}"


def filled_in(page: str) -> str:
    """The page with the current tables."""
    for name, lines in (("reached", rows()), ("answers", answers())):
        before, _, rest = page.partition(f"<!-- generated: {name} -->\n")
        after = rest.partition("<!-- end -->")[2]
        page = f"{before}<!-- generated: {name} -->\n" + "\n".join(lines) + f"\n<!-- end -->{after}"
    return page


if __name__ == "__main__":
    PAGE.write_text(filled_in(PAGE.read_text(encoding="utf-8")), encoding="utf-8")

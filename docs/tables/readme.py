"""Fills in the README's table of what is reached: the default scenario on each shipped plant, with three laws.

python docs/tables/readme.py
"""

from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.runs.metrics import Metrics, RowFigures
from hil.runs.scenario import load_scenario

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "README.md"
PLANTS = {
    "nominal": ("raster", "nominal: as the stage file says"),
    "mild": ("raster_mild", "mild: some per cent of mismatch, 200 ppm of sense gain"),
    "lab": ("raster_lab", "lab: a good stage on a good table in a real room, 100 us of sense filter"),
    "harsh": ("raster_harsh", "harsh: 10 % mismatch, strong parasitic mode, charging, drift"),
}
LAWS = ("open_loop", "youla", "lqg")


@cache
def figures(scenario: str, controller: str) -> RowFigures:
    """Figures of a run of the fast lane, in nm by axis; its bits are those of lockstep."""
    loaded = load_scenario(scenario, controller=controller)
    metrics = Metrics(loaded.trajectory, loaded.bus.period_us)
    lanes.run(loaded.setup(), Lane.FAST, on_block=metrics.update)
    return metrics.figures()


def three(values: Mapping[str, float]) -> str:
    """x / y / z in nm, or in um where all are beyond 100 nm."""
    if min(values.values()) > 100.0:
        return " / ".join(f"{v / 1e3:.2f}" for v in values.values()) + " um"
    return (
        " / ".join(f"{v:.2f}" if v < 2.0 else f"{v:.1f}" if v < 10.0 else f"{v:.0f}" for v in values.values()) + " nm"
    )


def rows() -> Iterator[str]:
    """The table's lines."""
    yield "| plant | without feedback | default law `youla` | law `lqg` | hold noise, `youla` |"
    yield "| --- | --- | --- | --- | --- |"
    for scenario, words in PLANTS.values():
        cells = [three(figures(scenario, law).rms_error_nm) for law in LAWS]
        noise = f"{max(figures(scenario, 'youla').hold_noise_nm.values()):.1f} nm"
        yield f"| {words} | {' | '.join(cells)} | {noise} |"


def filled_in(page: str) -> str:
    """The page with the current table."""
    before, _, rest = page.partition("<!-- generated: reached -->\n")
    after = rest.partition("<!-- end -->")[2]
    return f"{before}<!-- generated: reached -->\n" + "\n".join(rows()) + f"\n<!-- end -->{after}"


if __name__ == "__main__":
    PAGE.write_text(filled_in(PAGE.read_text(encoding="utf-8")), encoding="utf-8")

"""Keeps the table of 200 sampled plants of docs/do/tuning.md, three laws on the raster, seeds 1 to 200; and what 500 do
in a circle under the default law, for docs/understand/laws.md.

python docs/tables/montecarlo.py
"""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import hil

TABLE = Path(__file__).with_suffix(".json")
LAWS = ("youla", "lqg", "robust")
PLANTS = 200
CIRCLES = 500


def study(law: str, folder: Path) -> list[str]:
    """Run the study of one law; its row of the table."""
    found = hil.montecarlo(hil.load_scenario("raster", controller=law), plants=PLANTS, out=folder / law, workers=1)
    told = found.summary
    error, noise, peak = (told[name] for name in ("rms_error_nm", "hold_noise_nm", "peak_s"))
    return [
        f"`{law}`",
        f"{error['median']:.0f}, {error['p95']:.0f}, {error['max']:.0f}",
        f"{noise['median']:.2f}, {noise['max']:.2f}",
        f"{peak['median']:.2f}, {peak['p95']:.2f}, {peak['max']:.2f}",
        str(told["not_held"] or "none"),
        str(told["worst_seed"]),
    ]


def circle(folder: Path) -> dict[str, float]:
    """Errors of sampled devices in the circle, in nm, and the seed of the largest."""
    found = hil.montecarlo("circle", plants=CIRCLES, out=folder / "circle", workers=1)
    error: dict[str, float] = found.summary["rms_error_nm"]
    return error


HEADER = (
    "law", "rms error: median, 95 %, largest (nm)", "hold noise: median, largest (nm)", "Ms: median, 95 %, largest",
    "did not hold", "worst seed",
)  # fmt: skip

if __name__ == "__main__":
    with TemporaryDirectory() as place:
        rows, error_nm = [study(law, Path(place)) for law in LAWS], circle(Path(place))
    TABLE.write_text(
        json.dumps({"header": HEADER, "rows": rows, "circle_nm": error_nm}, indent=1) + "\n", encoding="utf-8"
    )

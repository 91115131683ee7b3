"""Fills in the table of 200 sampled plants on docs/do/tuning.md: three laws on the raster, seeds 1 to 200.

python docs/tables/montecarlo.py
"""

import re
from pathlib import Path
from tempfile import TemporaryDirectory

import hil

PAGE = Path(__file__).parents[1] / "do" / "tuning.md"
LAWS = ("youla", "lqg", "robust")
PLANTS = 200


def study(law: str, folder: Path) -> str:
    """Run the study of one law; its line of the table."""
    found = hil.montecarlo(hil.load_scenario("raster", controller=law), plants=PLANTS, out=folder / law, workers=1)
    told = found.summary
    error, noise, peak = (told[name] for name in ("rms_error_nm", "hold_noise_nm", "peak_s"))
    cells = (
        f"`{law}`",
        f"{error['median']:.0f}, {error['p95']:.0f}, {error['max']:.0f}",
        f"{noise['median']:.2f}, {noise['max']:.2f}",
        f"{peak['median']:.2f}, {peak['p95']:.2f}, {peak['max']:.2f}",
        str(told["not_held"] or "none"),
        str(told["worst_seed"]),
    )
    return f"| {' | '.join(cells)} |"


HEAD = (
    "| law | rms error: median, 95 %, largest (nm) | hold noise: median, largest (nm) | Ms: median, 95 %, largest "
    "| did not hold | worst seed |\n| --- | --- | --- | --- | --- | --- |"
)

if __name__ == "__main__":
    with TemporaryDirectory() as place:
        lines = [study(law, Path(place)) for law in LAWS]
    table = "\n".join([HEAD, *lines])
    pattern = r"(<!-- generated: plants -->\n).*?(<!-- end -->)"
    text = re.sub(pattern, lambda m: f"{m[1]}{table}\n{m[2]}", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    PAGE.write_text(text, encoding="utf-8")

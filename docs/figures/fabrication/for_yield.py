"""Writes docs/figures/for_yield.png: drawings beside each other, on the same fresh wafers, as `pkxyz design --for-yield
oreo_drie --trials 80 --devices 96` found them (for_yield.json).
"""

import json
from pathlib import Path

import numpy as np

from hil.pictures.wafer.drawings import DrawingFigures, draw_drawings

HERE = Path(__file__).parent


def main() -> None:
    """Draw it."""
    found = json.loads((HERE / "for_yield.json").read_text(encoding="utf-8"))
    drawings = [
        DrawingFigures(name, row["works"], np.array(row["error_nm"]), row["effects"])
        for name, row in found["drawings"].items()
    ]
    draw_drawings(drawings, found["limit_nm"], HERE.parent / "for_yield.png")


if __name__ == "__main__":
    main()

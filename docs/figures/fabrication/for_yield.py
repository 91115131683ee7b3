"""Writes docs/figures/for_yield.png: drawings beside each other, on the same fresh wafers, as `pkxyz design --for-yield
oreo_drie` found them: for_yield.json is its summary.json.
"""

import json
from pathlib import Path

import numpy as np

from hil.pictures.wafer.drawings import DrawingFigures, draw_drawings
from hil.studies.wafer.shares import Share

HERE = Path(__file__).parent


def main() -> None:
    """Draw it."""
    found = json.loads((HERE / "for_yield.json").read_text(encoding="utf-8"))
    drawings = [
        DrawingFigures(
            name,
            {n: Share(**share) for n, share in {"works": row["works"], **row["shares"]}.items()},
            {n: Share(**share) for n, share in row["requirements"].items()},
            np.array(row["error_nm"], dtype=np.float64),
            row["effects"],
        )
        for name, row in found["drawings"].items()
    ]
    draw_drawings(drawings, found["limit_nm"], HERE.parent / "for_yield.png")


if __name__ == "__main__":
    main()

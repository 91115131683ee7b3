"""Draws every figure of docs/ and fills in the generated tables: ``python docs/build.py``, or ``make docs``.

A second time it changes no file, but for figures that are measured (``performance.png`` from benchmarks/results.json
and ``endurance.png`` from endurance.json change only with those).
"""

import runpy
import sys
from pathlib import Path

if __name__ == "__main__":
    here = Path(__file__).parent
    sys.path.insert(0, str(here / "drawings"))  # canvas, which they share
    for script in sorted([*here.glob("figures/**/*.py"), *here.glob("tables/*.py"), *here.glob("drawings/*.py")]):
        print(script.name, flush=True)
        runpy.run_path(str(script), run_name="__main__")

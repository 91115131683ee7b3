"""Draws every figure of docs/ and fills in the generated tables: ``python docs/build.py``, or ``make docs``."""

import runpy
from pathlib import Path

if __name__ == "__main__":
    for script in sorted(Path(__file__).parent.glob("figures/*.py")):
        print(script.name, flush=True)
        runpy.run_path(str(script), run_name="__main__")

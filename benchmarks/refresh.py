"""Takes every measurement anew, keeps it in benchmarks/results.json and redraws docs/performance.md from it.

    python benchmarks/refresh.py

On a machine with nothing else to do: the load that it had is kept beside the figures.
"""

import json
import runpy
from pathlib import Path

from hil.bench.suite import describe_machine, results
from hil.bench_cli import measure_all

RESULTS = Path(__file__).with_name("results.json")
PERFORMANCE = Path(__file__).parents[1] / "docs" / "figures" / "performance.py"

if __name__ == "__main__":
    machine = describe_machine()  # its load before we add to it
    measured = results(machine, measure_all([], quiet=False))
    RESULTS.write_text(json.dumps(measured, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    runpy.run_path(str(PERFORMANCE), run_name="__main__")

"""Takes every measurement anew, or the measurements and figures named, keeps it in benchmarks/results.json and redraws
performance.md.

    python benchmarks/refresh.py [NAME ...]

On a machine with nothing else to do: the load that it had is kept beside the figures.
"""

import json
import runpy
import sys
from pathlib import Path

from hil.bench.suite import MEASUREMENTS, describe_machine, results
from hil.commands.bench import measure_all

RESULTS = Path(__file__).with_name("results.json")
PERFORMANCE = Path(__file__).parents[1] / "docs" / "figures" / "performance.py"

if __name__ == "__main__":
    machine = describe_machine()  # its load before we add to it
    measured = results(machine, measure_all(sys.argv[1:], quiet=False))
    if sys.argv[1:]:  # the others stay, with the machine as it was for them
        kept = json.loads(RESULTS.read_text(encoding="utf-8"))
        new = {f["name"] for f in measured["figures"]} | set(sys.argv[1:])
        rest = [f for f in kept["figures"] if not {f["name"], f["name"].partition(".")[0]} & new]
        order = list(MEASUREMENTS)
        figures = sorted(rest + measured["figures"], key=lambda f: order.index(f["name"].partition(".")[0]))
        measured = kept | {"figures": figures}
    RESULTS.write_text(json.dumps(measured, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    runpy.run_path(str(PERFORMANCE), run_name="__main__")

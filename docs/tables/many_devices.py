"""Keeps the shares of two draws of 10^5 devices in a closed loop, and how long each took, for docs/do/wafer.md.

python docs/tables/many_devices.py FOLDER

FOLDER, which must not be there yet, takes what both find, some GB; they have the machine to themselves for some minutes
each. Without it nothing happens, so that ``make docs`` does not wait.
"""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

KEPT = Path(__file__).with_suffix(".json")
SEEDS = (1, 2)
WORDS = (
    "--scenario", "examples/short_scan.toml", "--shipped", "--devices", "100000", "--loops", "100000",
    "--sensitivity", "0", "--loop-sensitivity", "0",
)  # fmt: skip
"""Of `pkxyz yield`."""


def drawn(seed: int, folder: Path) -> tuple[dict[str, Any], float]:
    """What `pkxyz yield --json` tells, and how many seconds it took by the clock."""
    begin_s = time.perf_counter()
    words = [sys.executable, "-m", "hil", "yield", *WORDS, "--seed", str(seed), "--out", str(folder / str(seed))]
    told = subprocess.run([*words, "--json"], check=True, capture_output=True, text=True).stdout
    return json.loads(told), time.perf_counter() - begin_s


def kept_of(told: dict[str, Any], seconds: float) -> dict[str, Any]:
    """Each share with both ends of its interval, those of the drawing first."""
    shares = {**told["shares"], **told["loops"]}
    return {
        "seed": told["seed"], "devices": told["devices"], "seconds": round(seconds, 1),
        "shares": {name: [round(share[end], 5) for end in ("value", "low", "high")] for name, share in shares.items()},
    }  # fmt: skip


if __name__ == "__main__" and len(sys.argv) > 1:
    place = Path(sys.argv[1])
    place.mkdir(parents=True)  # what went on with an earlier one would have taken no time
    both = [kept_of(*drawn(seed, place)) for seed in SEEDS]
    KEPT.write_text(json.dumps(both, indent=1) + "\n", encoding="utf-8")

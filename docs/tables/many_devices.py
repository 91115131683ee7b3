"""Keeps the shares of two draws of 10^5 devices and of one of 10^6 in a closed loop, and how long each took, for
docs/do/wafer.md.

python docs/tables/many_devices.py FOLDER [SEED ...]

FOLDER, which must not be there yet, takes what they find, half a GB; they have the machine to themselves, for some
minutes and for most of an hour. With seeds the others stay as they are kept. Without a folder nothing happens, so that
``make docs`` does not wait.
"""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

KEPT = Path(__file__).with_suffix(".json")
DEVICES = {1: 100_000, 2: 100_000, 3: 1_000_000}
"""Of each seed."""
WORDS = (
    "--scenario", "examples/short_scan.toml", "--shipped", "--sensitivity", "0", "--loop-sensitivity", "0", "--json",
)  # fmt: skip
"""Of `pkxyz yield`."""


def drawn(seed: int, folder: Path) -> tuple[dict[str, Any], float]:
    """What `pkxyz yield --json` tells, and how many seconds it took by the clock."""
    many = ["--seed", str(seed), "--devices", str(DEVICES[seed]), "--loops", str(DEVICES[seed])]
    words = [sys.executable, "-m", "hil", "yield", *WORDS, *many, "--out", str(folder / str(seed))]
    begin_s = time.perf_counter()
    told = subprocess.run(words, check=True, capture_output=True, text=True).stdout
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
    kept = {draw["seed"]: draw for draw in json.loads(KEPT.read_text(encoding="utf-8"))}
    for asked in map(int, sys.argv[2:] or DEVICES):
        kept[asked] = kept_of(*drawn(asked, place))
        KEPT.write_text(json.dumps([kept[seed] for seed in sorted(kept)], indent=1) + "\n", encoding="utf-8")

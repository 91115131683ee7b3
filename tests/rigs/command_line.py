"""``pkxyz`` in a process of its own, as a user starts it."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def pkxyz(*words, cwd):
    """Run ``pkxyz`` in a folder; the checkout itself is found by PYTHONPATH, as if installed."""
    return subprocess.run(
        [sys.executable, "-m", "hil.cli", *map(str, words)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "120"},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )

"""The loop in C with nobody beside it."""

import subprocess

from hil.commands.export import run_beside
from hil.native.program import compiled


def written(folder, scenario):
    """What ``pkxyz export --target linux`` adds for the loop."""
    for name, content in run_beside(scenario, None):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    return folder / "loop.bin"


def loop(*words):
    return subprocess.run([str(compiled()), *map(str, words)], check=False, capture_output=True, text=True, timeout=120)

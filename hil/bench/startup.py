"""From Enter to the picture: `pkxyz sil` as a user meets it, in a new process."""

import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from hil.bench.rigs.figure import Figure
from hil.runs.run_folder import PICTURE

REPEATS = 3
_COMMAND = "from hil.cli import main; main()"
_AGAIN = """
import gc, sys, time
from pathlib import Path
gc.set_threshold(50_000)  # as the command does
from pkxyz_ctrl.compiled.quick_load import load_quickly
from hil.lanes.lane import Lane
from hil.pictures.run import draw
from hil.runs.run import run_into
from hil.runs.run_folder import RunFolder
from hil.runs.scenario import load_scenario
load_quickly()
for n in range(2):
    before_s = time.perf_counter()
    folder = RunFolder(Path(f"{sys.argv[1]}-{n}"))
    draw(folder, run_into(folder, load_scenario("raster"), Lane.LOCKSTEP))
    took_s = time.perf_counter() - before_s
print(took_s)
"""
_LINE = re.compile(r"^import time:\s+(\d+) \|\s+\d+ \|\s+([\w.]+)$", re.MULTILINE)
_SHOWN = 8


def sil() -> list[Figure]:
    """The default scenario as a command, kernels compiled already: wall and processor time, and imports."""
    with tempfile.TemporaryDirectory() as folder:
        _run(Path(folder) / "warm")  # compiles what is not compiled yet, and fills the file cache
        wall_s, cpu_s = [], []
        for k in range(REPEATS):
            begin_s, before = time.perf_counter(), os.times()
            _run(Path(folder) / f"run-{k}")
            wall_s.append(time.perf_counter() - begin_s)
            after = os.times()
            cpu_s.append(after.children_user + after.children_system - before.children_user - before.children_system)
        by_package, over_run = min(
            (_imports(Path(folder) / f"imports-{k}") for k in range(REPEATS)), key=lambda i: i[1]
        )
        again = [wall / _again_s(Path(folder) / f"again-{k}") for k, wall in enumerate(wall_s)]
        helped_s = [_help(Path(folder)) for _ in range(REPEATS)]
    most = ", ".join(f"{package} {s:.2f}" for package, s in by_package.most_common(_SHOWN))
    return [
        Figure("sil.wall", min(wall_s), "s", 5.0, "at most", statistics.median(wall_s),
               f"`pkxyz sil`, new process, from Enter to the picture; the clock on the wall, {REPEATS} runs"),
        Figure("sil.cpu", min(cpu_s), "s", None, None, statistics.median(cpu_s), "processor time of the same"),
        Figure("sil.imports", by_package.total(), "s", None, None, None,
               f"imports of the run's process; by package: {most}"),
        Figure("sil.over_run", over_run, "x", 1.8, "at most", None, "the command over the same less its imports"),
        Figure("sil.over_again", min(again), "x", None, None, statistics.median(again),
               "sil.wall over the time of the same run and picture once more, in one process with everything loaded"),
        Figure("sil.help", min(helped_s), "s", 0.3, "at most", statistics.median(helped_s),
               f"`pkxyz --help`, new process; the clock on the wall, {REPEATS} runs"),
    ]  # fmt: skip


def _run(folder: Path, *flags: str) -> str:
    """Run the command into ``folder``; returns what it wrote to its standard error."""
    command = [sys.executable, *flags, "-c", _COMMAND, "sil", "--out", str(folder), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=_as_installed(folder.parent))
    if not (folder / PICTURE).is_file():
        raise RuntimeError(f"pkxyz sil left no picture (exit code {done.returncode}): {done.stderr[-2000:]}")
    return done.stderr


def _imports(folder: Path) -> tuple[Counter[str], float]:
    """Seconds of imports by package in one more run, and that run's time over what is left of it without them."""
    begin_s = time.perf_counter()
    seconds = _import_seconds(_run(folder, "-X", "importtime"))
    wall_s = time.perf_counter() - begin_s
    return seconds, wall_s / (wall_s - seconds.total())


def _again_s(folder: Path) -> float:
    """Seconds of the clock on the wall of a run with its picture, in a process that has done the same before."""
    command = [sys.executable, "-c", _AGAIN, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=_as_installed(folder.parent))
    return float(done.stdout)


def _as_installed(folder: Path) -> dict[str, str]:
    """The environment of an installed package, whose bytecode is kept: here in ``folder``, filled by the first run. A
    shell that forbids to write bytecode would have our modules compiled anew at each start.
    """
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return kept | {"PYTHONPYCACHEPREFIX": str(folder / "bytecode")}


def _help(folder: Path) -> float:
    """Seconds of the clock on the wall until the list of commands has been printed."""
    begin_s = time.perf_counter()
    command = [sys.executable, "-c", _COMMAND, "--help"]
    subprocess.run(command, capture_output=True, check=True, env=_as_installed(folder))
    return time.perf_counter() - begin_s


def _import_seconds(report: str) -> Counter[str]:
    """Seconds of each top-level package's own modules, from the output of ``-X importtime``."""
    seconds: Counter[str] = Counter()
    for own_us, module in _LINE.findall(report):
        package = module.partition(".")[0]
        name = "standard library" if package in sys.stdlib_module_names else package
        seconds[name] += int(own_us) * 1e-6  # type: ignore[assignment]
    return seconds

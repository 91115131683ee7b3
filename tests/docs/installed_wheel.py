"""The package as a user has it: its wheel, built and installed into a folder of its own, without network."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

from pkxyz_ctrl.compiled.kernel_cache import choose_kernel_cache

ROOT = Path(__file__).parents[2]
PACKAGES = ("pkxyz_ctrl", "hil", "sim")


def install(folder: Path) -> dict[str, str]:
    """Build the wheel of this checkout and install it below ``folder``; the environment in which it is used.

    Its dependencies are those of this interpreter. Raises CalledProcessError with what pip said.
    """
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    built, installed = folder / "wheel", folder / "installed"
    offline = ("--no-deps", "--no-index")
    run([*pip, "wheel", *offline, "--no-build-isolation", "--wheel-dir", str(built), str(ROOT)])
    run([*pip, "install", *offline, "--target", str(installed), *map(str, built.glob("*.whl"))])
    path = os.pathsep.join((str(installed / "bin"), str(Path(sys.executable).parent), os.environ["PATH"]))
    env = {**os.environ, "PATH": path, "PYTHONPATH": str(installed), "NUMBA_CACHE_DIR": str(folder / "kernels")}
    share_kernels(installed, folder / "kernels")
    return env


def share_kernels(installed: Path, cache: Path) -> None:
    """What is compiled for the checkout serves the wheel, and the other way round: the sources are the same, and numba
    compares them. It keeps a folder of its own for each folder of sources, named after its path.
    """
    choose_kernel_cache()
    compiled = Path(os.environ["NUMBA_CACHE_DIR"])
    cache.mkdir()
    for package in PACKAGES:
        for source in {path.parent for path in (ROOT / package).rglob("*.py")}:
            own = compiled / kernels_of(source)
            own.mkdir(exist_ok=True)
            (cache / kernels_of(installed / source.relative_to(ROOT))).symlink_to(own)


def kernels_of(source: Path) -> str:
    """What numba calls its folder for a folder of sources."""
    return f"{source.name}_{hashlib.sha1(str(source).encode()).hexdigest()}"


def run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr

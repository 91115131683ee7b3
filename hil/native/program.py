"""The native loop as a program of this machine: its C beside the exported object, compiled once and kept.

It takes any law, so there is one for a version of the kernels: kept under a digest of all that it is made of.
"""

import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import llvmlite
import numba

from pkxyz_ctrl.compiled.kernel_cache import digest_of_kernels
from pkxyz_ctrl.export.folder import LOOP_SOURCES
from pkxyz_ctrl.export.kernels import ExportError, kernels
from pkxyz_ctrl.export.lowering import lower
from pkxyz_ctrl.export.structs import loop_header
from pkxyz_ctrl.export.targets import TARGETS

FLAGS = ("-std=c11", "-O2", "-Wall", "-Wextra", "-fno-strict-aliasing", "-ffp-contract=off")
"""Records are read as words, too: no strict aliasing."""


def compiler() -> str | None:
    """This machine's C compiler, CC if that is set; None without one."""
    return shutil.which(os.environ.get("CC") or "cc")


def kept() -> Path | None:
    """The program, if it was compiled before."""
    program = _place()
    return program if program is not None and program.is_file() else None


def compiled() -> Path:
    """The program, compiled now if it wasn't before: some seconds, or a minute where nothing was ever exported.

    Raises ``ExportError`` without a compiler, or with its own first words where it fails.
    """
    program = kept()
    if program is not None:
        return program
    with_compiler = compiler()
    if with_compiler is None:
        raise ExportError(
            f"no C compiler: {os.environ.get('CC') or 'cc'} is not on the PATH, and the native loop is built with it; "
            "install one (Debian: apt install gcc libc6-dev), or leave --native"
        )
    folder = _place()
    to = folder if folder is not None else Path(tempfile.mkdtemp(prefix="pkxyz-loop-")) / "loop"
    with tempfile.TemporaryDirectory(prefix="pkxyz-loop-") as scratch:
        build(Path(scratch), with_compiler)
        beside = to.with_suffix(f".{os.getpid()}")
        shutil.copy2(Path(scratch) / "loop", beside)
        beside.replace(to)
    return to


def build(folder: Path, with_compiler: str) -> None:
    """Header, object and sources into ``folder``, and ``loop`` out of them. Raises ``ExportError``."""
    (folder / "pkxyz.h").write_text(loop_header(), encoding="utf-8")
    (folder / "pkxyz.o").write_bytes(lower(kernels(is_planned=True), TARGETS["linux"]).code)
    sources = [str(path) for path in sorted(LOOP_SOURCES.glob("*.c"))]
    words = [with_compiler, *FLAGS, "-I", str(folder), "-o", str(folder / "loop"), *sources, str(folder / "pkxyz.o")]
    done = subprocess.run(words, check=False, capture_output=True, text=True)
    if done.returncode != 0:
        said = [line for line in done.stderr.splitlines() if "error" in line] or ["it said nothing"]
        raise ExportError(f"{with_compiler} could not build the native loop: {said[0].strip()}; give another CC")


def _place() -> Path | None:
    """A file in numba's cache folder, named after all that it is made of."""
    folder = os.environ.get("NUMBA_CACHE_DIR")
    if folder is None or not Path(folder).is_dir():
        return None
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__} {digest_of_kernels()} {compiler()}".encode())
    for path in sorted([*LOOP_SOURCES.parent.glob("*.py"), Path(__file__), *LOOP_SOURCES.iterdir()]):
        digest.update(path.read_bytes())
    return Path(folder) / f"loop-{digest.hexdigest()[:16]}"

"""LLVM's view of the kernels before anything is optimised: made in a process of its own, and kept.

What numba has optimised holds vectors and intrinsics of this machine's processor, hence ``NUMBA_OPT=0``; and it reads
that setting once, when it is imported, hence the process. Its output and its mangled names are no stable interface:
the versions are pinned, and a test compares bits.
"""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import llvmlite
import numba

from pkxyz_ctrl.compiled.kernel_cache import digest_of_kernels

_MADE_OF = tuple(Path(__file__).with_name(name) for name in ("entries.py", "emit.py", "planned.py"))


class ExportError(ValueError):
    """What is asked for can't be exported; the message says why and what to do."""


class Kernels(NamedTuple):
    """``ir``: one module with all of them. ``symbols``: names of the entries' functions in it. ``is_planned``: those of
    any law, the one that plans too, and of the native loop.
    """

    ir: str
    symbols: dict[str, str]
    is_planned: bool = False


def kernels(*, is_planned: bool = False) -> Kernels:
    """Those of ``entries_for``, from the folder of compiled kernels if they lie there. Takes a minute if not."""
    name, words = ("export_planned.ll", ("planned",)) if is_planned else ("export.ll", ())
    text = kept(name, _MADE_OF, lambda: emitted("pkxyz_ctrl.export.emit", *words).encode()).decode()
    first, _, ir = text.partition("\n")
    return Kernels(ir, json.loads(first), is_planned)


def kept(name: str, sources: Sequence[Path], make: Callable[[], bytes]) -> bytes:
    """What ``make`` gives, or gave before, of the kernels as they are: it lies beside numba's. ``name`` is
    ``stem.suffix``, ``sources`` are the modules on which it depends besides.
    """
    file = place_of(name, sources)
    if file is not None and file.is_file():
        return file.read_bytes()
    made = make()
    if file is not None:
        beside = file.with_suffix(f".{os.getpid()}")
        beside.write_bytes(made)
        beside.replace(file)
    return made


def place_of(name: str, sources: Sequence[Path]) -> Path | None:
    """Where that is kept, whether it is there or not; None where nothing is kept."""
    folder = os.environ.get("NUMBA_CACHE_DIR")
    if folder is None or not Path(folder).is_dir():
        return None
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__} {digest_of_kernels()}".encode())
    for source in sources:
        digest.update(source.read_bytes())
    stem, _, suffix = name.rpartition(".")
    return Path(folder) / f"{stem}-{digest.hexdigest()[:16]}.{suffix}"


def emitted(module: str, *more: str) -> str:
    """What a module writes to the file that it is handed, run by itself where numba optimises nothing. Raises
    ``ExportError``.
    """
    with tempfile.TemporaryDirectory(prefix="pkxyz-export-") as folder:
        out = Path(folder) / "kernels.ll"
        env = {
            **os.environ,
            "NUMBA_OPT": "0",
            "NUMBA_CPU_NAME": "generic",
            "NUMBA_CPU_FEATURES": "",
            "NUMBA_CACHE_DIR": folder,
            "NUMBA_DISABLE_JIT": "0",
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        }
        words = [sys.executable, "-W", "ignore", "-m", module, str(out), *more]
        done = subprocess.run(words, env=env, check=False, capture_output=True, text=True)
        if done.returncode != 0:
            last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
            raise ExportError(f"the kernels could not be compiled by {module}: {last}")
        return out.read_text(encoding="utf-8")

"""What takes long to make, kept beside numba's compiled kernels, whose folder goes with a digest of every kernel."""

import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import llvmlite
import numba

_HERE = Path(__file__).parent


def kept(name: str, sources: Sequence[str], make: Callable[[], bytes]) -> bytes:
    """What ``make`` gives, or gave before: ``name`` is ``stem.suffix``, ``sources`` are the modules of this room on
    which it depends beside the kernels.
    """
    file = _place(name, sources)
    if file is not None and file.is_file():
        return file.read_bytes()
    made = make()
    if file is not None:
        beside = file.with_suffix(f".{os.getpid()}")
        beside.write_bytes(made)
        beside.replace(file)
    return made


def _place(name: str, sources: Sequence[str]) -> Path | None:
    folder = os.environ.get("NUMBA_CACHE_DIR")
    if folder is None or not Path(folder).is_dir():
        return None
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__}".encode())
    for source in sources:
        digest.update((_HERE / source).read_bytes())
    stem, _, suffix = name.rpartition(".")
    return Path(folder) / f"{stem}-{digest.hexdigest()[:16]}.{suffix}"

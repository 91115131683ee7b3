"""Where compiled kernels are kept: a folder named after the source of all of them.

numba asks only whether the file of a kernel has changed, not whether the kernels that it calls have; a kernel compiled
against yesterday's callee would go on running. One digest over every file that holds a kernel makes that impossible.
"""

import hashlib
import os
import re
import shutil
import sys
import time
from pathlib import Path

_PACKAGES = ("pkxyz_ctrl", "hil", "sim")
_IMPORT = re.compile(r"^from ((?:pkxyz_ctrl|hil|sim)[\w.]*) import (.*)", re.MULTILINE)
_KEPT, _KEPT_S = 4, 24 * 3600  # so many folders, and all that were used within a day


def choose_kernel_cache() -> None:
    """Set numba's cache folder for this process; an own NUMBA_CACHE_DIR is respected, an unwritable home left to
    numba.
    """
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pkxyz_ctrl"
    folder = home / _digest_of_kernels()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
    except OSError:
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    _forget_old(home)


def _digest_of_kernels() -> str:
    """Over every file that holds a kernel and all of ours that these import: a kernel freezes the constants that it
    uses.
    """
    root = Path(__file__).parents[2]
    sources = {path: path.read_bytes() for package in _PACKAGES for path in sorted((root / package).rglob("*.py"))}
    relevant: set[Path] = set()
    waiting = [path for path, source in sources.items() if b"njit" in source]
    while waiting:
        path = waiting.pop()
        if path not in relevant and path in sources:
            relevant.add(path)
            for module, names in _IMPORT.findall(sources[path].decode()):
                folder = root / module.replace(".", "/")
                waiting += [folder.with_suffix(".py"), *(folder / f"{name}.py" for name in re.findall(r"\w+", names))]
    digest = hashlib.sha256(sys.version.encode())
    for path in sorted(relevant):
        digest.update(str(path).encode() + sources[path])
    return digest.hexdigest()[:16]


def _forget_old(home: Path) -> None:
    """Keep the folders used last, as a developer makes a new one with every edit of a kernel; and all that another
    process may be using.
    """
    try:
        used_s = {folder: folder.stat().st_mtime for folder in home.iterdir() if folder.is_dir()}
    except OSError:
        return
    for folder in sorted(used_s, key=used_s.__getitem__)[:-_KEPT]:
        if time.time() - used_s[folder] > _KEPT_S:
            shutil.rmtree(folder, ignore_errors=True)

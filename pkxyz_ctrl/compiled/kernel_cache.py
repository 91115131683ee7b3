"""Where compiled kernels are kept: a folder named after the source of all of them.

numba asks only whether the file of a kernel has changed, not whether the kernels that it calls have; a kernel compiled
against yesterday's callee would go on running. One digest over every file that holds a kernel makes that impossible.

What lies in the cache is run: it belongs to this user, and nobody else may write to it, or it is not used.
"""

import atexit
import hashlib
import os
import re
import shutil
import stat
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType

_PACKAGES = ("pkxyz_ctrl", "hil", "sim")
_IMPORT = re.compile(r"^from ((?:pkxyz_ctrl|hil|sim)[\w.]*) import (.*)", re.MULTILINE)
_KEPT, _KEPT_S = 4, 24 * 3600  # so many folders, and all that were used within a day
_READER = os.path.join("numba", "core", "caching.py")


def choose_kernel_cache() -> None:
    """Set numba's cache folder for this process; an own NUMBA_CACHE_DIR is respected, an unwritable home left to
    numba. One to which others may write is not used: a line on stderr says so, and kernels are compiled into a folder
    that goes with the process.
    """
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    home = _home()
    folder = home / _digest_of_kernels()
    try:
        home.mkdir(parents=True, exist_ok=True)
        if _is_ours_alone(home):
            home.chmod(0o700)
            folder.mkdir(exist_ok=True)
            os.utime(folder)
        if not (_is_ours_alone(home) and _is_ours_alone(folder)):
            folder = _passing_folder(home)
    except OSError:
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    if folder.parent == home:
        _forget_empty(folder)
        _forget_old(home)


def forget_damaged(error: BaseException) -> str | None:
    """A line for an error that is a compiled kernel which could not be read; the cache is removed, if we chose it."""
    frame: TracebackType | None = error.__traceback__
    while frame is not None and not frame.tb_frame.f_code.co_filename.endswith(_READER):
        frame = frame.tb_next
    folder = os.environ.get("NUMBA_CACHE_DIR")
    if frame is None or folder is None or isinstance(error, OSError):
        return None
    if Path(folder).parent != _home():
        return f"{folder}: the compiled kernels there are damaged; remove them and start the command again"
    shutil.rmtree(folder, ignore_errors=True)
    return f"{folder}: the compiled kernels there were damaged and have been removed; start the command again"


def _home() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pkxyz_ctrl"


def _is_ours_alone(folder: Path) -> bool:
    state = folder.stat()
    return state.st_uid == os.geteuid() and not state.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _passing_folder(home: Path) -> Path:
    words = "belongs to somebody else, or others may write to it, and what lies there would be run: it is not used, and"
    remedy = f"kernels are compiled anew each time; remove {home}, or give another XDG_CACHE_HOME"
    print(f"{home}: {words} {remedy}", file=sys.stderr, flush=True)
    folder = Path(tempfile.mkdtemp(prefix="pkxyz_ctrl-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _forget_empty(folder: Path) -> None:
    """What a machine that went down left behind: a file of no length, which numba can't read."""
    for place in os.scandir(folder):
        if place.is_dir():
            for file in os.scandir(place):
                if file.is_file() and file.stat().st_size == 0:
                    os.unlink(file)


def digest_of_kernels() -> str:
    """SHA-256 over the sources of all kernels, by their places in the package: the same wherever that is installed."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[2]
    for path, source in _sources_of_kernels().items():
        digest.update(f"{path.relative_to(root).as_posix()} {len(source)}\n".encode() + source)
    return digest.hexdigest()


def _digest_of_kernels() -> str:
    digest = hashlib.sha256(sys.version.encode())
    for path, source in _sources_of_kernels().items():
        digest.update(str(path).encode() + source)
    return digest.hexdigest()[:16]


def _sources_of_kernels() -> dict[Path, bytes]:
    """Every file that holds a kernel and all of ours that these import: a kernel freezes the constants that it uses."""
    root = Path(__file__).parents[2]
    sources = {path: path.read_bytes() for package in _PACKAGES for path in sorted((root / package).rglob("*.py"))}
    relevant: set[Path] = set()
    waiting = [path for path, source in sources.items() if b"njit" in source or b"@kernel" in source]
    while waiting:
        path = waiting.pop()
        if path not in relevant and path in sources:
            relevant.add(path)
            for module, names in _IMPORT.findall(sources[path].decode()):
                folder = root / module.replace(".", "/")
                waiting += [folder.with_suffix(".py"), *(folder / f"{name}.py" for name in re.findall(r"\w+", names))]
    return {path: sources[path] for path in sorted(relevant)}


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

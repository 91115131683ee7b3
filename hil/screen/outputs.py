"""Where a command writes: looked at before the work begins, and what the disk refuses later told in one line."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.config.refused import reason

_ELSEWHERE = "give another place to write"
_REMEDIES = {
    errno.ENOSPC: "make room, or " + _ELSEWHERE,
    errno.EDQUOT: "make room, or " + _ELSEWHERE,
    errno.EFBIG: "make room, or " + _ELSEWHERE,
    errno.EACCES: _ELSEWHERE,
    errno.EPERM: _ELSEWHERE,
    errno.EROFS: _ELSEWHERE,
    errno.ENOENT: _ELSEWHERE,
    errno.ENOTDIR: _ELSEWHERE,
    errno.EISDIR: _ELSEWHERE,
    errno.EEXIST: _ELSEWHERE,
}


def what_to_do(error: OSError) -> str | None:
    """One line about a disk that refuses, with what to do; None for an error that is none of that."""
    if error.errno not in _REMEDIES:
        return None
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{reason(error)}; {_REMEDIES[error.errno]}; what was written before is kept"


def folder_to_write(path: Path) -> Path:
    """The folder of ``--out``, made if need be. Raises ``ConfigError`` if it can't be written."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out: {path}: {reason(error)}; give another folder") from None
    if not os.access(path, os.W_OK):
        raise ConfigError(f"--out: {path}: permission denied; give another folder")
    return path


def picture_to_write(path: Path, option: str) -> Path:
    """The picture of an option. Raises ``ConfigError`` if it can't be written, or is of a kind that can't be drawn."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    kinds = FigureCanvasAgg.get_supported_filetypes()
    if path.suffix[1:].lower() not in kinds:
        raise ConfigError(f"{option}: {path}: no picture that can be drawn; end its name in .png, .svg or .pdf")
    if not path.parent.is_dir():
        raise ConfigError(f"{option}: {path.parent}: no such folder; make it, or give another picture")
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise ConfigError(f"{option}: {path}: cannot be written; give another picture")
    return path


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Raise ``ConfigError`` for what the disk refuses inside."""
    try:
        yield
    except OSError as error:
        raise ConfigError(f"--out: {folder}: {reason(error)}; give another folder") from None

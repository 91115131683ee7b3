"""Where a stage in operation is found: files of the user's own, that nobody else can read."""

import contextlib
import json
import os
import stat
import tempfile
from pathlib import Path
from typing import Any

DEFAULT = "stage"


class PlaceError(OSError):
    """The folder is not one to trust, or nothing is there; the message says what to do."""


def folder() -> Path:
    """The user's folder for stages in operation, made if there is none. Raises ``PlaceError``."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    base = Path(runtime) if runtime and os.access(runtime, os.W_OK) else Path(tempfile.gettempdir())
    path = base / f"pkxyz-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
    found = os.lstat(path)
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) & 0o077:
        raise PlaceError(f"{path}: must be a folder of yours that nobody else can enter: remove it and start again")
    return path


def write(name: str, kind: str, data: dict[str, Any]) -> Path:
    """Say what is there, in one step; returns the file."""
    path = _file(name, kind)
    draft = path.with_suffix(f".{os.getpid()}")
    with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w", encoding="utf-8") as file:
        json.dump(data, file)
    os.replace(draft, path)
    return path


def read(name: str, kind: str) -> dict[str, Any] | None:
    """What was said, or None if nothing is there, or whoever said it has ended."""
    try:
        data = json.loads(_file(name, kind).read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return data if isinstance(data, dict) and _is_alive(data.get("pid")) else None


def forget(name: str, kind: str) -> None:
    """Nothing is there any more."""
    _file(name, kind).unlink(missing_ok=True)


def _file(name: str, kind: str) -> Path:
    if not name or not name.replace("-", "").replace("_", "").isalnum():
        raise PlaceError(f"{name!r} is no name of a stage: letters, digits, - and _")
    return folder() / f"{name}.{kind}.json"


def _is_alive(pid: object) -> bool:
    if not isinstance(pid, int) or pid <= 0:
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return not _is_zombie(pid)


def _is_zombie(pid: int) -> bool:
    """Whether it has ended and only its parent does not know, as far as the system tells."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[:1] == ["Z"]

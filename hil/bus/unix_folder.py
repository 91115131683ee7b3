"""The folder of a Unix bus: whose it must be, and which of its entries are ours to remove.

Whoever can write to the folder can send frames, and whoever can move it can put another in its place. So nobody else
may do either, and nothing but our own sockets is ever taken away: a channel may be anyone's folder by mistake.
"""

import contextlib
import os
import re
import socket
import stat
import tempfile
from pathlib import Path

_OUR_NAME = re.compile(r"pkxyz-[0-9]+-[0-9]+")  # process and number of the socket in it
_OTHERS_ENTER_OR_WRITE = stat.S_IRWXG | stat.S_IRWXO
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_OTHERS_ENTER = stat.S_IXGRP | stat.S_IXOTH


class UnsafeFolderError(Exception):
    """The folder isn't one to put sockets in; the text says why and what to do."""


def folder_of(channel: str) -> Path:
    """The folder that a channel means: a path as it is, a name below the user's folder for such things."""
    if "/" in channel:
        return Path(channel)
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    base = Path(runtime) if runtime and os.access(runtime, os.W_OK) else Path(tempfile.gettempdir())
    return base / f"pkxyz-unix-{os.getuid()}" / channel


def open_folder(channel: str) -> Path:
    """The channel's folder, made if there is none. Raises ``UnsafeFolderError``, and OSError where it can't be made."""
    if channel in ("", ".", "..") or "\0" in channel:
        raise UnsafeFolderError("a channel is a name or the path of a folder")
    folder = folder_of(channel)
    is_named = "/" not in channel
    for own in (folder.parent, folder) if is_named else (folder,):
        _make(own)
        _require_private(own, is_named)
    _require_safe_way(folder.absolute())
    return folder


def _make(folder: Path) -> None:
    for missing in reversed([f for f in (folder, *folder.parents) if not os.path.lexists(f)]):
        missing.mkdir(mode=0o700, exist_ok=True)


def _require_private(folder: Path, is_named: bool) -> None:
    found = os.lstat(folder)
    if not stat.S_ISDIR(found.st_mode):
        kind = "a link" if stat.S_ISLNK(found.st_mode) else "no folder"
        raise UnsafeFolderError(f"{folder} is {kind}; give a path where there is nothing yet")
    if found.st_uid != os.getuid():
        raise UnsafeFolderError(f"{folder} belongs to another user; give a path of your own")
    if found.st_mode & _OTHERS_ENTER_OR_WRITE and is_named:
        folder.chmod(0o700)  # nobody but this module has a reason to make it; an earlier version did so by the umask
    elif found.st_mode & _OTHERS_ENTER_OR_WRITE:
        raise UnsafeFolderError(f"{folder} is open to other users; chmod 700 it, or give a path where there is nothing")


def _require_safe_way(folder: Path) -> None:
    """Nobody else may put another folder in this one's place: look at the links that lead there and at all folders
    above it, from the root on, as far as others come.
    """
    for link in folder.parents:
        if stat.S_ISLNK((found := os.lstat(link)).st_mode) and found.st_uid not in (0, os.getuid()):
            raise UnsafeFolderError(f"{link}, above {folder}, is another user's link; give a path of your own")
    for above in reversed(folder.resolve().parents):
        found = os.stat(above)
        if found.st_uid not in (0, os.getuid()):
            raise UnsafeFolderError(f"{above}, above {folder}, belongs to another user; give a path of your own")
        if found.st_mode & _OTHERS_WRITE and not found.st_mode & stat.S_ISVTX:
            raise UnsafeFolderError(f"{above}, above {folder}, can be written to by other users; give a path elsewhere")
        if not found.st_mode & _OTHERS_ENTER:
            return


def close_folder(channel: str) -> None:
    """The last one out takes away the folder that a name stands for; one that was given by its path stays."""
    if "/" not in channel:
        with contextlib.suppress(OSError):
            folder_of(channel).rmdir()


def socket_name(number: int) -> str:
    """Name of this process's socket ``number``."""
    return f"pkxyz-{os.getpid()}-{number}"


def sockets_in(folder: Path) -> list[str]:
    """Paths of what may be participants' sockets."""
    return [str(folder / name) for name in os.listdir(folder) if _OUR_NAME.fullmatch(name)]


def bind_privately(unbound: socket.socket, path: Path) -> None:
    """Bind for this user alone, whatever the umask. Raises OSError."""
    remove_socket(path)  # of a process that had our number and was killed
    os.fchmod(unbound.fileno(), 0o600)  # before there is a name that somebody could open
    unbound.bind(str(path))


def remove_socket(path: Path | str) -> None:
    """Remove a socket of ours; whatever else has that name stays."""
    with contextlib.suppress(OSError):
        found = os.lstat(path)
        if _OUR_NAME.fullmatch(os.path.basename(path)) and stat.S_ISSOCK(found.st_mode) and found.st_uid == os.getuid():
            os.unlink(path)

"""What the Unix bus may do with files: make its own sockets, remove its own sockets, and nothing else."""

import os
import re
import socket
import stat
import tempfile
from pathlib import Path

import can
import pytest

from hil.bus.unix_bus import UnixBus
from hil.bus.unix_folder import folder_of


def contents(folder):
    return {path.name: path.read_bytes() if path.is_file() else "not a file" for path in folder.iterdir()}


@pytest.fixture
def folder_of_somebody(tmp_path):
    """Files, some of them named like sockets of ours, a folder, a link, a pipe, and sockets of another program."""
    folder = tmp_path / "thesis"
    folder.mkdir(mode=0o700)
    for name in ("chapter1.tex", "1-1", f"{os.getpid()}-1", "pkxyz-1-1", "pkxyz-1-1.txt"):
        (folder / name).write_text(f"three years of work in {name}", encoding="utf-8")
    (folder / "pkxyz-2-2").mkdir()
    (folder / "pkxyz-3-3").symlink_to(folder / "chapter1.tex")
    os.mkfifo(folder / "pkxyz-4-4")
    for number in range(1, 200):  # whatever number the next socket of this process has
        name = folder / f"pkxyz-{os.getpid()}-{number}"
        name.write_text("mine", encoding="utf-8")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as living:
        living.bind(str(folder / "pkxyz-5-5"))
        living.listen()
        for kind, name in ((socket.SOCK_STREAM, "agent"), (socket.SOCK_DGRAM, "1-2")):
            with socket.socket(socket.AF_UNIX, kind) as dead:
                dead.bind(str(folder / name))
        yield folder


def test_a_folder_of_somebodys_loses_nothing(folder_of_somebody):
    before = contents(folder_of_somebody)
    with pytest.raises(can.CanInitializationError, match="in use"):
        UnixBus(str(folder_of_somebody))
    for path in folder_of_somebody.glob(f"pkxyz-{os.getpid()}-*"):
        path.unlink()
    with UnixBus(str(folder_of_somebody)) as bus, UnixBus(str(folder_of_somebody)) as other:
        for n in range(5):
            bus.send(can.Message(arbitration_id=n, is_extended_id=False))
            assert other.recv(1.0).arbitration_id == n
    kept = {name: text for name, text in before.items() if text != b"mine"}
    assert contents(folder_of_somebody) == kept


def test_an_empty_folder_of_somebodys_stays_and_one_that_a_name_stands_for_goes(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "empty").mkdir(mode=0o700)
    UnixBus(str(tmp_path / "empty")).shutdown()
    assert (tmp_path / "empty").is_dir()
    UnixBus("lab").shutdown()
    assert not folder_of("lab").exists()


def refused(channel, words):
    with pytest.raises(can.CanInitializationError, match=re.escape(words)) as caught:
        UnixBus(str(channel))
    assert "\n" not in str(caught.value)


def test_a_link_is_no_channel(tmp_path, monkeypatch):
    """Somebody else may have put it there: in /tmp, under the very name that we would take."""
    real = tmp_path / "real"
    real.mkdir(mode=0o700)
    (real / "pkxyz-1-1").write_text("kept", encoding="utf-8")
    (tmp_path / "link").symlink_to(real)
    refused(tmp_path / "link", "is a link")
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folder_of("lab").parent.symlink_to(real)
    refused("lab", "is a link")
    assert contents(real) == {"pkxyz-1-1": b"kept"}
    (tmp_path / "file").write_text("", encoding="utf-8")
    refused(tmp_path / "file", "is no folder")


@pytest.mark.parametrize("mode", [0o755, 0o770, 0o707, 0o710, 0o701])
def test_a_folder_that_others_may_use_is_no_channel(tmp_path, mode):
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(mode)
    refused(tmp_path / "open", "chmod 700")


def test_a_named_channel_of_an_earlier_version_is_closed_to_others(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    lab = folder_of("lab")
    lab.mkdir(parents=True, mode=0o755)
    with UnixBus("lab"):
        assert [stat.S_IMODE(folder.stat().st_mode) for folder in (lab.parent, lab)] == [0o700, 0o700]


def test_a_folder_of_another_user_is_no_channel(tmp_path, monkeypatch):
    (tmp_path / "theirs").mkdir(mode=0o700)
    uid = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: uid + 1)
    refused(tmp_path / "theirs", "belongs to another user")


def test_a_way_on_which_another_user_could_put_a_folder_of_his_is_no_way():
    """Without the sticky bit, whoever may write to a folder may move away what is in it."""
    with tempfile.TemporaryDirectory() as entered:  # not pytest's own, where nobody else comes
        public = Path(entered) / "public"
        public.mkdir()
        (public / "bus").mkdir(mode=0o700)
        Path(entered).chmod(0o755)
        for mode in (0o777, 0o775):
            public.chmod(mode)
            refused(f"{public}/bus", "can be written to by other users")
        for mode in (0o1777, 0o755):
            public.chmod(mode)
            UnixBus(f"{public}/bus").shutdown()
        public.chmod(0o777)
        Path(entered).chmod(0o700)  # nobody else comes this far
        UnixBus(f"{public}/bus").shutdown()


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o777])
def test_sockets_and_folders_are_for_the_user_alone_whatever_the_umask(tmp_path, umask):
    before = os.umask(umask & 0o077)
    try:
        with UnixBus(f"{tmp_path}/new/deep/bus"):
            folders = [tmp_path / "new", tmp_path / "new/deep", tmp_path / "new/deep/bus"]
            (path,) = folders[-1].iterdir()
            found = path.lstat().st_mode
            assert stat.S_ISSOCK(found)
            assert stat.S_IMODE(found) & ~0o600 == 0
            assert [stat.S_IMODE(folder.stat().st_mode) for folder in folders] == 3 * [0o700]
    finally:
        os.umask(before)


@pytest.mark.parametrize("channel", ["", ".", "..", "a\0b"])
def test_what_is_no_name_is_refused(channel):
    refused(channel, "a channel is a name or the path of a folder")

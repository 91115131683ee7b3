"""``pkxyz emulate`` asked for what it can't do: one line, exit code 2, nothing written. The loop itself is closed in
``make test-firmware``."""

import os

import pytest
from command_line import refused


@pytest.fixture
def programs(tmp_path, monkeypatch):
    """Both programs are there, for all that one can see."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("qemu-system-arm", "arm-none-eabi-gcc"):
        (folder / name).write_text("#!/bin/sh\nexit 1\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    return folder


@pytest.mark.parametrize("missing", ["qemu-system-arm", "arm-none-eabi-gcc"])
def test_a_missing_program_is_named_with_what_brings_it(tmp_path, capsys, monkeypatch, programs, missing):
    (programs / missing).unlink()
    monkeypatch.setenv("PATH", str(programs))
    line = refused(capsys, monkeypatch, "emulate", "--out", tmp_path / "out")
    assert f"{missing} is not on PATH" in line
    assert "apt-get install qemu-system-arm gcc-arm-none-eabi" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("nowhere",), "nowhere"),
        (("--controller", "nope"), "nope"),
        (("--controller", "mpc"), "is too short for cortex-m7, where the longest tick takes 5034 us"),
        (("--controller", "robust_20k", "--bus", "local_20k"), "bus 'local_20k' has no [can]"),
        (("--bus", "unix_2k"), "leads to other processes or devices"),
        (("--fault", "sense.9:stuck@1"), "no target is called 'sense.9'"),
    ],
)
def test_what_does_not_go_is_said_in_a_line(tmp_path, capsys, monkeypatch, programs, words, says):
    assert says in refused(capsys, monkeypatch, "emulate", *words, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_firmware_that_does_not_link(tmp_path, capsys, monkeypatch, programs):
    """A compiler that fails says so before anything is written; what lies in the folder stays as it is."""
    monkeypatch.setattr("hil.emulator.image.object_code", lambda **_: b"")
    assert "could not link the firmware" in refused(capsys, monkeypatch, "emulate", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_nothing_of_the_users_is_overwritten(tmp_path, capsys, monkeypatch, programs):
    (tmp_path / "thesis.tex").write_text("years")
    monkeypatch.setattr("hil.emulator.rig.image_of", lambda setup, place: place / "image.elf")
    assert str(tmp_path) in refused(capsys, monkeypatch, "emulate", "--out", tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "years"

"""The line to the board, with a program in the emulator's place."""

import os
import socket
import sys

from hil.emulator.board import Board
from hil.emulator.image import EMULATOR

EMULATED = """#!{python}
import re, socket, sys
listener = socket.socket(fileno=int(re.search(r"fd=(\\d+)", " ".join(sys.argv))[1]))
line, _ = listener.accept()
while line.recv(100):
    pass
"""


def test_what_is_told_in_two_parts_leaves_at_once(tmp_path, monkeypatch):
    """TCP held the second back until the first was acknowledged, which takes 40 ms: so long lasted every tick."""
    (tmp_path / EMULATOR).write_text(EMULATED.format(python=sys.executable))
    (tmp_path / EMULATOR).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with Board(tmp_path / "image", tmp_path) as board, socket.socket(fileno=os.dup(board._bus.fileno())) as line:
        assert line.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)

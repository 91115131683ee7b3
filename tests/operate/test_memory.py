"""Memory that a loop shares: whose it is."""

import numpy as np
import pytest

from hil.operate.commands import ANSWER
from hil.operate.memory import StageMemory

pytestmark = pytest.mark.at_rate


def _said(memory, words):
    answer = np.zeros(1, ANSWER)
    answer["words"] = words
    memory.writer("answers").write(answer.view(np.uint8).data)


def test_stages_of_one_name_in_two_folders_do_not_hear_each_other(tmp_path, monkeypatch):
    """Two programs of one user, each with a stage of the default name: one took the answers of the other's."""
    memories = []
    for folder in ("one", "other"):
        (tmp_path / folder).mkdir()
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / folder))
        memories.append(StageMemory.made("stage", 100))
    one, other = memories
    try:
        joined = [StageMemory(memory.path).reader("answers") for memory in memories]
        _said(one, b"of the one")
        assert b"of the one" in (joined[0].read() or b"")
        assert joined[1].read() is None
    finally:
        one.remove()
        other.remove()


def test_a_loop_that_was_killed_leaves_memory_that_gives_way(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    left = StageMemory.made("stage", 100)
    anew = StageMemory.made("stage", 200)
    assert anew.path == left.path
    assert StageMemory(anew.path).head["kept_ticks"][0] == 200
    anew.remove()
    assert not anew.path.exists()

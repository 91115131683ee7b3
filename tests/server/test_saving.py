"""What is kept of a stage in operation has its bounds."""

import pytest

from hil.operate.memory import StageMemory
from hil.server.saving import NotSavedError, save


def test_folders_of_faults_do_not_fill_the_disk(tmp_path):
    for n in range(100):
        (tmp_path / f"fault-{n}").mkdir()
    memory = StageMemory(tmp_path / "memory", kept_ticks=100)
    with pytest.raises(NotSavedError, match=r"holds 100 folders fault-\* already: move some away"):
        save(memory, {"period_us": 200}, 1.0, "why", tmp_path)

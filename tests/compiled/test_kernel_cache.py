"""Where compiled kernels are kept, and for how long."""

import os
import time
from pathlib import Path

from pkxyz_ctrl.compiled import kernel_cache


def test_old_folders_go_unless_they_are_the_last_or_somebody_may_be_using_them(tmp_path: Path) -> None:
    day_s = 24 * 3600
    ages_s = {f"old-{n}": (n + 2) * day_s for n in range(6)} | {f"new-{n}": n * 3600 for n in range(6)}
    for name, age_s in ages_s.items():
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, times=(time.time() - age_s,) * 2)
    kernel_cache._forget_old(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"new-{n}" for n in range(6)]
    for n in range(3):
        os.utime(tmp_path / f"new-{n}", times=(time.time() - 3 * day_s,) * 2)
    kernel_cache._forget_old(tmp_path)  # three are fresh; the fourth is kept as one of the last four
    assert len(list(tmp_path.iterdir())) == 4


def test_the_folder_is_named_after_what_the_kernels_are_made_of() -> None:
    digest = kernel_cache._digest_of_kernels()
    assert digest == kernel_cache._digest_of_kernels()
    assert len(digest) == 16

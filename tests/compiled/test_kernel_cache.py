"""Where compiled kernels are kept, and for how long."""

import os
import re
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numba
import pytest

from pkxyz_ctrl.compiled import kernel_cache

ROOT = Path(__file__).parents[2]


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


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache's home of a process that has chosen none yet."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")  # so that it is put back
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(numba.config, "CACHE_DIR", numba.config.CACHE_DIR)
    return tmp_path / "pkxyz_ctrl"


def chosen() -> Path:
    kernel_cache.choose_kernel_cache()
    return Path(os.environ["NUMBA_CACHE_DIR"])


@pytest.mark.parametrize("before", [None, 0o755, 0o700])
def test_the_cache_is_for_its_user_alone(home: Path, before: int | None, capsys: pytest.CaptureFixture[str]) -> None:
    if before is not None:
        home.mkdir()
        home.chmod(before)
    folder = chosen()
    assert folder.parent == home
    assert stat.S_IMODE(home.stat().st_mode) == 0o700
    assert str(folder) == numba.config.CACHE_DIR
    assert capsys.readouterr() == ("", "")


def spoiled_mode(home: Path, folder: Path) -> None:
    home.chmod(0o777)


def spoiled_group(home: Path, folder: Path) -> None:
    home.chmod(0o770)


def spoiled_inside(home: Path, folder: Path) -> None:
    folder.chmod(0o777)


def spoiled_owner(home: Path, folder: Path) -> None:
    os.chown(home, 54321, -1)


def spoiled_owner_inside(home: Path, folder: Path) -> None:
    os.chown(folder, 54321, -1)


def spoiled_link(home: Path, folder: Path) -> None:
    """Another user's folder under our name, by a link."""
    elsewhere = home.with_name("elsewhere")
    home.rename(elsewhere)
    elsewhere.chmod(0o777)
    home.symlink_to(elsewhere)


@pytest.mark.parametrize(
    "spoil", [spoiled_mode, spoiled_group, spoiled_inside, spoiled_owner, spoiled_owner_inside, spoiled_link]
)
def test_a_cache_that_others_can_write_to_is_never_run(
    home: Path, spoil: Callable[[Path, Path], None], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compiled kernels are pickles: to load one is to run it."""
    if "owner" in spoil.__name__ and os.geteuid() != 0:
        pytest.skip("only root can give files away")
    folder = chosen()
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    spoil(home, folder)
    other = chosen()
    assert home.resolve() not in other.resolve().parents
    assert stat.S_IMODE(other.stat().st_mode) == 0o700
    assert str(other) == numba.config.CACHE_DIR
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{home}: belongs to somebody else, or others may write to it")
    os.rmdir(other)


def test_an_own_choice_of_the_users_is_respected(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert chosen() == tmp_path
    assert not home.exists()


_KERNEL = """
from numba import njit
@njit(cache=True)
def kernel(x):
    return 2 * x
"""


@pytest.mark.parametrize("share", [0.0, 0.7])
@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_a_damaged_kernel_is_compiled_anew_or_told_in_a_line(
    home: Path, tmp_path: Path, suffix: str, share: float
) -> None:
    """An empty file is forgotten before anybody reads it; a torn one costs a line, and the next start is well."""
    (tmp_path / "mine.py").write_text(_KERNEL)
    program = """if True:
        import os, sys
        sys.path[:0] = [sys.argv[1]]
        import pkxyz_ctrl
        from pkxyz_ctrl.compiled.kernel_cache import forget_damaged
        import mine
        try:
            print(mine.kernel(21), os.environ["NUMBA_CACHE_DIR"])
        except Exception as error:
            print(forget_damaged(error))
    """
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}

    def run() -> str:
        done = subprocess.run(
            [sys.executable, "-c", program, str(tmp_path)], env={**environment, "XDG_CACHE_HOME": str(tmp_path)},
            text=True, capture_output=True, check=True, cwd=ROOT,
        )  # fmt: skip
        assert done.stderr == ""
        return done.stdout

    assert run().startswith("42 ")
    (file,) = home.rglob(f"mine.*.{suffix}")
    os.truncate(file, int(file.stat().st_size * share))
    told = run()
    if share == 0:
        assert told.startswith("42 ")
    else:
        assert told.endswith("were damaged and have been removed; start the command again\n")
        assert not file.exists()
    assert run().startswith("42 ")


def test_what_is_damaged_elsewhere_is_not_ours_to_remove(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert kernel_cache.forget_damaged(ValueError("of something else")) is None
    reader = compile("raise EOFError('Ran out of input')", "/x/numba/core/caching.py", "exec")
    with pytest.raises(EOFError) as torn:
        exec(reader)
    line = kernel_cache.forget_damaged(torn.value)
    assert line == f"{tmp_path}: the compiled kernels there are damaged; remove them and start the command again"
    assert tmp_path.is_dir()


def test_every_module_of_the_harness_has_the_cache_chosen_before_its_kernels() -> None:
    """numba asks for the folder when a kernel is defined: whoever imports sim, numba or a kernel imports us, too."""
    packages = {path.parent for path in (ROOT / "hil").rglob("__init__.py") if "import pkxyz_ctrl" in path.read_text()}
    defining = re.compile(r"^(?:from|import) (?:sim|numba)\b", re.MULTILINE)
    ours = re.compile(r"^(?:from|import) pkxyz_ctrl\b", re.MULTILINE)
    found = [path for path in sorted((ROOT / "hil").rglob("*.py")) if defining.search(path.read_text())]
    assert len(found) > 8
    for path in found:
        text = path.read_text()
        first = ours.search(text)
        early = (
            first is not None
            and first.start() < (re.search(r"^from sim\b|^import sim\b|@njit|@kernel", text, re.M) or first).end()
        )
        assert early or packages & {path.parent, path.parent.parent}, path

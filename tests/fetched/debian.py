"""Debian's packages, unpacked beside the checkout: programs that tests need and that nobody has to install."""

import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path


def fetched(packages: Sequence[str], root: Path, *, with_dependencies: bool = False) -> str:
    """Have packages unpacked in ``root``; with those that this machine lacks for them, if asked for. Empty if they are
    there, else why not.
    """
    if not (shutil.which("apt-get") and shutil.which("dpkg-deb")):
        return "packages are fetched with apt-get and unpacked with dpkg-deb, which are not here"
    mark = root / f".unpacked-{'-'.join(packages)}"
    if mark.is_file():
        return ""
    root.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=root.parent) as folder:
        said = _download(packages, Path(folder), with_dependencies=with_dependencies)
        if said:
            _apt("update", cwd=Path(folder))
            said = _download(packages, Path(folder), with_dependencies=with_dependencies)
        if said:
            return said
        for archive in sorted(Path(folder).glob("*.deb")):
            subprocess.run(["dpkg-deb", "-x", archive, root], check=True)
    mark.touch()
    return ""


def _download(packages: Sequence[str], folder: Path, *, with_dependencies: bool) -> str:
    wanted = list(packages)
    if with_dependencies:
        plan = _apt("install", "--simulate", "--no-install-recommends", *packages, cwd=folder)
        if plan.returncode != 0:
            return f"no packages {' '.join(packages)}: {' '.join(plan.stderr.split())[-200:]}"
        wanted = [line.split()[1] for line in plan.stdout.splitlines() if line.startswith("Inst ")]
    done = _apt("download", *wanted, cwd=folder)
    return "" if done.returncode == 0 else f"no packages {' '.join(packages)}: {' '.join(done.stderr.split())[-200:]}"


def _apt(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["apt-get", "-q", *words], cwd=cwd, check=False, capture_output=True, text=True)

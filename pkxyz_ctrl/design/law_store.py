"""Designed laws, kept: what follows from the same files, sources and libraries is designed and checked once.

Designing needs python-control, filterpy and scipy's solvers, whose import alone takes longer than a run.
"""

import hashlib
import os
import sys
import tempfile
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.loop import cycle

_LIBRARIES = ("numpy", "scipy", "control", "filterpy")
_KEPT = 256
_ELSEWHERE: Final = {"can": {"channel"}}
"""Of a bus: where it is says nothing of a law, and each stage that is served has a channel of its own."""
_SEAL_BYTES = hashlib.sha256().digest_size


def law_of(stage: StageConfig, controller: ControllerConfig, bus: BusConfig, *, autostart: bool) -> NDArray[np.void]:
    """``design.law.design_law``, or what it returned before for the same; raises what it raises.

    A file that is not whole is no file. Where nothing can be kept (no cache folder, no room) it is designed each time.
    """
    path = _path_of(stage, controller, bus, autostart)
    law = _read(path) if path is not None else None
    if law is None:
        from pkxyz_ctrl.design.law import design_law
        from pkxyz_ctrl.stage import Stage

        law = design_law(Stage(stage), controller, bus, autostart=autostart)
        if path is not None:
            _keep(path, law)
    return law


def _path_of(stage: StageConfig, controller: ControllerConfig, bus: BusConfig, autostart: bool) -> Path | None:
    home = os.environ.get("NUMBA_CACHE_DIR")  # beside the kernels, which are newer than the sources, too
    if not home:
        return None
    digest = hashlib.sha256()
    for model, elsewhere in ((stage, None), (controller, None), (bus, _ELSEWHERE)):
        digest.update(model.model_dump_json(exclude=elsewhere).encode() + b"\0")
    digest.update(repr((autostart, _program())).encode())
    return Path(home) / "laws" / digest.hexdigest()[:32]


@cache
def _program() -> str:
    """Digest of what designs: the sources as they were when this process looked first, and the libraries."""
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(source.read_bytes())
    digest.update(repr((sys.version, [version(name) for name in _LIBRARIES], cycle.LAW)).encode())
    return digest.hexdigest()


def _read(path: Path) -> NDArray[np.void] | None:
    try:
        content = path.read_bytes()
    except OSError:
        return None
    seal, body = content[:_SEAL_BYTES], content[_SEAL_BYTES:]
    if hashlib.sha256(body).digest() != seal or len(body) != cycle.LAW.itemsize:
        return None
    return np.frombuffer(body, cycle.LAW)  # read-only, as bytes are


def _keep(path: Path, law: NDArray[np.void]) -> None:
    body = law.tobytes()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(hashlib.sha256(body).digest() + body)
        os.replace(file.name, path)  # whoever reads meanwhile sees all of it or nothing
        for old in sorted(path.parent.iterdir(), key=lambda p: p.stat().st_mtime)[:-_KEPT]:
            old.unlink(missing_ok=True)
    except OSError:
        return

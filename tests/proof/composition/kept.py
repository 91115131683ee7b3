"""Kernels of the exploration are kept between runs: a minute of compiling each time if not.

numba asks whether a kernel's own file has changed, not whether those that it calls have: hence a folder that is named
after all of them, within that of the controller's kernels.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

from pkxyz_ctrl.compiled.kernel_cache import choose_kernel_cache

choose_kernel_cache()
_SOURCES = sorted(Path(__file__).parent.glob("*.py"))
_HOME = os.environ.get("NUMBA_CACHE_DIR")
_DIGEST = hashlib.sha256(b"".join(path.read_bytes() for path in _SOURCES)).hexdigest()
_FOLDER = Path(_HOME) / f"exploration-{_DIGEST[:16]}" if _HOME else None


def kernel(function: Callable[..., Any]) -> Any:
    """``function``, compiled, and kept if there is a place. It takes no memory, and so counts no references, which took
    nine tenths of the search.
    """
    return _compiled(function, _nrt=False)


def kernel_with_memory(function: Callable[..., Any]) -> Any:
    """The same for one that makes arrays."""
    return _compiled(function)


def _compiled(function: Callable[..., Any], **options: bool) -> Any:
    if _FOLDER is None:
        return numba.njit(error_model="numpy", **options)(function)
    before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(_FOLDER)
    try:
        return numba.njit(error_model="numpy", cache=True, **options)(function)
    finally:
        numba.config.CACHE_DIR = before

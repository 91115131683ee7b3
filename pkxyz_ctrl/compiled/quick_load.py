"""Compiled kernels, loaded without what only compiling needs.

Before numba loads a kernel that it has kept, it brings in all that kernels could be compiled with: sixty modules and
scipy's linear algebra, a third of a second. Machine code needs none of it but the symbols of numba's run time. Whatever
does have to be compiled brings in the rest by itself.

A kernel that called linear algebra would need more symbols, and LLVM ends the process where one is missing:
``tests/compiled/test_quick_load.py`` forbids it.
"""

from typing import Any

from numba.core.caching import Cache
from numba.core.runtime.nrt import rtsys


def load_quickly() -> None:
    """From now on, in this process."""
    Cache.load_overload = _load


def _load(cache: Any, signature: Any, target: Any) -> Any:
    """``Cache.load_overload`` without ``target.refresh()``."""
    rtsys.initialize(target)
    with cache._guard_against_spurious_io_errors():
        return cache._load_overload(signature, target)

"""The first run compiles for a minute or so, and nobody should think that it hangs; the next ones load at once."""

import sys
from pathlib import Path


def say_if_compiling(*, quiet: bool) -> None:
    """Say so on stderr, if the kernels are not compiled yet; if they are, they need no compiler beside them."""
    from pkxyz_ctrl.compiled.quick_load import load_quickly
    from pkxyz_ctrl.loop.cycle import cycle

    load_quickly()

    cache = getattr(cycle, "_cache", None)  # absent when the compiler is switched off
    if not quiet and cache is not None and not any(Path(cache.cache_path).glob("cycle.cycle-*.nbi")):
        words = "First run here: compiling the kernels, which takes a minute or two. The next run starts at once."
        print(words, file=sys.stderr, flush=True)

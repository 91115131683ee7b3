"""The first run compiles for a minute or so; nobody should think that it hangs."""

import sys
from pathlib import Path


def say_if_compiling(*, quiet: bool) -> None:
    """Say so on stderr, if the kernels are not compiled yet."""
    from pkxyz_ctrl.loop.cycle import cycle

    cache = getattr(cycle, "_cache", None)  # absent when the compiler is switched off
    if not quiet and cache is not None and not any(Path(cache.cache_path).glob("cycle.cycle-*.nbi")):
        words = "First run here: compiling the kernels, which takes a minute or two. The next run starts at once."
        print(words, file=sys.stderr, flush=True)

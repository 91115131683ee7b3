"""python-can, loaded without what it brings in for logs in MF4, where that is installed: a second of each start.

Nobody writes such logs by it in our commands; `pkxyz recording --to mf4` has no need of it.
"""

import sys

_FOR_MF4 = "asammdf"


def load_can_quickly() -> None:
    """For a process of a command, before it loads what uses python-can: its ``MF4Writer`` then says that it lacks
    asammdf, which everybody else still finds.
    """
    if "can" in sys.modules or _FOR_MF4 in sys.modules:
        return
    sys.modules[_FOR_MF4] = None  # type: ignore[assignment]  # how Python says: not to be imported
    try:
        import can  # noqa: F401
    finally:
        del sys.modules[_FOR_MF4]

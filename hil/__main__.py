"""The way into ``pkxyz``. It loads nothing itself, so that Ctrl-C is one word while the rest is being loaded."""

import os
import signal
from typing import NoReturn


def main() -> NoReturn:
    """Run the command line."""
    signal.signal(signal.SIGINT, _leave)  # an import that is interrupted may end in anything; nothing can be lost yet
    from hil.cli import main as run

    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        run()
    except KeyboardInterrupt:
        _leave()


def _leave(*_: object) -> NoReturn:
    os.write(2, b"interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    main()

"""``pkxyz`` in a process of its own, beside what is measured."""

import contextlib
import signal
import subprocess
import sys
from collections.abc import Iterator

_ENDS_S = 20.0


@contextlib.contextmanager
def running(*words: str, is_heard: bool = False) -> Iterator["subprocess.Popen[str]"]:
    """``pkxyz`` with these words while this lasts; then it is asked to end, and killed if it does not.

    ``is_heard``: its output is a pipe and its complaints are shown; else both go nowhere.
    """
    out, err = (subprocess.PIPE, None) if is_heard else (subprocess.DEVNULL, subprocess.DEVNULL)
    process = subprocess.Popen([sys.executable, "-m", "hil", *words], stdout=out, stderr=err, text=True)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(_ENDS_S)
        except subprocess.TimeoutExpired:
            process.kill()

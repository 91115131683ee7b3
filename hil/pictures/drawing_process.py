"""The picture of a run, drawn by a process that loads matplotlib while the run goes on.

Loading it takes as long as a run of the default scenario, and has nothing to do with it. The process is begun before
anything else is loaded, waits at the end of a pipe, draws once and ends. It can't change what is told of a run: if it
fails for any reason, the picture is drawn here, and what is wrong comes to light here.
"""

import gc
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

from pkxyz_ctrl.io.realtime import cores

if TYPE_CHECKING:
    from hil.runs.run_folder import RunFolder
    from hil.runs.summary import Summary

_DRAWN = b"drawn"


class DrawingProcess:
    """Used as a context: within it the process is there, after it it is gone, whatever happened."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        if cores() > 1:  # else it would only take the time of the run
            beside = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "PYTHONSAFEPATH": "1"}
            self._process = subprocess.Popen(
                [sys.executable, "-c", "from hil.pictures.drawing_process import work; work()"],
                env=beside, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the run; whether it is drawn is decided there
            )  # fmt: skip
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is not None:
            self._process.kill()
            with self._process:
                pass
            self._process = None

    def draw(self, folder: "RunFolder", summary: "Summary") -> None:
        """As ``hil.pictures.run.draw``. Raises ``ConfigError``."""
        asked = pickle.dumps((folder.recording, folder.frames, summary, folder.picture))
        if summary.rows.ticks > 0 and not summary.has_learnt and self._answer(asked) == _DRAWN:
            return
        from hil.pictures.run import draw

        draw(folder, summary)

    def _answer(self, asked: bytes) -> bytes:
        """What the process says to it; empty if there is none, or it says nothing."""
        if self._process is None:
            return b""
        try:
            return self._process.communicate(asked)[0]
        except OSError:
            return b""


def work() -> None:
    """What the process does."""
    gc.disable()  # it ends before it would be worth it
    draw = _loaded()
    asked = sys.stdin.buffer.read()
    if asked:
        draw(*pickle.loads(asked))
        sys.stdout.buffer.write(_DRAWN)


def _loaded() -> Callable[..., None]:
    """What draws, with all that a first drawing would have to find: fonts, and how long a frame is on the wire."""
    from hil.bus.frame_time import frame_duration_ns
    from hil.pictures.report import draw_report
    from hil.pictures.style import sheet
    from pkxyz_ctrl.can.frame import Frame
    from pkxyz_ctrl.compiled.quick_load import load_quickly

    load_quickly()
    frame_duration_ns(Frame(0x080, b"\x01"), 1_000_000, 5_000_000)
    figure = sheet(1, 1, "x")
    figure.add_subplot(projection="3d")
    figure.canvas.draw()
    return draw_report

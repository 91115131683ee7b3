"""A run at rate as it goes: each change of mode, a fault when it happens, and on a terminal a line that moves."""

import sys
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from hil.runs.warnings import in_words
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import explain

_EVERY_S = 0.25


class LiveStatus:
    """Is shown every row of a run of ``ticks`` periods, in the process that writes them down."""

    def __init__(self, ticks: int, period_s: float, out: TextIO | None = None) -> None:
        self._ticks = ticks
        self._period_s = period_s
        self._out = out or sys.stderr
        self._moves = self._out.isatty()
        self._every = max(1, round(_EVERY_S / period_s))
        self._mode = -1
        self._warning = 0
        self._seen = self._missed = 0
        self._width = 0

    def __call__(self, row: NDArray[np.void]) -> None:
        """Take note of the next row, (1,) of ``ROW``."""
        overrun, status = int(row["overrun"][0]), int(row["sense_status"][0])
        self._seen += 1 + overrun
        self._missed += overrun + (status & 1)
        mode = int(row["mode"][0])
        if mode != self._mode:
            self._mode = mode
            self._say(f"{self._seen * self._period_s:9.3f} s  {Mode(mode).name.lower().replace('_', '-')}")
            if mode == Mode.FAULT:
                self._say(f"{'':11}  {explain(int(row['trips'][0]))}")
        warning = int(row["warning"][0])
        if warning != self._warning:
            self._warning = warning
            words = in_words(warning, float(row["warning_share"][0])) or "what had changed is back"
            self._say(f"{self._seen * self._period_s:9.3f} s  warning: {words}")
        if self._moves and (self._seen % self._every == 0 or self._seen >= self._ticks):
            self._move()

    def _say(self, words: str) -> None:
        self._out.write(f"{self._cleared()}{words}\n")
        self._out.flush()

    def _move(self) -> None:
        words = f"{self._seen * self._period_s:9.3f} of {self._ticks * self._period_s:g} s, {self._missed} ticks missed"
        self._out.write(f"{self._cleared()}{words}")
        self._width = len(words)
        self._out.write(self._cleared() if self._seen >= self._ticks else "")
        self._out.flush()

    def _cleared(self) -> str:
        """What takes the line away that moves."""
        width, self._width = self._width, 0
        return f"\r{' ' * width}\r" if width else ""

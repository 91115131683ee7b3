"""A setup run once at the machine's clock, its rows kept in memory: for what is measured over any bus."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hil.lanes.ending import Ending
from hil.lanes.setup import Setup
from hil.lanes.wall import COMPANY_S, AmplifierGoneError, WallRig
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.loop.row import ROW

_SIZE = ROW.itemsize


class _Kept:
    """``wall.TakesTicks`` into memory that is there before the loop begins."""

    def __init__(self, ticks: int, on_progress: Callable[[int, int], None]) -> None:
        self.rows = np.zeros(ticks, ROW)
        self.rows.view(np.uint8)[:] = 0  # touched: a page that is first written to costs a tick its time
        self.count = 0
        self._on_progress = on_progress
        self._bytes = memoryview(self.rows.view(np.uint8))  # type: ignore[arg-type]

    def frame(self, frame: Frame, t_us: int) -> None:
        """Frames are not kept."""

    def row(self, row: memoryview) -> None:
        """Keep the row of a tick."""
        begin = self.count * _SIZE
        self._bytes[begin : begin + _SIZE] = row
        self.count += 1
        self._on_progress(self.count, len(self.rows))


def run_at_rate(
    setup: Setup,
    say: Callable[[str], object],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    company_s: float = COMPANY_S,
) -> tuple[NDArray[np.void], tuple[str, ...]]:
    """Rows (n,) of ``ROW`` of all ticks that were run, in order, and the faults in words.

    ``say`` is told what a person should know; ``on_progress`` the ticks done and in all, each tick: it has to be quick.
    Raises ``ConfigError`` for a bus without sockets, ``StartUpError``, and
    ``Ended`` where somebody asked for the end; the combs are at 0 V then, too.
    """
    kept = _Kept(setup.ticks, on_progress)
    with Ending() as ending:
        rig = WallRig(setup, kept, ending)
        try:
            rig.wait_for_others(say, company_s)
            say(rig.go_real_time())
            rig.start(say)
            rig.run()
        except AmplifierGoneError:
            say(f"the amplifier has fallen silent after {kept.count * setup.bus.period_s:.1f} s")
        finally:
            rig.close()
    return kept.rows[: kept.count], tuple(rig.controller.faults)

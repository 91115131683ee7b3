"""The pictures of a run, drawn into its folder."""

from typing import TYPE_CHECKING

from hil.lanes.lane import Lane
from hil.pictures.report import draw_report
from hil.runs.summary import Summary

if TYPE_CHECKING:
    from hil.runs.run_folder import RunFolder


def draw(folder: "RunFolder", summary: Summary, lateness_us: list[int] | None = None) -> None:
    """Draw what is recorded already; there is no picture of a run that never began. ``lateness_us``: wake-ups by whole
    microseconds of lateness, of a run at rate. Raises ``ConfigError``.
    """
    if summary.rows.ticks == 0:
        return
    with folder.in_one_line():
        if summary.lane is Lane.WALL:
            from hil.pictures.wall import draw_wall

            draw_wall(folder.recording, summary, lateness_us or [], folder.picture)
        else:
            draw_report(folder.recording, folder.frames, summary, folder.picture)
        if summary.has_learnt:
            from hil.pictures.learning import draw_learning

            draw_learning(folder.recording, summary, folder.learning_picture)

"""``pkxyz latency``: how late this machine wakes the loop, and how long a cycle takes."""

import json
import shutil
from pathlib import Path
from typing import Annotated, Any

import typer

from hil.screen.outputs import picture_to_write


def latency(
    period_us: Annotated[int, typer.Option(help="Period of the loop in microseconds.")] = 200,
    seconds: Annotated[float, typer.Option(help="How long to measure.")] = 5.0,
    out: Annotated[Path | None, typer.Option(help="PNG of the histograms to write.")] = None,
    cyclictest: Annotated[str | None, typer.Option(help="Its path, where it is not in PATH.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON with the histograms, and nothing else.")] = False,
) -> None:
    """Run the controller at rate without a bus and show its lateness, beside cyclictest's if that is installed."""
    from hil.studies.latency import measure

    if out is not None:
        picture_to_write(out, "--out")
    measured = measure(period_us, seconds, cyclictest or shutil.which("cyclictest"))
    figures = measured.figures()
    if out is not None:
        from hil.pictures.latency import draw_latency

        draw_latency(measured, out)
    if as_json:
        histograms = {"lateness_us": measured.lateness_us, "cycle_us": measured.cycle_us}
        if measured.cyclictest_us is not None:
            histograms["cyclictest_us"] = measured.cyclictest_us
        counts = {name: {str(us): n for us, n in enumerate(h) if n} for name, h in histograms.items()}
        print(json.dumps(figures | {"histograms": counts}))
    else:
        _show(figures, out)
    raise typer.Exit(128 + measured.ended_by if measured.ended_by else 0)


def _show(figures: dict[str, Any], out: Path | None) -> None:
    print(figures["real_time"])
    print(f"{figures['ticks']} ticks of {figures['period_us']} us, {figures['missed_ticks']} missed")
    print(f"{'us':30}{'p50':>8}{'p99':>8}{'p99.9':>8}{'max':>8}")
    for name, words in (
        ("lateness_us", "loop awake after the instant"),
        ("cycle_us", "cycle, from awake to recorded"),
        ("cyclictest_us", "cyclictest, a thread in C"),
    ):
        found = figures[name]
        numbers = "".join(f"{v:8}" for v in found.values()) if found else "   not installed (package rt-tests)"
        print(f"{words:30}{numbers}")
    if figures["cyclictest_us"]:
        ours, theirs = figures["lateness_us"]["p99_9"], figures["cyclictest_us"]["p99_9"]
        print(f"p99.9 is {ours / max(theirs, 1):.2f} times cyclictest's")
    if out is not None:
        print(f"histograms are in {out}")

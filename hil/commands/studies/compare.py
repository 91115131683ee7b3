"""``pkxyz compare``: several laws on one scenario and plant, one table and one picture."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.lanes.lane import Lane
from hil.screen.choices import InProcessLane
from hil.screen.first_run import say_if_compiling
from hil.screen.options import AsJson, ChosenLane, FileInstead, ScenarioName
from hil.screen.outputs import picture_to_write
from hil.screen.progress import progress_bar
from hil.screen.terminal import bad, plain_table, print_whole, say

if TYPE_CHECKING:
    from hil.studies.compare import Compared


def compare(
    scenario: ScenarioName = "raster",
    controllers: Annotated[
        str, typer.Option(metavar="A,B,...", help="Names or files, separated by commas; default: one for each law.")
    ] = "",
    stage: FileInstead = None,
    plant: FileInstead = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Instead of the scenario's.")] = None,
    lane: ChosenLane = InProcessLane.FAST,
    out: Annotated[Path, typer.Option(help="The picture to write.")] = Path("compare.png"),
    as_json: AsJson = False,
) -> None:
    """Run all laws on one scenario and plant. Exit code 0 if each ran without a fault, 1 if not, 2 for bad input."""
    from hil.pictures.compare import draw
    from hil.studies.compare import DEFAULT
    from hil.studies.compare import compare as run_all

    picture_to_write(out, "--out")
    say_if_compiling(quiet=as_json)
    names = tuple(name.strip() for name in controllers.split(",") if name.strip()) or DEFAULT
    with progress_bar("laws", quiet=as_json) as tell:
        runs = run_all(scenario, names, stage=stage, plant=plant, seed=seed, lane=Lane(lane.value), on_progress=tell)
    title = f"{scenario}{f' on {plant}' if plant else ''}{f', {stage}' if stage else ''}"
    if drawn := any(run.figures.get("rms_error_nm") for run in runs):
        draw(runs, title, out)
    if as_json:
        data = {
            "scenario": scenario,
            "stage": stage,
            "plant": plant,
            "seed": seed,
            "lane": lane.value,
            "picture": str(out) if drawn else None,
        }
        print(json.dumps(data | {"laws": [run.as_json() for run in runs]}, allow_nan=False))
    else:
        _show(runs, title, out if drawn else None)
    raise typer.Exit(0 if all(run.problem is None for run in runs) else 1)


def _show(runs: "list[Compared]", title: str, out: Path | None) -> None:
    headings = ("controller", "rms x / y / z (nm)", "largest (nm)", "hold (nm)", "at a limit", "gave up", "")
    table = plain_table(*headings, left=("",), title=title)
    for run in runs:
        found = run.figures
        worst = {k: max(found[k].values()) if found.get(k) else None for k in ("max_error_nm", "hold_noise_nm")}
        rms = " / ".join(f"{v:.2f}" for v in found["rms_error_nm"].values()) if found.get("rms_error_nm") else "none"
        cells = [f"{worst[k]:.2f}" if worst[k] is not None else "none" for k in worst]
        ticks = [str(found["saturated_ticks"]), str(run.gave_up)] if found else ["", ""]
        verdict = "" if run.problem is None else bad("fault" if found else "refused")
        table.add_row(run.controller, rms, *cells, *ticks, verdict)
    print_whole(table)
    for run in runs:
        if run.problem is not None:
            say(bad(run.controller), f": {run.problem}")
    say("no law ran, so there is no picture" if out is None else f"picture: {out}")

"""``pkxyz montecarlo``: a law against many plants, and any one of them again."""

import dataclasses
import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.lanes.lane import Lane
from hil.screen.first_run import say_if_compiling
from hil.screen.options import AsJson, ClusterAddress, ClusterTls, FileInstead, ScenarioName, Workers
from hil.screen.outputs import folder_to_write
from hil.screen.progress import progress_bar
from hil.screen.terminal import bad, plain_table, print_whole, say

if TYPE_CHECKING:
    from hil.runs.scenario import Scenario


def montecarlo(
    scenario: ScenarioName = "raster",
    plants: Annotated[int, typer.Option(min=1, help="How many, sampled by the seeds from --seed on.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="The first plant's.")] = 1,
    tolerances: Annotated[str, typer.Option(help="Name or file of what they are sampled from.")] = "wide",
    controller: FileInstead = None,
    stage: FileInstead = None,
    plant: Annotated[str | None, typer.Option(help="Name or file of the plant that is changed.")] = None,
    bus: FileInstead = None,
    workers: Workers = None,
    cluster: ClusterAddress = None,
    cluster_tls: ClusterTls = None,
    alone: Annotated[
        int | None, typer.Option(metavar="SEED", min=0, help="Run this plant alone, with a recording and a report.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for results.jsonl, summary.json and distributions.png.")] = Path(
        "montecarlo"
    ),
    as_json: AsJson = False,
) -> None:
    """Run a law against plants sampled from tolerances, on the fast lane. Call it again to go on, or for more plants.

    Exit code 0 if every loop held, 1 if one did not, 2 for bad input, 130 if interrupted (what is done is kept).
    """
    from hil.api.montecarlo import montecarlo as sampled_plants
    from hil.pictures.montecarlo import draw_montecarlo
    from hil.runs.scenario import load_scenario

    loaded = load_scenario(scenario, controller=controller, stage=stage, plant=plant, bus=bus)
    if alone is not None:
        _run_alone(loaded, tolerances, alone, out, as_json=as_json)
    folder_to_write(out)
    say_if_compiling(quiet=as_json)
    with progress_bar("plants", quiet=as_json) as tell:
        found = sampled_plants(
            loaded, plants=plants, first_seed=seed, tolerances=tolerances, out=out, workers=workers, cluster=cluster,
            cluster_tls=cluster_tls, on_progress=tell,
        )  # fmt: skip
    data = found.summary | {
        "controller": loaded.controller.name, "scenario": loaded.config.name, "tolerances": tolerances,
        "digest": found.study.digest(), "first_seed": seed, "interrupted": found.interrupted, "folder": str(out),
    }  # fmt: skip
    (out / "summary.json").write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    draw_montecarlo(found.study, found.results, out / "distributions.png")
    if as_json:
        print(json.dumps(data, allow_nan=False))
    else:
        options = {
            "--tolerances": tolerances, "--controller": controller, "--stage": stage, "--plant": plant, "--bus": bus,
            "--out": str(out), "--alone": str(data["worst_seed"]),
        }  # fmt: skip
        words = [word for name, value in options.items() if value is not None for word in (name, value)]
        _show(data, shlex.join(["pkxyz", "montecarlo", scenario, *words]))
    raise typer.Exit(130 if found.interrupted else 1 if data["not_held"] else 0)


def _run_alone(loaded: "Scenario", tolerances: str, seed: int, out: Path, *, as_json: bool) -> None:
    """One plant with everything a run leaves; the figures are those of the study, bit for bit."""
    from hil.pictures.run import draw
    from hil.runs.run import run_into
    from hil.runs.run_folder import RunFolder
    from hil.studies.montecarlo import Study, run_one
    from pkxyz_ctrl.config.files import load
    from pkxyz_ctrl.design.margins.tolerances import Tolerances

    study = Study(loaded, load("tolerances", tolerances, Tolerances))
    scenario = study.sampled(seed)
    folder = RunFolder(out / f"seed-{seed}", replace=True)
    ran = run_into(folder, scenario, Lane.FAST)
    draw(folder, ran)
    result, case = run_one(study, seed), study.tolerances.sample(seed)
    data = vars(result) | {"sampled": dataclasses.asdict(case.perturbation), "folder": str(folder.path)}
    data["strokes_um"] = [float(q) * 1e6 for q in case.strokes_m]
    if as_json:
        print(json.dumps(data, allow_nan=False))
    else:
        for name, value in data.items():
            say(f"{name}: {value}")
    raise typer.Exit(0 if result.ok else 1)


def _show(data: dict[str, Any], worst_alone: str) -> None:
    say(f"{data['controller']}, {data['scenario']}, {data['plants']} plants of {data['tolerances']!r}")
    table = plain_table("", "median", "95 %", "largest", "its seed")
    for name in ("rms_error_nm", "hold_noise_nm", "peak_s"):
        if (d := data[name]) is not None:
            table.add_row(name, *(f"{d[key]:.3g}" for key in ("median", "p95", "max")), str(d["max_seed"]))
    print_whole(table)
    if data["not_held"]:
        say(bad(f"{data['not_held']} did not hold"))
    say(f"the worst one alone: {worst_alone}")

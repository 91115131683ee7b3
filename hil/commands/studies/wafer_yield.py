"""``pkxyz yield``: which share of a wafer works, and why the rest does not."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any

import typer

from hil.screen.outputs import folder_to_write, writing
from hil.screen.progress import progress_bar
from hil.screen.terminal import bad, good, plain_table, print_whole, say


def wafer_yield(
    process: Annotated[str, typer.Argument(help="A shipped process' name or a TOML file.")] = "oreo_drie",
    stage: Annotated[str, typer.Option(help="The drawing: a stage's name or a TOML file.")] = "reconstructed",
    devices: Annotated[int, typer.Option(min=1, max=100_000_000, help="How many, from whole wafers.")] = 10_000,
    seed: Annotated[int, typer.Option(min=0, help="Of all wafers.")] = 1,
    sensitivity: Annotated[
        int, typer.Option(metavar="N", min=0, max=100_000, help="Devices for the causes; 0: leave them out.")
    ] = 2048,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; default: as many as cores.")] = None,
    dask: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Scheduler of a Dask cluster to work on instead.")
    ] = None,
    alone: Annotated[int | None, typer.Option(metavar="NUMBER", min=0, help="This device alone.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for devices/*.parquet, summary.json and wafer.png.")] = Path(
        "yield"
    ),
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else.")] = False,
) -> None:
    """Sample devices from a process, and see which meet its requirements. Call it again to go on, or for more devices.

    Exit code 0, 2 for bad input, 130 if interrupted: then with the result of what was done, which is kept.
    """
    from hil.pictures.wafer.overview import draw_wafer
    from hil.studies.spread.workers import cores
    from hil.studies.wafer.causes import ALL, causes
    from hil.studies.wafer.shares import share_of
    from hil.studies.wafer.study import WaferStudy, run_study
    from hil.studies.wafer.table import Table
    from pkxyz_ctrl.config.files import load
    from pkxyz_ctrl.config.stage import StageConfig
    from pkxyz_ctrl.fabrication.process import Process

    study = WaferStudy(load("processes", process, Process), load("stages", stage, StageConfig), seed)
    if alone is not None:
        _alone(study.alone(alone), as_json=as_json)
        return
    folder_to_write(out)
    with writing(out):
        table, found, interrupted = Table(out / "devices", study.digest()), None, False
        try:
            with progress_bar("devices", quiet=as_json) as tell:
                run_study(study, devices, table, workers or cores(), dask, tell)
            if sensitivity:
                with progress_bar("causes", quiet=as_json) as tell:
                    found = causes(study, sensitivity, tell)
        except KeyboardInterrupt:
            interrupted = True
        if not table.parts:
            raise KeyboardInterrupt
        names = ["wafer", "x_m", "y_m", *study.process.requirements, *study.requirement_columns]
        columns = table.read(names, devices)
        shares = {
            name.removeprefix("ok."): share_of(columns[name], columns["wafer"]) for name in study.requirement_columns
        }
        data = {
            "process": study.process.name, "stage": study.stage.name, "seed": seed, "digest": study.digest(),
            "devices": len(columns["wafer"]), "interrupted": interrupted,
            "shares": {name: dataclasses.asdict(share) for name, share in shares.items()},
            "causes": None if found is None else found.as_json(), "folder": str(out),
        }  # fmt: skip
        (out / "summary.json").write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        draw_wafer(study.process, {**columns, ALL: columns["ok"]}, shares, found, out / "wafer.png")
    if as_json:
        print(json.dumps(data, allow_nan=False))
    else:
        _show(data)
    raise typer.Exit(130 if interrupted else 0)


def _show(data: dict[str, Any]) -> None:
    say(f"{data['devices']} devices of {data['process']} by the drawing {data['stage']}, seed {data['seed']}")
    table = plain_table("requirement", "met", "95 %", left=("95 %",))
    for name, share in data["shares"].items():
        words = "all of them" if name == "ok" else name
        table.add_row(words, f"{share['value']:.2%}", f"{share['low']:.2%} to {share['high']:.2%}")
    print_whole(table)
    if data["causes"] is not None:
        share, without = data["causes"]["share"], data["causes"]["share_without"]
        best = sorted(without, key=lambda name: -without[name])[:3]
        said = ", ".join(f"{name} {100 * (without[name] - share):+.2f}" for name in best if without[name] > share)
        say(f"most is won without the spread of: {said}" if said else "no single cause costs devices")
    say(f"map, figures and causes: {data['folder']}/wafer.png; every device: {data['folder']}/devices/")


def _alone(data: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print(json.dumps({name: None if value in (float("inf"),) else value for name, value in data.items()}))
        return
    for name, value in data.items():
        if isinstance(value, bool):
            say(f"{name}: ", good("yes") if value else bad("no"))
        elif isinstance(value, list):
            say(f"{name}: " + ", ".join(f"{v:.4g}" for v in value))
        else:
            say(f"{name}: {value:.6g}" if isinstance(value, float) else f"{name}: {value}")

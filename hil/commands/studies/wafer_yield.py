"""``pkxyz yield``: which share of a wafer works, and why the rest does not."""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.screen.first_run import say_if_compiling
from hil.screen.options import AsJson, ClusterAddress, ClusterTls, FileInstead, Workers
from hil.screen.outputs import folder_to_write, writing
from hil.screen.progress import progress_bar
from hil.screen.terminal import bad, good, plain_table, print_whole, say

if TYPE_CHECKING:
    from hil.studies.spread.cluster import Cluster
    from hil.studies.wafer.causes import Causes
    from hil.studies.wafer.closed_loop import ClosedLoops
    from hil.studies.wafer.table import Table


def wafer_yield(
    process: Annotated[str, typer.Argument(help="A shipped process' name or a TOML file.")] = "oreo_drie",
    stage: Annotated[str, typer.Option(help="The drawing: a stage's name or a TOML file.")] = "reconstructed",
    devices: Annotated[int, typer.Option(min=1, max=100_000_000, help="How many, from whole wafers.")] = 10_000,
    seed: Annotated[int, typer.Option(min=0, help="Of all wafers.")] = 1,
    sensitivity: Annotated[
        int, typer.Option(metavar="N", min=0, max=100_000, help="Devices for the causes; 0: leave them out.")
    ] = 2048,
    loops: Annotated[
        int, typer.Option(metavar="N", min=0, max=1_000_000, help="Devices in a closed loop, one a wafer; 0: none.")
    ] = 64,
    scenario: Annotated[str, typer.Option(help="Name or file of what is run in the loop.")] = "raster",
    controller: FileInstead = None,
    known: Annotated[
        bool, typer.Option("--known/--shipped", help="Also under a law for the device as it is, or not.")
    ] = True,
    identified: Annotated[
        bool, typer.Option("--identified", help="Also under laws for what `pkxyz identify` finds of the device.")
    ] = False,
    workers: Workers = None,
    cluster: ClusterAddress = None,
    cluster_tls: ClusterTls = None,
    alone: Annotated[int | None, typer.Option(metavar="NUMBER", min=0, help="This device alone.")] = None,
    out: Annotated[
        Path, typer.Option(help="Folder for devices/ and loops/ (Parquet), summary.json and pictures.")
    ] = Path("yield"),
    as_json: AsJson = False,
) -> None:
    """Sample devices from a process, and see which meet its requirements. Call it again to go on, or for more devices.

    Exit code 0, 2 for bad input, 130 if interrupted: then with the result of what was done, which is kept.
    """
    from hil.runs.scenario import load_scenario
    from hil.studies.spread.cluster import cluster_at
    from hil.studies.wafer.closed_loop import ClosedLoops
    from hil.studies.wafer.study import WaferStudy
    from pkxyz_ctrl.config.files import load
    from pkxyz_ctrl.config.stage import StageConfig
    from pkxyz_ctrl.fabrication.process import Process
    from pkxyz_ctrl.io.realtime import cores

    study = WaferStudy(load("processes", process, Process), load("stages", stage, StageConfig), seed)
    closed = ClosedLoops(study, load_scenario(scenario, stage=stage, controller=controller), known, identified)
    if alone is not None:
        _alone({**(closed.device(alone) if loops else {}), **study.alone(alone)}, as_json=as_json)
        return
    spread = cluster_at(cluster, cluster_tls)
    folder_to_write(out)
    if loops:
        say_if_compiling(quiet=as_json)
    asked = _Asked(closed, devices, loops, sensitivity, workers or cores(), spread, out, as_json)
    with writing(out):
        data = asked.worked()
    if as_json:
        print(json.dumps(data, allow_nan=False))
    else:
        _show(data)
    raise typer.Exit(130 if data["interrupted"] else 0)


@dataclass(frozen=True)
class _Asked:
    """One call of the command."""

    closed: "ClosedLoops"
    devices: int
    loops: int
    sensitivity: int
    workers: int
    cluster: "Cluster | None"
    out: Path
    quiet: bool

    def worked(self) -> dict[str, Any]:
        """Do what is left to do, and write summary and pictures of what there is."""
        from hil.studies.wafer.causes import causes
        from hil.studies.wafer.closed_loop import PART_DEVICES
        from hil.studies.wafer.study import parts_for, run_study
        from hil.studies.wafer.table import Table

        study, found, interrupted = self.closed.wafers, None, False
        table = Table(self.out / "devices", study.digest())
        loops = Table(self.out / "loops", self.closed.digest()) if self.loops else None
        try:
            with progress_bar("devices", quiet=self.quiet) as tell:
                run_study(study, parts_for(study.process, self.devices), table, self.workers, self.cluster, tell)
            if loops is not None:
                if self.closed.identified:
                    _ = self.closed.mean_modes  # once here, not in each worker
                with progress_bar("loops", quiet=self.quiet) as tell:
                    run_study(self.closed, -(-self.loops // PART_DEVICES), loops, self.workers, self.cluster, tell)
            if self.sensitivity:
                with progress_bar("causes", quiet=self.quiet) as tell:
                    found = causes(study, self.sensitivity, tell)
        except KeyboardInterrupt:
            interrupted = True
        if not table.parts:
            raise KeyboardInterrupt
        return self._summed_up(table, loops, found, interrupted=interrupted)

    def _summed_up(
        self, table: "Table", loops: "Table | None", found: "Causes | None", *, interrupted: bool
    ) -> dict[str, Any]:
        from hil.pictures.wafer.loops import draw_loops
        from hil.pictures.wafer.overview import draw_wafer
        from hil.studies.wafer.shares import share_of

        study, in_loops = self.closed.wafers, {}
        names = ["wafer", "x_m", "y_m", *study.process.requirements, *study.requirement_columns]
        columns = table.read(names, self.devices)
        shares = {n.removeprefix("ok."): share_of(columns[n], columns["wafer"]) for n in study.requirement_columns}
        draw_wafer(study.process, columns, shares, found, self.out / "wafer.png")
        if loops is not None and loops.parts:
            rows = loops.read(["device", "handle_m", *self.closed.columns, *self.closed.verdict_columns], self.loops)
            in_loops = {n.removeprefix("ok."): share_of(rows[n], rows["device"]) for n in self.closed.verdict_columns}
            draw_loops(self.closed, rows, in_loops, self.out / "loops.png")
        data = {
            "process": study.process.name, "stage": study.stage.name, "seed": study.seed, "digest": study.digest(),
            "devices": len(columns["wafer"]), "shares": {name: asdict(share) for name, share in shares.items()},
            "loops": {name: asdict(share) for name, share in in_loops.items()},
            "causes": None if found is None else found.as_json(), "interrupted": interrupted, "folder": str(self.out),
        }  # fmt: skip
        (self.out / "summary.json").write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        return data


def _show(data: dict[str, Any]) -> None:
    say(f"{data['devices']} devices of {data['process']} by the drawing {data['stage']}, seed {data['seed']}")
    table = plain_table("requirement", "met", "95 %", left=("95 %",))
    for name, share in data["shares"].items():
        words = "all of them" if name == "ok" else name
        table.add_row(words, f"{share['value']:.2%}", f"{share['low']:.2%} to {share['high']:.2%}")
    print_whole(table)
    if data["loops"]:
        devices = next(iter(data["loops"].values()))["devices"]
        say(f"in a closed loop, {devices} devices, each law designed for: the drawing (shipped), the device (known)")
        if "identified.peak_s" in data["loops"]:
            say(
                "or what `pkxyz identify` finds of it from inside (identified), with an instrument outside (instrument)"
            )
        table = plain_table("requirement", "met", "95 %", left=("95 %",))
        for name, share in data["loops"].items():
            words = name if "." in name else f"{name}, all of them and the device's own"
            table.add_row(words, f"{share['value']:.1%}", f"{share['low']:.1%} to {share['high']:.1%}")
        print_whole(table)
    if data["causes"] is not None:
        share, without = data["causes"]["share"], data["causes"]["share_without"]
        best = sorted(without, key=lambda name: -without[name])[:3]
        said = ", ".join(f"{name} {100 * (without[name] - share):+.2f}" for name in best if without[name] > share)
        say(f"most is won without the spread of: {said}" if said else "no single cause costs devices")
    say(f"map, figures and causes: {data['folder']}/wafer.png; every device: {data['folder']}/devices/")


def _alone(data: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        endless = {name for name, value in data.items() if isinstance(value, float) and not math.isfinite(value)}
        print(json.dumps({name: None if name in endless else value for name, value in data.items()}))
        return
    for name, value in data.items():
        if isinstance(value, bool):
            say(f"{name}: ", good("yes") if value else bad("no"))
        elif isinstance(value, list):
            say(f"{name}: " + ", ".join(f"{v:.4g}" for v in value))
        else:
            say(f"{name}: {value:.6g}" if isinstance(value, float) else f"{name}: {value}")

"""``pkxyz yield``: which share of a wafer works, and why the rest does not."""

import json
import math
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.screen.first_run import say_if_compiling
from hil.screen.options import AsJson, ClusterAddress, ClusterTls, FileInstead, Workers
from hil.screen.outputs import folder_to_write, writing
from hil.screen.progress import progress_bar
from hil.screen.terminal import bad, good, note, plain_table, print_whole, say

if TYPE_CHECKING:
    from hil.studies.spread.cluster import Cluster
    from hil.studies.wafer.causes import Causes, Indices
    from hil.studies.wafer.closed_loop import ClosedLoops
    from hil.studies.wafer.loop_causes import LoopCauses
    from hil.studies.wafer.study import Parts
    from hil.studies.wafer.table import Table

LAW_WORDS = {
    "shipped": "the drawing", "identified": "what `pkxyz identify` finds from inside",
    "instrument": "what it finds with an instrument outside", "known": "the device as it is",
}  # fmt: skip
_LEAST = 0.02
"""Of an index that is said."""
Sensitivity = Annotated[
    int, typer.Option(metavar="N", min=0, max=100_000, help="Devices for the causes; 0: leave them out.")
]
Loops = Annotated[int, typer.Option(metavar="N", min=0, max=1_000_000, help="Devices in a closed loop; 0: none.")]
PerWafer = Annotated[
    int, typer.Option(metavar="M", min=1, help="How many of them are on each wafer; intervals count wafers.")
]
LoopSensitivity = Annotated[
    int, typer.Option(metavar="N", min=0, max=100_000, help="As --sensitivity, in a closed loop.")
]


def wafer_yield(
    process: Annotated[str, typer.Argument(help="A shipped process' name or a TOML file.")] = "oreo_drie",
    stage: Annotated[str, typer.Option(help="The drawing: a stage's name or a TOML file.")] = "reconstructed",
    devices: Annotated[int, typer.Option(min=1, max=100_000_000, help="How many, from whole wafers.")] = 10_000,
    seed: Annotated[int, typer.Option(min=0, help="Of all wafers.")] = 1,
    sensitivity: Sensitivity = 2048,
    loops: Loops = 64,
    per_wafer: PerWafer = 1,
    loop_sensitivity: LoopSensitivity = 64,
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
        Path, typer.Option(help="Folder for devices/, loops/ and causes/ (Parquet), summary.json and pictures.")
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
    asked_run = load_scenario(scenario, stage=stage, controller=controller)
    closed = ClosedLoops(study, asked_run, known, identified, per_wafer)
    if alone is not None:
        _alone({**(closed.device(alone) if loops else {}), **study.alone(alone)}, as_json=as_json)
        return
    spread = cluster_at(cluster, cluster_tls)
    folder_to_write(out)
    if loops:
        say_if_compiling(quiet=as_json)
    in_loops = loop_sensitivity if loops else 0
    asked = _Asked(closed, devices, loops, sensitivity, in_loops, workers or cores(), spread, out, as_json)
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
    loop_sensitivity: int
    workers: int
    cluster: "Cluster | None"
    out: Path
    quiet: bool

    def worked(self) -> dict[str, Any]:
        """Do what is left to do, and write summary and pictures of what there is."""
        from hil.studies.wafer.causes import causes
        from hil.studies.wafer.closed_loop import PART_DEVICES
        from hil.studies.wafer.study import parts_for
        from hil.studies.wafer.table import Table

        study, found, in_loops, interrupted = self.closed.wafers, None, None, False
        table = Table(self.out / "devices", study.digest())
        loops = Table(self.out / "loops", self.closed.digest()) if self.loops else None
        of_loops = self.loop_causes
        moved = Table(self.out / "causes", of_loops.digest()) if self.loop_sensitivity else None
        try:
            self._run("devices", study, parts_for(study.process, self.devices), table)
            if loops is not None:
                moving = of_loops.parts_for(self.loop_sensitivity) * PART_DEVICES
                self.closed.prepare(self.loops + moving, _tell_nobody if self.quiet else note)
                if self.closed.identified:
                    _ = self.closed.mean_modes  # once here, not in each worker
                self._run("loops", self.closed, -(-self.loops // PART_DEVICES), loops)
            if self.sensitivity:
                with progress_bar("causes", quiet=self.quiet) as tell:
                    found = causes(study, self.sensitivity, tell)
            if moved is not None:
                self._run("causes in loops", of_loops, of_loops.parts_for(self.loop_sensitivity), moved)
        except KeyboardInterrupt:
            interrupted = True
        if not table.parts:
            raise KeyboardInterrupt
        if moved is not None:
            in_loops = of_loops.found(moved)
        return self._summed_up(table, loops, found, in_loops, interrupted=interrupted)

    @cached_property
    def loop_causes(self) -> "LoopCauses":
        """Of devices on wafers of their own, however many a wafer the others are."""
        from hil.studies.wafer.loop_causes import LoopCauses

        return LoopCauses(replace(self.closed, per_wafer=1))

    def _run(self, words: str, study: "Parts", parts: int, table: "Table") -> None:
        from hil.studies.wafer.study import run_study

        with progress_bar(words, quiet=self.quiet) as tell:
            run_study(study, parts, table, self.workers, self.cluster, tell)

    def _summed_up(
        self,
        table: "Table",
        loops: "Table | None",
        found: "Causes | None",
        moved: "Indices | None",
        *,
        interrupted: bool,
    ) -> dict[str, Any]:
        from hil.pictures.wafer.loops import draw_loops
        from hil.pictures.wafer.overview import draw_wafer
        from hil.studies.wafer.shares import share_of

        study, in_loops, wafers = self.closed.wafers, {}, 0
        names = ["wafer", "x_m", "y_m", *study.process.requirements, *study.requirement_columns]
        columns = table.read(names, self.devices)
        shares = {n.removeprefix("ok."): share_of(columns[n], columns["wafer"]) for n in study.requirement_columns}
        draw_wafer(study.process, columns, shares, found, self.out / "wafer.png")
        if loops is not None and loops.parts:
            kept = ["wafer", "handle_m", *self.closed.columns, *self.closed.verdict_columns]
            rows = loops.read(kept, self.loops)
            in_loops = {n.removeprefix("ok."): share_of(rows[n], rows["wafer"]) for n in self.closed.verdict_columns}
            wafers = len(set(rows["wafer"].tolist()))
            draw_loops(self.closed, rows, in_loops, moved, self.out / "loops.png")
        data = {
            "process": study.process.name, "stage": study.stage.name, "seed": study.seed, "digest": study.digest(),
            "devices": len(columns["wafer"]), "shares": {name: asdict(share) for name, share in shares.items()},
            "loops": {name: asdict(share) for name, share in in_loops.items()}, "loop_wafers": wafers,
            "causes": None if found is None else found.as_json(),
            "loop_causes": None if moved is None else {"total_index_and_error": moved.as_json()},
            "interrupted": interrupted, "folder": str(self.out),
        }  # fmt: skip
        (self.out / "summary.json").write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        return data


def _tell_nobody(_words: str) -> None:
    """Of a call that a program reads."""


def _show(data: dict[str, Any]) -> None:
    say(f"{data['devices']} devices of {data['process']} by the drawing {data['stage']}, seed {data['seed']}")
    table = plain_table("requirement", "met", "95 %", left=("95 %",))
    for name, share in data["shares"].items():
        words = "all of them" if name == "ok" else name
        table.add_row(words, f"{share['value']:.2%}", f"{share['low']:.2%} to {share['high']:.2%}")
    print_whole(table)
    if data["loops"]:
        devices = next(iter(data["loops"].values()))["devices"]
        laws = [f"{LAW_WORDS[name]} ({name})" for name in data["loops"] if name in LAW_WORDS]
        say(
            f"in a closed loop, {devices} devices on {data['loop_wafers']} wafers, each under a law designed for "
            + ", ".join(laws)
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
    if data["loop_causes"] is not None:
        _say_loop_causes(data["loop_causes"]["total_index_and_error"])
    say(f"map, figures and causes: {data['folder']}/wafer.png; every device: {data['folder']}/devices/")


def _say_loop_causes(found: dict[str, dict[str, list[float]]]) -> None:
    causes = "causes, and their hand in its variance (Sobol's total index)"
    table = plain_table("in a closed loop", causes, left=(causes,))
    for figure, of in found.items():
        most = sorted(of, key=lambda name: -of[name][0])[:3]
        said = ", ".join(f"{name} {of[name][0]:.0%} +- {of[name][1]:.0%}" for name in most if of[name][0] >= _LEAST)
        table.add_row(figure, said or "does not differ")
    print_whole(table)


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

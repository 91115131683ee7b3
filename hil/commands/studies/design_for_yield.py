"""``pkxyz design --for-yield``: the drawing of which most devices work, beside the one that it began with."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from hil.screen.first_run import say_if_compiling
from hil.screen.outputs import folder_to_write, writing
from hil.screen.progress import progress_bar
from hil.screen.terminal import plain_table, print_whole, say
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.mechanics.selection import Requirements

if TYPE_CHECKING:
    from hil.studies.wafer.drawing import Choice, DrawingProblem
    from hil.studies.wafer.drawing_search import Confirmed
    from pkxyz_ctrl.config.controller import ControllerConfig

LAWS = ("youla", "lqg")
LOOPS = 12
CANDIDATES = 3
OWN_WAFERS = 100
"""Fresh ones, all devices of which are held to each requirement of their own."""
_HEAD = "with the largest share of devices that work, of those that were tried"


@dataclass(frozen=True)
class Asked:
    """One call of ``pkxyz design --for-yield``."""

    need: Requirements
    template: StageConfig
    process: str
    trials: int
    devices: int
    workers: int
    out: Path
    """folder"""
    quiet: bool

    def run(self) -> None:
        """Search, confirm, write and say. Exit code 1 if no drawing keeps the inequalities."""
        folder_to_write(self.out)
        say_if_compiling(quiet=self.quiet)
        with writing(self.out):
            data = self.worked()
            text = json.dumps(data, indent=2, allow_nan=False) + "\n"
            (self.out / "summary.json").write_text(text, encoding="utf-8")
        if self.quiet:
            print(json.dumps(data, allow_nan=False))
        else:
            _show(data, self.out)
        raise typer.Exit(0 if data["chosen"] is not None else 1)

    @cached_property
    def problem(self) -> "DrawingProblem":
        """What is searched. The first law is the scenario's own."""
        from hil.runs.scenario import load_scenario
        from hil.studies.wafer.drawing import DrawingProblem
        from pkxyz_ctrl.config.controller import ControllerConfig
        from pkxyz_ctrl.config.files import load
        from pkxyz_ctrl.fabrication.process import Process

        laws = tuple(load("controllers", name, ControllerConfig) for name in LAWS)
        process = load("processes", self.process, Process)
        return DrawingProblem(self.need, self.template, process, load_scenario("raster"), laws, 1, LOOPS)

    def worked(self) -> dict[str, Any]:
        """All that was found, as plain data."""
        from hil.studies.spread.trials import judged
        from hil.studies.wafer.drawing_search import best, nearest, open_study, search
        from pkxyz_ctrl.elements.errors import InfeasibleDesignError
        from pkxyz_ctrl.mechanics.selection import select

        problem, others, plain_design = self.problem, {self.template.name: self.template}, None
        try:
            others["design"] = select(self.need, self.template, name="design").config
        except InfeasibleDesignError as error:
            plain_design = str(error)
        first = [problem.nearest_choice(stage) for stage in others.values()]
        study = open_study(problem, self.out / "study.db", first)
        with progress_bar("drawings", quiet=self.quiet) as tell:
            search(study, problem, self.trials, self.workers, None, tell)
        found = best(study, CANDIDATES)
        data: dict[str, Any] = {
            "process": problem.process.name, "stage": self.template.name, "digest": problem.digest(),
            "trials": len(judged(study)), "design": plain_design, "missed": nearest(study), "chosen": None,
            "drawings": {},
        }  # fmt: skip
        if found:
            order = self._ordered(found)
            data |= {"chosen": order[0]} | self._compared(others, order[0])
            self._write(order)
        return data

    def _confirmed(
        self, name: str, stage: StageConfig, law: "ControllerConfig", fresh: int, devices: int, *, identified: bool
    ) -> "Confirmed":
        from hil.studies.wafer.drawing_search import confirmed

        asked = self.problem.closed(stage, law, self.problem.seed + fresh, identified=identified)
        folder = self.out / "devices" / f"{asked.digest()}"
        with progress_bar(name, quiet=self.quiet) as tell:
            return confirmed(asked, devices, folder, self.workers, None, tell)

    def _ordered(self, found: "list[Choice]") -> "list[Choice]":
        """Best first, by devices that did not choose them."""
        problem = self.problem
        stages = [problem.stage(choice, f"candidate{n}") for n, choice in enumerate(found, start=1)]
        works = [
            self._confirmed(s.name, s, problem.law(s), 1, self.devices // 2, identified=False).share.value
            for s in stages
        ]
        return [found[n] for n in sorted(range(len(found)), key=lambda n: -works[n])]

    def _compared(self, others: dict[str, StageConfig], choice: "Choice") -> dict[str, Any]:
        """Shares of each drawing on fresh wafers, gains of the chosen one, effects of each source; and the picture."""
        from hil.pictures.wafer.drawings import ERROR, DrawingFigures, draw_drawings
        from hil.studies.wafer.drawing_search import gained
        from hil.studies.wafer.effects import effects
        from hil.studies.wafer.shares import share_of

        problem, rows, drawn = self.problem, {}, []
        stages = others | {"chosen": problem.stage(choice, "chosen")}
        laws = {name: problem.law(stage) for name, stage in stages.items()}
        found = {n: self._confirmed(n, s, laws[n], 2, self.devices, identified=True) for n, s in stages.items()}
        for name, stage in stages.items():
            closed, each = problem.closed(stage, laws[name], problem.seed + 2), found[name]
            with progress_bar(f"sources, {name}", quiet=self.quiet) as tell:
                effect = effects(closed, tell)
            ok = {n: v for n, v in each.columns.items() if n.startswith("ok.")} | {"own": each.columns["own"] > 0.5}
            shares = {n.removeprefix("ok."): share_of(v, each.columns["device"]) for n, v in ok.items()}
            own = closed.wafers.columns(range(OWN_WAFERS))
            asked = {n: share_of(own[f"ok.{n}"], own["wafer"]) for n in problem.process.requirements}
            by, within = gained(found["chosen"], each)
            rows[name] = {
                "works": asdict(each.share), "law": laws[name].name, "gained": by, "gained_within": within,
                "shares": {n: asdict(share) for n, share in shares.items()},
                "requirements": {n: asdict(share) for n, share in asked.items()}, "effects": effect,
                "error_nm": [round(e, 4) if math.isfinite(e) else None for e in each.columns[ERROR].tolist()],
            }  # fmt: skip
            drawn.append(DrawingFigures(name, {"works": each.share, **shares}, asked, each.columns[ERROR], effect))
        limit = problem.process.closed_loop.get(ERROR)
        limit_nm = None if limit is None else limit.max
        draw_drawings(drawn, limit_nm, self.out / "drawings.png")
        return {"drawings": rows, "limit_nm": limit_nm}

    def _write(self, order: "list[Choice]") -> None:
        from hil.studies.designed_stage import require_replaceable, write_stage_file

        names = ["chosen", *(f"beside-{n}" for n in range(1, len(order)))]
        for name, choice in zip(names, order, strict=True):
            path = self.out / f"{name}.toml"
            require_replaceable(path)
            write_stage_file(self.problem.stage(choice, name), self.need, path, _HEAD)


def _show(data: dict[str, Any], out: Path) -> None:
    say(f"{data['trials']} drawings tried for {data['process']}, from the drawing {data['stage']}")
    if data["design"] is not None:
        say(f"plain `pkxyz design` has none to compare with: {data['design']}")
    if data["chosen"] is None:
        missed = ", ".join(f"{name} by {v:.1%}" for name, v in data["missed"].items())
        say(f"none keeps every inequality; the nearest misses {missed}" if missed else "no loop could be closed")
        return
    table = plain_table("drawing", "law", "work", "95 %", "less than chosen", left=("law", "95 %"))
    for name, row in data["drawings"].items():
        works = row["works"]
        gain = "" if name == "chosen" else f"{row['gained']:+.1%} +- {row['gained_within']:.1%}"
        table.add_row(name, row["law"], f"{works['value']:.1%}", f"{works['low']:.1%} to {works['high']:.1%}", gain)
    print_whole(table)
    say(", ".join(f"{name} {value:g}" for name, value in data["chosen"].items()))
    _say_why(data)
    law = data["drawings"]["chosen"]["law"]
    say(f"written: {out}; run it with: pkxyz sil --stage {out / 'chosen.toml'} --controller {law}")


def _say_why(data: dict[str, Any]) -> None:
    """Of the sources the one whose error shrinks most."""
    figure: Callable[[str, str], float] = lambda name, source: data["drawings"][name]["effects"][source][  # noqa: E731
        "known.error_about_mean_nm"
    ]
    sources = [s for s in data["drawings"]["chosen"]["effects"] if s != "mean"]
    most = max(sources, key=lambda s: figure(data["stage"], s) - figure("chosen", s))
    say(
        f"one standard deviation of {most} leaves {figure('chosen', most):.2f} nm of error about its mean, "
        f"not {figure(data['stage'], most):.2f} nm"
    )

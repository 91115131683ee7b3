"""``pkxyz faults``: everything that can go wrong, against every law."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.screen.first_run import say_if_compiling
from hil.screen.options import AsJson, ClusterAddress, ClusterTls
from hil.screen.outputs import folder_to_write, writing
from hil.screen.progress import progress_bar
from hil.screen.terminal import bad, faint, good, plain_table, say, screen
from pkxyz_ctrl.config.files import ConfigError, names
from pkxyz_ctrl.io.realtime import cores

if TYPE_CHECKING:
    from hil.studies.faults.matrix import Case
    from hil.studies.faults.outcome import Outcome


def faults(
    law: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A controller's name or file; may be repeated. Default: every shipped one."),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="TEXT", help="Faults whose name holds this, such as sense.2 or stuck; may be repeated."),
    ] = None,
    workers: Annotated[int, typer.Option(help="Processes; 0: one for each core.", min=0)] = 0,
    cluster: ClusterAddress = None,
    cluster_tls: ClusterTls = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for what was found and its picture; called again, it goes on."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Break everything once under each law: who notices, after how many ticks, and what the combs did meanwhile.

    Exit code 0 if every bound held, 1 if not, 2 for bad input, 130 if interrupted (what is done is kept in --out).
    """
    from hil.studies.faults.every_law import INTERRUPTED, KeptOutcomes, break_all
    from hil.studies.faults.matrix import CASES
    from hil.studies.faults.outcome import as_json as plain
    from hil.studies.spread.cluster import cluster_at

    laws = law or names("controllers")
    cases = [case for case in CASES if not only or any(text in case.text for text in only)]
    if not cases:
        raise ConfigError(
            f"--only: no fault holds {' or '.join(only or [])}; there are {', '.join(c.text for c in CASES)}"
        )
    spread = cluster_at(cluster, cluster_tls)
    kept = None if out is None else KeptOutcomes(folder_to_write(out) / "outcomes.jsonl")
    say_if_compiling(quiet=as_json)
    with progress_bar("faults", quiet=as_json) as tell:
        found = break_all(laws, cases, workers or cores(), spread, kept, tell)
    outcomes, refused = found.outcomes, found.refused
    interrupted = INTERRUPTED in refused.values()
    if interrupted and not outcomes:
        raise KeyboardInterrupt
    if law and refused and not interrupted:
        raise ConfigError("\n".join(refused.values()))
    laws = [name for name in laws if name not in refused]
    result = {
        "ok": all(o.ok for o in outcomes), "laws": laws, "refused": refused, "interrupted": interrupted,
        "outcomes": [plain(o) for o in outcomes],
    }  # fmt: skip
    if out is not None:
        _write(out, result, outcomes, cases)
    if as_json:
        print(json.dumps(result))
    else:
        _show(outcomes, cases, laws)
        for name, reason in refused.items():
            say(faint(f"not run under {name}: {reason}"))
    raise typer.Exit(130 if interrupted else 0 if result["ok"] else 1)


def _write(out: Path, result: dict[str, Any], outcomes: "list[Outcome]", cases: "list[Case]") -> None:
    from hil.pictures.faults import draw

    with writing(out):
        (out / "faults.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        draw(outcomes, cases, out / "faults.png")


def _show(outcomes: "list[Outcome]", cases: "list[Case]", laws: list[str]) -> None:
    for law in laws:
        table = plain_table()
        table.show_header = True
        for heading, side in (
            (law, "left"), ("ticks", "right"), ("latched", "left"), ("peak V", "right"), ("V/tick", "right"),
            ("0 V ms", "right"), ("off um", "right"), ("", "left"),
        ):  # fmt: skip
            table.add_column(heading, justify=side, overflow="fold")  # type: ignore[arg-type]
        for outcome, case in zip((o for o in outcomes if o.law == law), cases, strict=True):
            verdict = good("saved") if outcome.ok else bad("; ".join(outcome.problems))
            reason = ", ".join(outcome.reason) or faint(f"nothing: {case.note}")
            table.add_row(
                outcome.case, _or_dash(outcome.ticks, "d"), reason, f"{outcome.voltage_max_v:.0f}",
                f"{outcome.slew_max_v:.1f}", _or_dash(outcome.zero_ms, ".1f"), f"{outcome.excursion_um:.2f}", verdict,
            )  # fmt: skip
        screen().print(table)
    lost = sum(not o.ok for o in outcomes)
    say(f"{len(outcomes)} faults, {len(outcomes) - lost} as they have to be", bad(f", {lost} not") if lost else "")


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)

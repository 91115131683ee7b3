"""``pkxyz faults``: everything that can go wrong, against every law."""

import json
from collections.abc import Callable
from concurrent.futures import as_completed
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.screen.first_run import say_if_compiling
from hil.screen.outputs import folder_to_write, writing
from hil.screen.progress import progress_bar
from hil.screen.terminal import bad, faint, good, plain_table, say, screen
from hil.studies.spread.processes import processes
from pkxyz_ctrl.config.files import ConfigError, names

if TYPE_CHECKING:
    from hil.studies.faults.matrix import Case
    from hil.studies.faults.outcome import Outcome

INTERRUPTED = "interrupted"
"""Why a law is not among the results."""
_CHUNKS = 3  # of the matrix for each law, so that the last process does not run alone for long


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
    out: Annotated[Path | None, typer.Option(help="Folder for faults.json and faults.png.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else.")] = False,
) -> None:
    """Break everything once under each law: who notices, after how many ticks, and what the combs did meanwhile.

    Exit code 0 if every bound held, 1 if not, 2 for bad input, 130 if interrupted (laws that are through are kept).
    """
    from hil.studies.faults.matrix import CASES
    from hil.studies.faults.outcome import as_json as plain

    laws = law or names("controllers")
    cases = [case for case in CASES if not only or any(text in case.text for text in only)]
    if not cases:
        raise ConfigError(
            f"--only: no fault holds {' or '.join(only or [])}; there are {', '.join(c.text for c in CASES)}"
        )
    if out is not None:
        folder_to_write(out)
    say_if_compiling(quiet=as_json)
    outcomes, refused = run_matrix(laws, cases, workers, quiet=as_json)
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
        from hil.pictures.faults import draw

        with writing(out):
            (out / "faults.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
            draw(outcomes, cases, out / "faults.png")
    if as_json:
        print(json.dumps(result))
    else:
        _show(outcomes, cases, laws)
        for name, reason in refused.items():
            say(faint(f"not run under {name}: {reason}"))
    raise typer.Exit(130 if interrupted else 0 if result["ok"] else 1)


def run_matrix(
    laws: list[str], cases: "list[Case]", workers: int, *, quiet: bool
) -> "tuple[list[Outcome], dict[str, str]]":
    """Every case under every law, over processes, in the order of laws and cases; and the laws that can't be run here,
    with the reason; interrupted, those that are not through.
    """
    size = -(-len(cases) // _CHUNKS)
    chunks = [(law, first, cases[first : first + size]) for law in laws for first in range(0, len(cases), size)]
    found: dict[tuple[str, int], list[Outcome]] = {}
    refused: dict[str, str] = {}
    with progress_bar("faults", quiet=quiet) as tell:

        def done(law: str, first: int, outcomes: "list[Outcome] | str") -> None:
            if isinstance(outcomes, str):
                refused[law] = outcomes
            else:
                found[law, first] = outcomes
            through = sum(len(some) for some in found.values())
            tell(through, (len(laws) - len(refused)) * len(cases), law)

        try:
            if workers == 1:
                for law, first, some in chunks:
                    done(law, first, _run_chunk(law, some))
            else:
                _over_processes(chunks, workers, done)
        except KeyboardInterrupt:
            for law, first, _ in chunks:
                if (law, first) not in found:
                    refused.setdefault(law, INTERRUPTED)
    keys = [(law, first) for law, first, _ in chunks if law not in refused]
    return [outcome for key in keys for outcome in found[key]], refused


def _over_processes(
    chunks: "list[tuple[str, int, list[Case]]]", workers: int, done: "Callable[[str, int, list[Outcome] | str], None]"
) -> None:
    with processes(workers or None) as pool:
        waiting = {pool.submit(_run_chunk, law, some): (law, first) for law, first, some in chunks}
        for future in as_completed(waiting):
            done(*waiting[future], future.result())


def _run_chunk(law: str, cases: "list[Case]") -> "list[Outcome] | str":
    from hil.studies.faults.outcome import run_case, setup_for
    from pkxyz_ctrl.design.model.design_error import DesignError

    try:
        setup = setup_for(law)
        assert setup.law is not None  # designed here, so that what refuses does so before anything is broken
    except (ConfigError, DesignError) as error:
        return str(error)
    return [run_case(law, setup, case) for case in cases]


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

"""``pkxyz tune``: better numbers for a controller file."""

import json
from pathlib import Path
from typing import Annotated

import typer

from hil.screen.first_run import say_if_compiling
from hil.screen.options import AsJson, ClusterAddress, ClusterTls, Workers
from hil.screen.outputs import folder_to_write
from hil.screen.progress import progress_bar
from hil.screen.terminal import plain_table, say, screen
from pkxyz_ctrl.config.files import ConfigError


def tune(
    search: Annotated[str, typer.Argument(help="A shipped search's name or a TOML file.")] = "lqg",
    trials: Annotated[int, typer.Option(min=0, help="How many to add to the study; 0 only shows it.")] = 100,
    workers: Workers = None,
    cluster: ClusterAddress = None,
    cluster_tls: ClusterTls = None,
    storage: Annotated[
        str | None, typer.Option(metavar="URL", help="Database of the study; default: study.db in the folder.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the search.")] = 1,
    stage: Annotated[
        str | None,
        typer.Option(
            help="A stage's name or file, in place of the one for which taps are asked: one that identify wrote, say."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the controller file, study and pictures.")] = Path("tuned"),
    as_json: AsJson = False,
) -> None:
    """Search a law's weights: margins are constraints and computed first, runs on the fast lane follow if they hold.

    Call it again to go on. The taps of the law youla are a convex problem: they are found at once, without trials.
    Exit code 0 if numbers were found that keep every constraint, 1 if not, 2 for bad input,
    130 if interrupted (what is done is kept).
    """
    from hil.api.tune import tune as search_on
    from hil.studies.tune.taps import asks_for_taps

    if asks_for_taps(search):
        _tune_taps(search, stage, out, as_json=as_json)
        return
    if stage is not None:
        raise ConfigError(f"--stage: the search {search!r} names its stage itself; --stage is for a search of taps")
    folder_to_write(out)
    say_if_compiling(quiet=as_json)
    with progress_bar(search, quiet=as_json) as tell:
        tuned = search_on(
            search, trials=trials, out=out, workers=workers, seed=seed, cluster=cluster,
            cluster_tls=cluster_tls, storage=storage,
            on_progress=tell,
        )  # fmt: skip
    problem, found = tuned.problem, tuned.best
    if tuned.trials:
        from hil.pictures.tuning import draw_tuning

        draw_tuning(tuned.study, problem, tuned.importance, out)
    data = {
        "search": problem.search.name, "digest": problem.digest(), "seed": seed, "trials": tuned.trials,
        "best": None if found is None else vars(found) | {"controller": str(tuned.controller)},
        "missed": tuned.missed, "importance": tuned.importance, "interrupted": tuned.interrupted,
    }  # fmt: skip
    if as_json:
        print(json.dumps(data, allow_nan=False))
    else:
        _show(data, problem.search.objective)
    raise typer.Exit(130 if tuned.interrupted else 0 if found is not None else 1)


def _tune_taps(search: str, stage: str | None, out: Path, *, as_json: bool) -> None:
    from hil.api.tune import tune_taps

    folder_to_write(out)
    tuned = tune_taps(search, stage=stage, out=out, on_progress=lambda line: None if as_json else say(line))
    noise_nm = dict(zip(("plane", "z"), (1e9 * v for v in tuned.found.hold_noise_m), strict=True))
    if as_json:
        print(json.dumps({"search": tuned.search, "hold_noise_nm": noise_nm, "controller": str(tuned.controller)}))
    else:
        say(f"noise at hold {noise_nm['plane']:.2f} nm in x and y, {noise_nm['z']:.2f} nm in z")
        say(f"run it: pkxyz sil --controller {tuned.controller}")


def _show(data: dict, objective: str) -> None:  # type: ignore[type-arg]
    found = data["best"]
    say(f"{data['search']}: {data['trials']} trials in the study")
    if not data["trials"]:
        return
    if found is None:
        missed = ", ".join(f"{name} by {beyond:.0%}" for name, beyond in data["missed"].items())
        say(f"none keeps every constraint; the nearest one misses {missed or 'nothing, but did not run'}")
        return
    table = plain_table()
    table.add_row(objective, f"{found['value']:.4g}", f"trial {found['number']}")
    for name, value in found["figures"].items():
        if name == objective:
            continue
        table.add_row(name, f"{value:.4g}", "")
    for key, value in found["numbers"].items():
        share = data["importance"].get(key)
        table.add_row(key, f"{value:.4g}", "" if share is None else f"importance {share:.2f}")
    screen().print(table)
    say(f"run it: pkxyz sil --controller {found['controller']}")

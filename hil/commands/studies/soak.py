"""``pkxyz soak``: half an hour of stage time under random faults."""

import json
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from hil.screen.first_run import say_if_compiling
from hil.screen.options import AsJson, ClusterAddress, ClusterTls
from hil.screen.outputs import folder_to_write, writing
from hil.screen.progress import progress_bar
from hil.screen.terminal import bad, say
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.io.realtime import cores

if TYPE_CHECKING:
    from hil.studies.soak import Soaked
    from hil.studies.spread.cluster import Cluster


def soak(
    minutes: Annotated[float, typer.Option(help="Of stage time.", min=0.01, max=600)] = 30.0,
    seed: Annotated[int, typer.Option(help="Of noise and faults.", min=0)] = 1,
    runs: Annotated[
        int,
        typer.Option(min=1, help="With the seeds from --seed on; several are kept in --out, called again it goes on."),
    ] = 1,
    law: Annotated[str, typer.Option(help="A controller's name or file.")] = "lqg",
    workers: Annotated[int, typer.Option(help="Processes for several runs; 0: one for each core.", min=0)] = 0,
    cluster: ClusterAddress = None,
    cluster_tls: ClusterTls = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for soak.json, soak.png and, with --keep, recordings; or soaks.jsonl.")
    ] = None,
    keep: Annotated[bool, typer.Option("--keep", help="Keep the recordings, 100 MB a minute.")] = False,
    as_json: AsJson = False,
) -> None:
    """Run in lockstep under random faults and clears: is anything lost, does anything grow, does anything break?

    Exit code 0 if not, 1 if so, 2 for bad input. Some minutes for half an hour.
    """
    from hil.studies.soak import as_json as plain
    from hil.studies.spread.cluster import cluster_at

    if keep and out is None:
        raise ConfigError("--keep: needs --out, the folder to keep the recordings in")
    if runs > 1 or cluster is not None:
        if keep:
            raise ConfigError("--keep: of one run only; --seed says which")
        _several(60.0 * minutes, range(seed, seed + runs), law, workers, cluster_at(cluster, cluster_tls), out, as_json)
    soaked = _soaked(60.0 * minutes, seed, law, out, keep, as_json)
    if as_json:
        print(json.dumps(plain(soaked)))
    else:
        _tell(soaked)
    raise typer.Exit(130 if soaked.interrupted else 0 if soaked.ok else 1)


def _soaked(duration_s: float, seed: int, law: str, out: Path | None, keep: bool, as_json: bool) -> "Soaked":
    """One run, with what is to be kept of it."""
    from hil.recording.recording import RecordingError
    from hil.studies import soak as soaking

    scenario = soaking.soaked_scenario(law)
    folder = Path(tempfile.mkdtemp(prefix="pkxyz-soak-")) if out is None else folder_to_write(out)
    say_if_compiling(quiet=as_json)
    try:
        with writing(folder):
            with progress_bar("soak", quiet=as_json) as tell:
                soaked = soaking.soak(duration_s, seed, scenario, folder, keep=keep, on_progress=tell)
            if out is not None:
                from hil.pictures.faults import draw_soak

                text = json.dumps(soaking.as_json(soaked), indent=1) + "\n"
                (out / "soak.json").write_text(text, encoding="utf-8")
                draw_soak(soaked, out / "soak.png")
    except RecordingError as error:
        raise ConfigError(str(error)) from None
    finally:
        if out is None:
            shutil.rmtree(folder, ignore_errors=True)
    return soaked


def _tell(soaked: "Soaked") -> None:
    from hil.studies.soaks import decisions_in_words

    until = " until interrupted" if soaked.interrupted else ""
    say(
        f"{soaked.ticks} ticks{until}, {soaked.realtime_factor:.1f} times real time; "
        + decisions_in_words(soaked.faults, soaked.undecided, soaked.decisions, soaked.misled)
        + f", {soaked.returns} times back to tracking",
    )
    say(
        f"{soaked.recorded_ticks} ticks read back from the recordings; memory {soaked.memory_mb[0]:.0f} to "
        f"{soaked.memory_mb[-1]:.0f} MB; at most {soaked.voltage_max_v:.1f} V, and {soaked.slew_max_v:.1f} V up "
        "in a tick",
    )
    _tell_counts(soaked.reasons, soaked.undecided, soaked.faults_by_case)
    for problem in soaked.problems:
        say(bad(problem))


def _tell_counts(reasons: dict[str, int], undecided: dict[str, int], faults: dict[str, int]) -> None:
    say("reasons: " + ", ".join(f"{name} {count}" for name, count in reasons.items()))
    if undecided:
        each = (f"{case} {count} of {faults[case]}" for case, count in undecided.items())
        say("without a decision: " + "; ".join(each))


def _several(
    duration_s: float, seeds: range, law: str, workers: int, cluster: "Cluster | None", out: Path | None, as_json: bool
) -> NoReturn:
    """Runs that are kept as they come."""
    from hil.studies.soak import soaked_scenario
    from hil.studies.soaks import KeptSoaks, decisions_in_words, soak_each, totals

    asked = soaked_scenario(law), duration_s
    folder = folder_to_write(out or Path("soaks"))
    kept = KeptSoaks(folder / "soaks.jsonl", asked)
    say_if_compiling(quiet=as_json)
    with progress_bar("soaks", quiet=as_json) as tell:
        soaks = soak_each(asked, seeds, workers or cores(), kept, cluster, tell)
    found = totals(soaks) | {
        "law": law, "minutes_each": duration_s / 60.0, "interrupted": len(soaks) < len(seeds),
        "core_minutes": sum(duration_s / soaked.realtime_factor for soaked in soaks) / 60.0,
    }  # fmt: skip
    (folder / "soak.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if as_json:
        print(json.dumps(found))
    else:
        say(
            f"{found['soaks']} of {len(seeds)} soaks, {found['ticks']} ticks in {found['core_minutes']:.1f} minutes of "
            f"a core, {found['recorded_ticks']} read back; "
            + decisions_in_words(*(found[name] for name in ("faults", "undecided", "decisions", "misled")))
            + f", {found['returns']} times back to tracking; at most {found['voltage_max_v']:.1f} V, and "
            f"{found['slew_max_v']:.1f} V up in a tick"
        )
        _tell_counts(found["reasons"], found["undecided"], found["faults_by_case"])
        for seed, problems in found["problems"].items():
            say(bad(f"seed {seed}: {'; '.join(problems)}"))
    raise typer.Exit(130 if found["interrupted"] else 0 if found["ok"] else 1)

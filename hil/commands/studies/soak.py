"""``pkxyz soak``: half an hour of stage time under random faults."""

import json
import shutil
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from hil.screen.first_run import say_if_compiling
from hil.screen.outputs import folder_to_write, writing
from hil.screen.progress import progress_bar
from hil.screen.terminal import bad, say
from pkxyz_ctrl.config.files import ConfigError


def soak(
    minutes: Annotated[float, typer.Option(help="Of stage time.", min=0.01, max=600)] = 30.0,
    seed: Annotated[int, typer.Option(help="Of noise and faults.", min=0)] = 1,
    law: Annotated[str, typer.Option(help="A controller's name or file.")] = "lqg",
    out: Annotated[
        Path | None, typer.Option(help="Folder for soak.json, soak.png and, with --keep, recordings.")
    ] = None,
    keep: Annotated[bool, typer.Option("--keep", help="Keep the recordings, 100 MB a minute.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else.")] = False,
) -> None:
    """Run in lockstep under random faults and clears: is anything lost, does anything grow, does anything break?

    Exit code 0 if not, 1 if so, 2 for bad input. Some minutes for half an hour.
    """
    from hil.recording.recording import RecordingError
    from hil.studies import soak as soaking

    if keep and out is None:
        raise ConfigError("--keep: needs --out, the folder to keep the recordings in")
    folder = _folder(out)
    say_if_compiling(quiet=as_json)
    try:
        with writing(folder):
            with progress_bar("soak", quiet=as_json) as tell:
                soaked = soaking.soak(60.0 * minutes, seed, law, folder, keep=keep, on_progress=tell)
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
    if as_json:
        print(json.dumps(soaking.as_json(soaked)))
    else:
        until = " until interrupted" if soaked.interrupted else ""
        say(
            f"{soaked.ticks} ticks{until}, {soaked.realtime_factor:.1f} times real time; {soaked.faults} faults, "
            f"{soaked.decisions} decisions, {soaked.returns} times back to tracking",
        )
        say(
            f"{soaked.recorded_ticks} ticks read back from the recordings; memory {soaked.memory_mb[0]:.0f} to "
            f"{soaked.memory_mb[-1]:.0f} MB; at most {soaked.voltage_max_v:.1f} V, and {soaked.slew_max_v:.1f} V up "
            "in a tick",
        )
        say("reasons: " + ", ".join(f"{name} {count}" for name, count in soaked.reasons.items()))
        for problem in soaked.problems:
            say(bad(problem))
    raise typer.Exit(130 if soaked.interrupted else 0 if soaked.ok else 1)


def _folder(out: Path | None) -> Path:
    if out is None:
        return Path(tempfile.mkdtemp(prefix="pkxyz-soak-"))
    return folder_to_write(out)

"""``pkxyz identify``: what the stage really is, measured in its running loop."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.lanes.lane import Lane
from hil.screen.choices import InProcessLane, Tones
from hil.screen.errors import amplifier_errors, one_line_errors
from hil.screen.first_run import say_if_compiling
from hil.screen.options import AsJson, AtStrokes, ExcitationSeed, NameOrFile
from hil.screen.outputs import folder_to_write, writing
from hil.screen.progress import bar_apart, progress_bar
from hil.screen.terminal import bad, note, plain_table, print_whole, say
from pkxyz_ctrl.config.files import ConfigError, find, load

if TYPE_CHECKING:
    from hil.studies.identify.identification import Identification


STAGE = "stage.toml"


def identify(
    stage: NameOrFile = "reconstructed",
    plant: Annotated[str | None, typer.Option(help="Name or file of the simulated plant; default: nominal.")] = None,
    controller: NameOrFile = "lqg",
    bus: Annotated[
        str, typer.Option(help="Name or file. One that leads to other processes or devices is excited at rate.")
    ] = "fd_5k",
    lane: Annotated[
        InProcessLane | None,
        typer.Option(help="Where simulated. lockstep: over the bus; fast (default): compiled, without frames."),
    ] = None,
    tones: Annotated[Tones, typer.Option(help="All tones at once, or one after another.")] = Tones.MULTISINE,
    amplitude_nm: Annotated[
        float | None,
        typer.Option("--amplitude", min=0.1, max=200.0, help="Of each tone in nm; default: 5 at once, 25 alone."),
    ] = None,
    periods: Annotated[
        int, typer.Option(min=3, max=1000, help="Of 1 s (multisine) or 0.1 s (stepped), measured on each axis.")
    ] = 6,
    at_um: AtStrokes = None,
    seed: ExcitationSeed = 1,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="CSV of what an instrument outside saw (docs/understand/identification.md): fixes the scale."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to write; default: runs/identify_<plant>-<lane>-<n>.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Frequency response from squared voltages to sense counts, modes, static gains and offsets, in the closed loop;
    and a stage file with what was found, which runs at once: --stage FOLDER/stage.toml.

    Exit code 0 if the fit leaves nothing but noise, 1 if it leaves more (then the
    errors are no bounds), 2 for bad input.
    """
    from dataclasses import replace

    from hil.api.identify import identify as identified
    from hil.studies.excited_lane import lane_on
    from hil.studies.identify import identification
    from hil.studies.identify.outside_scale import outside_scale, read_points
    from pkxyz_ctrl.config.bus import BusConfig
    from pkxyz_ctrl.stage import Stage

    if out is not None:
        folder_to_write(out)
        if (out / STAGE).exists() and (out / STAGE).samefile(find("stages", stage)):
            raise ConfigError(f"--out: {out}: its {STAGE} is the --stage that is identified; give another folder")
    on_bus = load("buses", bus, BusConfig)
    closed_in = lane_on(on_bus, lane, plant)
    say_if_compiling(quiet=as_json)
    outside = None if reference is None else outside_scale(Stage.load(stage), *read_points(reference))
    bar = bar_apart if closed_in == Lane.WALL else progress_bar
    errors = amplifier_errors(on_bus, bus)
    with errors, one_line_errors(), bar("exciting the loop", quiet=as_json) as tell:
        found = identified(
            stage=stage, plant=plant, controller=controller, bus=bus, lane=closed_in, tones=tones.value,
            amplitude_nm=amplitude_nm, periods=periods, at_um=at_um, seed=seed, on_progress=tell, say=note,
        )  # fmt: skip
    found = replace(found, outside=outside)
    with one_line_errors():
        data = identification.as_json(found)
    folder = _write(out, found, data, find("stages", stage))
    if as_json:
        print(json.dumps(data, allow_nan=False))
    else:
        _show(found, data, folder)
    raise typer.Exit(0 if found.modes.noise_alone else 1)


def _write(out: Path | None, found: "Identification", data: dict[str, Any], stage: Path) -> Path:
    from hil.pictures.identify import draw_response
    from hil.runs.run_folder import next_free
    from hil.studies.identify.calibrated_stage import write_calibrated_stage
    from hil.studies.identify.identification import response_csv

    folder = folder_to_write(out or next_free(Path("runs"), f"identify_{found.plant.replace(' ', '_')}", found.lane))
    with writing(folder):
        text = json.dumps(data, indent=2, allow_nan=False) + "\n"
        (folder / "identification.json").write_text(text, encoding="utf-8")
        (folder / "response.csv").write_text(response_csv(found), encoding="utf-8")
        draw_response(found, folder / "response.png")
        (folder / STAGE).unlink(missing_ok=True)
    if found.modes.noise_alone:
        write_calibrated_stage(stage, found, folder.name, folder / STAGE)
    return folder


def _show(found: "Identification", data: dict[str, Any], folder: Path) -> None:
    import numpy as np

    modes, zero = found.modes, found.response.zero
    strokes = " / ".join(f"{q:.2f}" for q in data["strokes_um"])
    say(f"{data['stage']} on plant {data['plant']}, {data['controller']} on {data['bus']}, strokes {strokes} um")
    table = plain_table("mode", "frequency (Hz)", "by the stage file", "damping ratio", "Q")
    for n, mode in enumerate(data["modes"]):
        table.add_row(
            f"{n + 1}", _pm(mode["frequency_hz"], mode["frequency_error_hz"]), f"{mode['drawn_hz']:.1f}",
            _pm(mode["damping"], mode["damping_error"]), f"{mode['quality_factor']:.1f}",
        )  # fmt: skip
    print_whole(table)
    if not modes.apart.all():
        n = int(np.argmin(modes.apart))
        say(f"modes {n} and {n + 1} coincide: one pair of poles tells them as well as two")
    table = plain_table("chain", "own comb (counts/V^2)", "comb 1", "comb 2", "comb 3", "sense zero (fF)", "counts")
    for i in range(3):
        entries = [f"{v:.3f}" for v in modes.static_gain[i]]
        table.add_row(
            f"{i + 1}", _pm(modes.static_gain[i, i], modes.static_gain_standard_error[i, i]), *entries,
            _pm(zero.offset_f[i] * 1e15, zero.standard_error_f[i] * 1e15), f"{zero.offset_count[i]:.1f}",
        )  # fmt: skip
    print_whole(table)
    fit = data["fit"]
    verdict = "noise alone is left" if modes.noise_alone else bad("more than noise is left: the errors are no bounds")
    say(
        f"{fit['tones']} tones, fitted to {fit['highest_hz']:.0f} Hz: chi-square {fit['chi_square']:.2f}, ",
        verdict,
        f"; coherence there at least {fit['least_coherence']:.3f}",
    )
    if modes.sense_corner_hz is not None and modes.sense_corner_standard_error_hz is not None:
        say(f"sense chain: a pole at {_pm(modes.sense_corner_hz, modes.sense_corner_standard_error_hz)} Hz")
    _show_gains(found)
    _show_calibration(found)
    if found.outside is None:
        say(f"not known from inside: {data['not_known_from_inside']}")
    say(f"written: {folder}")
    if modes.noise_alone:
        say(f"to run with it: pkxyz sil --stage {folder / STAGE}")
    else:
        say("no stage file was written, as the errors are no bounds; raise --amplitude or --periods")


def _show_gains(found: "Identification") -> None:
    """Of each chain relative to the stage file; apart from each other with an outside reference only."""
    outside, comb, (product, error) = found.outside, found.comb_gain, found.chain_gain
    table = plain_table("chain", "sense x comb / mass", "sense", "comb")
    for i in range(3):
        sense = "?" if outside is None else _pm(outside.sense_gain[i], outside.standard_error[i])
        pull = "?" if comb is None else _pm(comb[0][i], comb[1][i])
        table.add_row(f"{i + 1}", _pm(product[i], error[i]), sense, pull)
    say("relative to the stage file, the combs if its mass is right:")
    print_whole(table)
    if outside is not None:
        rests = ", ".join(f"{v * 1e6:.4f}" for v in outside.origin_m)
        left_nm = outside.residual_m * 1e9
        say(f"reference: {outside.points} points, {left_nm:.2f} nm rms left; the stage rests at {rests} um")


def _show_calibration(found: "Identification") -> None:
    """By the drawing, as the stage file has it."""
    numbers = found.calibrated.calibration
    errors = numbers.standard_error
    assert errors is not None
    table = plain_table("chain", "sense", "comb", "sliders", "cranks")
    for i in range(3):
        sense = _pm(numbers.sense_gain[i], errors.sense_gain[i]) if errors.sense_gain[i] else "as drawn"
        table.add_row(
            f"{i + 1}", sense, _pm(numbers.comb_gain[i], errors.comb_gain[i]),
            _pm(numbers.slider_stiffness[i], errors.slider_stiffness[i]),
            _pm(numbers.crank_stiffness[i], errors.crank_stiffness[i]),
        )  # fmt: skip
    say("calibration, relative to the drawing and its mass:")
    print_whole(table)
    assert numbers.quality_factor is not None
    assert numbers.sense_delay_s is not None
    say(
        f"links {_pm(numbers.link_stiffness, errors.link_stiffness)}, lift {_pm(numbers.lift, errors.lift)}, "
        f"Q {_pm(numbers.quality_factor, errors.quality_factor)}, "
        f"delay {_pm(numbers.sense_delay_s * 1e6, errors.sense_delay_s * 1e6)} us beyond the amplifier as drawn",
    )
    if found.calibrated.differ and not errors.sense_gain[0]:
        say(bad("the ratios of the sense gains contradict reciprocity"))


def _pm(value: float, error: float) -> str:
    """A number with its standard error, to two digits of the latter."""
    import math

    digits = max(0, 1 - math.floor(math.log10(error))) if error > 0 else 6
    return f"{value:.{digits}f} +- {error:.{digits}f}"

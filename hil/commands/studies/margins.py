"""``pkxyz margins``: how far a law is from instability, computed, over changed plants, and measured while it runs."""

import json
import math
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
from hil.screen.terminal import bad, note, plain_table, print_whole, say, warned
from pkxyz_ctrl.config.files import load

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.table import Table

    from hil.lanes.setup import Setup
    from hil.studies.margins.loop import Agreement, ChangedPlants, Loop
    from hil.studies.margins.measured import MeasuredLoop
    from pkxyz_ctrl.design.margins.margins import Margins, Sensitivities


def margins(
    controller: NameOrFile = "lqg",
    stage: NameOrFile = "reconstructed",
    bus: NameOrFile = "fd_5k",
    at_um: AtStrokes = None,
    perturbed: Annotated[bool, typer.Option("--perturbed", help="Also Ms over the changed plants.")] = False,
    tolerances: Annotated[str, typer.Option(help="Name or file of what changes, for --perturbed.")] = "wide",
    measured: Annotated[bool, typer.Option("--measured", help="Also measure by exciting the running loop.")] = False,
    lane: Annotated[
        InProcessLane | None,
        typer.Option(help="Where to measure: simulated, fast by default; a bus that leads to devices goes at rate."),
    ] = None,
    tones: Annotated[
        Tones, typer.Option(help="All tones at once, or one after another (20 of them).")
    ] = Tones.MULTISINE,
    plant: Annotated[
        str | None, typer.Option(help="Name or file of the simulated plant that is measured; default: nominal.")
    ] = None,
    amplitude_nm: Annotated[float, typer.Option(min=0.1, max=100.0, help="Of each tone.")] = 5.0,
    periods: Annotated[int, typer.Option(min=3, max=1000, help="Of one second, measured on each axis.")] = 6,
    seed: ExcitationSeed = 1,
    out: Annotated[Path | None, typer.Option(help="Folder for margins.json, bode.png and nyquist.png.")] = None,
    as_json: AsJson = False,
) -> None:
    """Loop, sensitivity and complementary sensitivity, per axis and MIMO, exact at the samples, delays included.

    Exit code 0 if every loop is stable and, on the nominal plant, what was measured agrees with what was computed; 1 if
    not; 2 for bad input.
    """
    from hil.api.design import design
    from hil.lanes.setup import bare_setup
    from hil.studies.excited_lane import lane_on
    from hil.studies.margins import loop as loops
    from hil.studies.margins.loop import agreement, over_changed_plants
    from hil.studies.operating_point import operating_strokes
    from pkxyz_ctrl.config.bus import BusConfig
    from pkxyz_ctrl.design.margins.tolerances import Tolerances
    from pkxyz_ctrl.stage import Stage

    wide = load("tolerances", tolerances, Tolerances)
    strokes = operating_strokes(Stage.load(stage), at_um)
    if out is not None:
        folder_to_write(out)
    closed_in = None
    if measured:
        closed_in = lane_on(load("buses", bus, BusConfig), lane, plant)
        say_if_compiling(quiet=as_json)
    with one_line_errors():
        law = design(controller, stage=stage, bus=bus)
        device, config, on_bus, loop = law.stage, law.controller, law.bus, law.loop
        computed = law.margins(at_um)
        data: dict[str, Any] = {
            "controller": config.name, "stage": device.config.name, "bus": on_bus.name,
            "strokes_um": [float(q) * 1e6 for q in strokes], "computed": loops.as_json(computed),
            "holds": _WHILE_FREE if config.law == "mpc" else "everywhere inside the limits",
        }  # fmt: skip
        changed = None
        if perturbed:
            with progress_bar("changed plants", quiet=as_json) as tell:
                changed = over_changed_plants(loop, wide.cases(), tell)
            data["perturbed"] = _changed_data(changed, wide.name)
        response = compared = None
        if closed_in is not None:
            at_rate = closed_in == Lane.WALL
            bar = bar_apart if at_rate else progress_bar
            with amplifier_errors(on_bus, bus), bar("exciting the loop", quiet=as_json) as tell:
                setup = bare_setup(stage, plant or "nominal", config, on_bus, seed)
                response = _measure(setup, strokes, closed_in, tones, amplitude_nm, periods, tell)
            compared = agreement(response, loop.response(strokes, response.frequency_hz))
            data["measured"] = loops.as_json(response.margins()) | {
                "lane": closed_in, "plant": None if at_rate else setup.plant.name, "seed": seed,
                "tones": len(response.frequency_hz), "amplitude_nm": amplitude_nm, "periods": response.periods,
                "missed_ticks": response.missed_ticks,
                "agreement": vars(compared) | {"holds": compared.holds},
            }  # fmt: skip
    if out is not None:
        _write(out, data, loop, strokes, changed, response)
    if as_json:
        print(json.dumps(data, allow_nan=False))
    else:
        _show(data, computed, changed, response, compared)
    stable = computed.stable and (changed is None or math.isfinite(changed.worst[1]))
    as_computed = closed_in != Lane.WALL and plant in (None, "nominal")  # what else is there need not be as computed
    agrees = compared is None or compared.holds or not as_computed
    raise typer.Exit(0 if stable and agrees else 1)


def _measure(
    setup: "Setup", strokes: Any, lane: Lane, kind: Tones, amplitude_nm: float, periods: int,
    tell: "Callable[[int, int], None]",
) -> "MeasuredLoop":  # fmt: skip
    from hil.lanes.excitation import excitation, tones
    from hil.studies.margins.excited import at_point, periods_of
    from hil.studies.margins.measured import measure

    seconds, measured = periods_of(kind.value, lane, periods)
    period_ticks = round(seconds / setup.bus.period_s)
    count, lowest = (20, 1) if kind is Tones.STEPPED else (120, math.ceil(5 * seconds))
    added = excitation(
        kind.value, tones(period_ticks, count, lowest), period_ticks=period_ticks, periods=measured,
        amplitude_m=amplitude_nm * 1e-9, first_tick=0, seed=setup.seed,
    )  # fmt: skip
    return measure(at_point(setup, strokes, added), lane, tell, note)


def _changed_data(changed: "ChangedPlants", tolerances: str) -> dict[str, Any]:
    worst, peak = changed.worst
    finite = [p if math.isfinite(p) else None for p in changed.peak_s]
    return {
        "tolerances": tolerances,
        "plants": len(finite),
        "unstable": finite.count(None),
        "worst": {"plant": worst.name, "peak_s": peak if math.isfinite(peak) else None},
        "peak_s": dict(zip((case.name for case in changed.cases), finite, strict=True)),
    }


def _write(
    out: Path, data: dict[str, Any], loop: "Loop", strokes: Any, changed: "ChangedPlants | None",
    measured: "MeasuredLoop | None",
) -> None:  # fmt: skip
    import numpy as np

    from hil.pictures.margins import draw_bode, draw_nyquist

    with writing(out):
        (out / "margins.json").write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    f = np.unique(np.r_[np.geomspace(5.0, 0.4999 / loop.bus.period_s, 700), np.linspace(450.0, 950.0, 500)])
    f = f[f < 0.5 / loop.bus.period_s]
    # those at the point itself: at the others they look alike
    cases = (
        [] if changed is None else [c for c in changed.cases if np.array_equal(c.strokes_m, changed.cases[0].strokes_m)]
    )
    others = [loop.response(c.strokes_m, f, c.perturbation) for c in cases]
    title = f"{data['controller']} on {data['bus']}"
    draw_bode(out / "bode.png", title, loop.response(strokes, f), others, measured)
    draw_nyquist(out / "nyquist.png", title, loop.response(strokes, f), others, measured)


_WHILE_FREE = "while no plan meets a limit"

_COLUMNS = ("", "Ms", "Mt", "disk", "-3 dB (Hz)", "gain (dB)", "phase (deg)", "delay (us)")
"""Peaks of S and T, disk margin, where |S| passes -3 dB, and the margins of gain, phase and delay."""


def _show(
    data: dict[str, Any], computed: "Margins", changed: "ChangedPlants | None", measured: "MeasuredLoop | None",
    compared: "Agreement | None",
) -> None:  # fmt: skip
    strokes = " / ".join(f"{q:g}" for q in data["strokes_um"])
    say(f"{data['controller']} on {data['bus']}, strokes {strokes} um")
    if data["holds"] == _WHILE_FREE:
        say(warned(f"holds {_WHILE_FREE}"), ": there it is linear")
    if not computed.stable:
        say(bad("unstable"), f": spectral radius {computed.spectral_radius:.4f}")
    table = plain_table(*_COLUMNS)
    _rows(table, computed, "")
    if measured is not None:
        _rows(table, measured.margins(), ", measured")
    print_whole(table)
    if changed is not None:
        worst, peak = changed.worst
        unstable = sum(not math.isfinite(p) for p in changed.peak_s)
        verdict = bad(f"{unstable} unstable, among them") if unstable else f"all stable, Ms at most {peak:.2f}:"
        say(f"{len(changed.peak_s)} changed plants: ", verdict, f" {worst.name}")
    if compared is not None:
        verdict = "agrees" if compared.holds else bad("disagrees")
        say(
            "measured S ",
            verdict,
            f": at most {compared.largest:.1f} standard errors from the computed one (noise alone stays "
            f"below {compared.bound:.1f}), {compared.largest_difference:.3f} in |S|",
        )


def _rows(table: "Table", found: "Margins", suffix: str) -> None:
    for name, axis in zip("xyz", found.axes, strict=True):
        phase = "any" if math.isinf(axis.phase_margin_rad) else f"{math.degrees(axis.phase_margin_rad):.1f}"
        delay = "any" if math.isinf(axis.delay_margin_s) else f"{axis.delay_margin_s * 1e6:.0f}"
        gain = "any" if math.isinf(axis.gain_margin) else f"{20.0 * math.log10(axis.gain_margin):.1f}"
        table.add_row(name + suffix, *_sensitivities(axis), gain, phase, delay)
    table.add_row("MIMO" + suffix, *_sensitivities(found.mimo), "", "", "")


def _sensitivities(found: "Sensitivities") -> tuple[str, ...]:
    return (f"{found.peak_s:.2f}", f"{found.peak_t:.2f}", f"{found.disk_margin:.2f}", f"{found.bandwidth_hz:.0f}")

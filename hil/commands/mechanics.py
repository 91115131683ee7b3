"""``pkxyz paper``, ``workspace``, ``design`` and ``linearisation``: the design theory at the command line.

Here lengths are um, voltages V and frequencies Hz; behind it all is SI. Errors of the theory become
``ConfigError``, one line.
"""

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.screen.options import AsJson, Workers
from hil.screen.outputs import folder_to_write, picture_to_write
from hil.screen.terminal import bad, good, plain_table, say, screen, warned
from pkxyz_ctrl.config.files import ConfigError, load, require_finite

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

    from pkxyz_ctrl.mechanics.reproduction import Row
    from pkxyz_ctrl.mechanics.selection import Selection
    from pkxyz_ctrl.stage import Stage

_WIDE = 150  # columns that the table of the paper's numbers needs
_STYLES = {"reproduces": good, "rounded": good, "misprint": warned, "not reproducible": bad}

StageName = Annotated[str, typer.Option("--stage", help="A shipped stage's name or a TOML file.")]
OutFolder = Annotated[Path | None, typer.Option(help="Folder for the pictures; none are drawn without it.")]


@contextmanager
def _one_line_errors() -> Iterator[None]:
    from pkxyz_ctrl.elements.errors import GeometryError, InfeasibleDesignError
    from pkxyz_ctrl.stage import StageDomainError

    try:
        yield
    except (GeometryError, InfeasibleDesignError, StageDomainError) as error:
        raise ConfigError(str(error)) from None


def paper(as_json: AsJson = False, out: OutFolder = None) -> None:
    """Every number that the paper prints, beside what its two designs give; with --out also its figures."""
    from pkxyz_ctrl.mechanics.published import entries
    from pkxyz_ctrl.mechanics.reproduction import reproduction_table
    from pkxyz_ctrl.stage import Stage

    stages = {name: Stage.load(name) for name in ("printed", "reconstructed")}
    rows = reproduction_table(entries(), stages["printed"], stages["reconstructed"])
    if out is not None:
        from hil.pictures.mechanics import draw_design_space, draw_modes
        from hil.pictures.workspace import draw_edge_path, draw_workspace

        folder, stage = folder_to_write(out), stages["reconstructed"]
        draw_design_space(stages, folder / "figure_4_design_space.png")
        draw_workspace(stage, 130.0, folder / "figure_7_workspace.png")
        draw_modes(stage, folder / "figure_8_modes.png")
        draw_edge_path(stage, folder / "figure_b_edge_path.png")
    if as_json:
        print(json.dumps({"rows": [_row_data(row) for row in rows]}, allow_nan=False))
        return
    if screen().width >= _WIDE:
        screen().print(_paper_table(rows))
    else:
        for row in rows:
            say(*_paper_lines(row))
    counts = {v: sum(row.verdict == v for row in rows) for v in dict.fromkeys(row.verdict for row in rows)}
    say(f"{len(rows)} numbers: " + ", ".join(f"{n} {v}" for v, n in counts.items()))


def _row_data(row: "Row") -> dict[str, Any]:
    corrected = (
        None if row.corrected_from_to is None else dict(zip(("text", "computed"), row.corrected_from_to, strict=True))
    )
    return {key: value for key, value in vars(row).items() if key != "corrected_from_to"} | {"corrected": corrected}


def _paper_lines(row: "Row") -> "tuple[str | Text, ...]":
    """A row for a narrow screen or a pipe: one line of figures, one of reason."""
    figures = [f"{row.published_text} {row.unit}".rstrip() + " published"]
    for design, value in (("printed", row.printed), ("reconstructed", row.reconstructed)):
        figures += [] if value is None else [f"{value:.6g} {design}"]
    verdict = _STYLES[row.verdict](row.verdict)
    return f"{row.where}  {row.quantity}: {', '.join(figures)}: ", verdict, f"\n    {row.why}"


def _paper_table(rows: "list[Row]") -> "Table":
    table = plain_table()
    table.show_header = True
    for heading in ("where", "number", "unit", "published", "printed", "reconstr.", "off (%)", "verdict", "why"):
        numeric = heading in ("published", "printed", "reconstr.", "off (%)")
        table.add_column(
            heading, justify="right" if numeric else "left", no_wrap=numeric or heading in ("where", "verdict")
        )
    for row in rows:
        off = [d for d in (row.difference_printed, row.difference_reconstructed) if d is not None]
        nearest = f"{round(min(off, key=abs) * 100, 9):+.2g}" if off else ""  # what rounding leaves is no difference
        figures = ["" if v is None else f"{v:.6g}" for v in (row.printed, row.reconstructed)]
        verdict = _STYLES[row.verdict](row.verdict)
        table.add_row(row.where, row.quantity, row.unit, row.published_text, *figures, nearest, verdict, row.why)
    return table


def workspace(
    stage: StageName = "reconstructed",
    v_max: Annotated[float | None, typer.Option(help="Voltage limit in V; default: the stage's.")] = None,
    as_json: AsJson = False,
    out: OutFolder = None,
) -> None:
    """What the platform reaches, the cubes inside, and how much of it a voltage limit can hold."""
    from pkxyz_ctrl.mechanics.workspace import held_volume
    from pkxyz_ctrl.mechanics.workspace import workspace as measure
    from pkxyz_ctrl.stage import Stage

    device = Stage.load(stage)
    limit = device.voltage_max_v if v_max is None else require_finite(v_max, "--v-max")
    with _one_line_errors():
        found, held = measure(device), held_volume(device, limit)
        data = _workspace_data(device, limit) | {
            "volume_um3": {
                "linear": found.linear_volume_m3 * 1e18,
                "exact": found.exact_volume.value_m3 * 1e18,
                "exact_error": found.exact_volume.error_m3 * 1e18,
                "held": held.value_m3 * 1e18,
                "held_error": held.error_m3 * 1e18,
                "held_share": held.value_m3 / found.exact_volume.value_m3,
            },
            "extents_um": {
                kind: {axis: [float(low[i]) * 1e6, float(high[i]) * 1e6] for i, axis in enumerate("xyz")}
                for kind, low, high in (
                    ("linear", found.linear_low_m, found.linear_high_m),
                    ("exact", found.exact_low_m, found.exact_high_m),
                )
            },
        }
        if out is not None:
            from hil.pictures.workspace import draw_workspace

            draw_workspace(device, limit, folder_to_write(out) / "workspace.png")
    if as_json:
        print(json.dumps(data, allow_nan=False))
        return
    _print_workspace(data)


def _workspace_data(device: "Stage", limit_v: float) -> dict[str, Any]:
    from pkxyz_ctrl.mechanics.inscribed import inscribed_cube
    from pkxyz_ctrl.mechanics.workspace import box_corners, stroke_box, voltage_needed_v

    corners = box_corners(*stroke_box(device))
    positions, volts = device.forward_kinematics(corners), voltage_needed_v(device, corners)
    return {
        "stage": device.config.name,
        "v_max": limit_v,
        "inscribed_cube_um": {
            "standing": inscribed_cube(device).side_m * 1e6,
            "along_axes": inscribed_cube(device, aligned=True).side_m * 1e6,
        },
        "corners": [
            {
                "stroke_um": [float(v) * 1e6 for v in q],
                "position_um": [float(v) * 1e6 for v in p],
                "voltage_v": None if math.isnan(volt) else float(volt),
            }
            for q, p, volt in zip(corners, positions, volts, strict=True)
        ],
    }


def _print_workspace(data: dict[str, Any]) -> None:
    volume, cube = data["volume_um3"], data["inscribed_cube_um"]
    say(f"Stage {data['stage']}, limit {data['v_max']:g} V")
    table = plain_table()
    table.add_row("volume, exact", f"{volume['exact']:.1f} um^3", f"linear {volume['linear']:.1f} um^3")
    share = f"{volume['held_share']:.1%} of it, ± {volume['held_error']:.2g} um^3"
    table.add_row(f"held with {data['v_max']:g} V", f"{volume['held']:.1f} um^3", share)
    for axis in "xyz":
        (low, high), (flat_low, flat_high) = (data["extents_um"][kind][axis] for kind in ("exact", "linear"))
        table.add_row(axis, f"{low:.2f} to {high:.2f} um", f"linear {flat_low:.2f} to {flat_high:.2f} um")
    table.add_row(
        "inscribed cube",
        f"{cube['standing']:.2f} um",
        f"standing on its corner; along x, y, z {cube['along_axes']:.2f} um",
    )
    screen().print(table)
    corners = plain_table("corner: strokes (um)", "position (um)", "needs (V)")
    for corner in data["corners"]:
        strokes, position = (", ".join(f"{v:.4g}" for v in corner[k]) for k in ("stroke_um", "position_um"))
        volts = corner["voltage_v"]
        words = "a push" if volts is None else f"{volts:.1f}" + ("" if volts <= data["v_max"] else " too much")
        corners.add_row(strokes, position, words)
    screen().print(corners)


def design(
    out: Annotated[Path, typer.Option(help="Stage file to write.")] = Path("designed.toml"),
    stroke: Annotated[float, typer.Option(help="Stroke of a comb, um.")] = 25.0,
    cube: Annotated[float, typer.Option(help="Side of the cube to be reached, um.")] = 20.0,
    f_min: Annotated[float, typer.Option(help="Lowest natural frequency, Hz.")] = 500.0,
    f_max: Annotated[float, typer.Option(help="Highest natural frequency, Hz.")] = 1000.0,
    v_max: Annotated[float, typer.Option(help="Comb voltage limit, V; the paper's 130 V cannot reach 25 um.")] = 200.0,
    force: Annotated[float | None, typer.Option(help="Comb force limit, mN, in place of --v-max.")] = None,
    layers: Annotated[
        str, typer.Option(help="Device layer 1 / device layer 2 / handle / oxide, um.")
    ] = "90/27/300/0.5",
    radius: Annotated[float, typer.Option(help="Base radius r, um.")] = 2000.0,
    mass: Annotated[float, typer.Option(help="Effective moving mass, mg.")] = 4.833,
    chains: Annotated[int, typer.Option(help="Chains whose out-of-plane hinges count, 1 or 3.")] = 1,
    stage: Annotated[str, typer.Option(help="Stage whose flexures and combs are taken.")] = "reconstructed",
    picture: Annotated[Path | None, typer.Option(help="PNG of the feasible region.")] = None,
    for_yield: Annotated[
        str | None,
        typer.Option(metavar="PROCESS", help="Search the drawing of which most devices work."),
    ] = None,
    trials: Annotated[int, typer.Option(min=1, help="Drawings to try for --for-yield, in all.")] = 300,
    devices: Annotated[int, typer.Option(min=8, help="Fresh devices that confirm it, in a closed loop.")] = 400,
    workers: Workers = None,
    as_json: AsJson = False,
) -> None:
    """Dimensions from requirements (the paper's section IV),
    written as a stage file that `pkxyz sil --stage` runs.

    With --for-yield the folder that --out names (designed/) gets chosen.toml and its runners-up, beside-N.toml. Call it
    again to go on. Exit code 1 if no drawing keeps the requirements.
    """
    from hil.commands.studies.design_for_yield import Asked
    from hil.studies.designed_stage import require_replaceable, write_stage_file
    from pkxyz_ctrl.config.stage import StageConfig
    from pkxyz_ctrl.elements.combs import voltage_for_force_v
    from pkxyz_ctrl.io.realtime import cores
    from pkxyz_ctrl.mechanics.selection import Requirements, select

    template = load("stages", stage, StageConfig)
    if chains not in (1, 3):
        raise ConfigError(f"--chains must be 1 (Eq. 19 as printed) or 3 (as the text describes it), got {chains}")
    if out.suffix != ".toml":
        raise ConfigError(f"{out}: --out must be a .toml file, so that --stage finds it")
    require_replaceable(out)
    if picture is not None:
        picture_to_write(picture, "--picture")
    layer = _layers_m(layers)
    if force is not None:
        comb = template.drive_comb.model_copy(update={"finger_height_m": layer[0]})
        v_max = float(voltage_for_force_v(comb, require_finite(force, "--force") * 1e-3))
    with _one_line_errors():
        need = Requirements(
            stroke_m=stroke / 1e6,
            cube_side_m=cube / 1e6,
            frequency_min_hz=f_min,
            frequency_max_hz=f_max,
            voltage_max_v=v_max,
            device_layer_1_m=layer[0],
            device_layer_2_m=layer[1],
            handle_layer_m=layer[2],
            oxide_m=layer[3],
            base_radius_m=radius / 1e6,
            mass_kg=mass / 1e6,
            out_of_plane_chains=chains,
        )
        if need.voltage_max_v > 1000:
            raise ConfigError(f"voltage limit <= 1000 V is violated: {need.voltage_max_v:g} V")
        if for_yield is not None:
            Asked(need, template, for_yield, trials, devices, workers or cores(), out.with_suffix(""), as_json).run()
        chosen = select(need, template, name=out.stem)
    write_stage_file(chosen.config, need, out, "the point where the product of the margins is largest")
    if picture is not None:
        from hil.pictures.mechanics import draw_selection

        draw_selection(chosen, picture)
    _report_design(chosen, out, as_json)


def _layers_m(text: str) -> list[float]:
    try:
        layers = [float(part) / 1e6 for part in text.split("/")]
    except ValueError:
        layers = []
    if len(layers) != 4:
        raise ConfigError(
            f"--layers takes four thicknesses in um, device 1/device 2/handle/oxide, like 90/27/300/0.5; got {text!r}"
        )
    return layers


def _report_design(chosen: "Selection", out: Path, as_json: bool) -> None:
    from pkxyz_ctrl.mechanics.selection import MARGINS

    geometry = chosen.config.geometry
    height, reach = geometry.height_rest_m, geometry.projection_rest_m
    data = {
        "stage_file": str(out),
        "l1_um": geometry.crank_length_m * 1e6,
        "l2_um": math.hypot(height, reach) * 1e6,
        "alpha_0_rad": math.atan2(height, reach),
        "cube_um": chosen.cube_side_m * 1e6,
        "feasible_share": float(chosen.region.feasible().mean()),
        "margins": dict(zip(MARGINS, chosen.margin.tolist(), strict=True)),
    }
    if as_json:
        print(json.dumps(data, allow_nan=False))
        return
    say(f"L1 = {data['l1_um']:.1f} um, L2 = {data['l2_um']:.1f} um, alpha_0 = {data['alpha_0_rad']:.4f} rad")
    table = plain_table("requirement", "margin")
    for name, margin in zip(MARGINS, chosen.margin, strict=True):
        table.add_row(name, f"{margin:.1%}" if margin < 10 else "ample")
    screen().print(table)
    say(f"written to {out}; run it with: pkxyz sil --stage {out}")


def linearisation(
    stage: StageName = "reconstructed",
    move: Annotated[float, typer.Option(help="Size of the moves about a set-point, um.")] = 1.0,
    as_json: AsJson = False,
    out: OutFolder = None,
) -> None:
    """What one constant Jacobian costs against relinearising at the set-point and against the exact solution."""
    import numpy as np

    from pkxyz_ctrl.mechanics.linearisation import linearisation_study
    from pkxyz_ctrl.stage import Stage

    device = Stage.load(stage)
    with _one_line_errors():
        study = linearisation_study(device, points=17, move_m=move * 1e-6)
    kinds = {
        "constant_at_rest": study.at_rest_m,
        "constant_at_middle": study.at_middle_m,
        "newton_step": study.newton_m,
        "relinearised": study.relinearised_m,
    }
    worst = {k: dict(zip("xyz", (np.abs(e).max(axis=0) * 1e9).tolist(), strict=True)) for k, e in kinds.items()}
    if out is not None:
        from hil.pictures.mechanics import draw_linearisation

        draw_linearisation(study, device.config.name, folder_to_write(out) / "linearisation.png")
    if as_json:
        print(json.dumps({"stage": device.config.name, "move_um": move, "worst_nm": worst}, allow_nan=False))
        return
    table = plain_table("worst error (nm)", "x", "y", "z")
    for kind, error in worst.items():
        table.add_row(kind.replace("_", " "), *(f"{error[axis]:.3g}" for axis in "xyz"))
    screen().print(table)

"""Numbers in the prose of README and docs, computed again: what a page says is what the program does today."""

import json
import math
import re
import runpy
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hil
from hil.studies.montecarlo import Study, run_one
from pkxyz_ctrl import Stage
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.mechanics.modes import modes
from pkxyz_ctrl.mechanics.published import entries
from pkxyz_ctrl.mechanics.reproduction import reproduction_table

ROOT = Path(__file__).parents[2]


def page_lines(name: str) -> str:
    """The text of a page as it stands."""
    return (ROOT / name).read_text(encoding="utf-8")


def page(name: str) -> str:
    """The text of a page with its lines joined."""
    return " ".join(page_lines(name).split())


@cache
def rms_nm(scenario: str, controller: str | None = None) -> tuple[float, ...]:
    """RMS error of a run of the fast lane by axis; lockstep has the same bits."""
    run = hil.run(hil.load_scenario(scenario, controller=controller))
    return tuple(run.summary["rms_error_nm"].values())


def row_of(text: str, start: str) -> list[float]:
    """The numbers of the table row that begins with ``start``, behind it."""
    found = re.search(rf"\| {re.escape(start)}[^|]*\|([^|]*)\|", text)
    assert found is not None, start
    return [float(n) for n in re.findall(r"\d+\.?\d*", found[1])]


def test_the_readme_s_table_is_that_of_today() -> None:
    made = runpy.run_path(str(ROOT / "docs" / "tables" / "readme.py"))
    text = made["PAGE"].read_text(encoding="utf-8")
    assert made["filled_in"](text) == text, "run: python docs/tables/readme.py"


@pytest.mark.parametrize("scenario", ["circle", "spiral", "lissajous", "sweep", "path"])
def test_how_well_trajectories_are_followed(scenario: str) -> None:
    shown = row_of(page("docs/lookup/trajectories.md").partition("## How well")[2], f"`{scenario}`")
    assert shown == [float(f"{v:.1f}") for v in rms_nm(scenario)]


def test_how_the_laws_follow_a_circle() -> None:
    """Columns are laws, cells x / y, and of the second row mild; lab."""
    table = page_lines("docs/understand/laws.md")
    for start, ways in (
        ("circle of 4 um, 100 Hz, nominal (nm)", [("circle", "nominal")]),
        ("the same, mild; lab (nm)", [("circle", "mild"), ("circle_lab", "lab")]),
    ):
        row = next(line for line in table.splitlines() if line.startswith(f"| {start}"))
        for controller, cell in zip(("youla", "lqg", "robust", "open_loop"), row.split("|")[2:-1], strict=True):
            for told, (scenario, plant) in zip(cell.split(";"), ways, strict=False):
                run = hil.run(hil.load_scenario(scenario, plant=plant, controller=controller))
                x_nm, y_nm, _ = run.summary["rms_error_nm"].values()
                digits = 1 if "." in told else 0
                assert f"{x_nm:.{digits}f} / {y_nm:.{digits}f}" == told.strip(), (start, controller)


def test_the_tutorial_tells_what_its_commands_print(tmp_path: Path) -> None:
    text = page("docs/learn/index.md")
    assert row_of(text, "`youla`, the default") == [float(f"{v:.1f}") for v in rms_nm("raster_mild")]
    assert row_of(text, "`lqg`") == [float(f"{v:.1f}") for v in rms_nm("raster_mild", "lqg")]
    assert row_of(text, "`open_loop`") == [float(f"{v:.0f}") for v in rms_nm("raster_mild", "open_loop")]
    base = (ROOT / "configs/controllers/lqg.toml").read_text(encoding="utf-8").replace('law = "lqg"', 'law = "linear"')
    laws = {
        "integral": ("[14600.0]", "[1.0, 0.0]", "Ms 2.4, disturbances attenuated to 30 Hz in x and y, {} nm"),
        "notch": ("[3.0e4, 1.4e7, 4.538e11]", "[1.0, 3889.0, 1.513e7, 0.0]", "the error falls to {} nm"),
    }
    for name, (numerator, denominator, words) in laws.items():
        path = tmp_path / f"{name}.toml"
        path.write_text(f"{base}\n[linear]\n[[linear.axis]]\nnumerator = {numerator}\ndenominator = {denominator}\n")
        assert numerator[1:-1] in text
        assert words.format(" / ".join(f"{v:.1f}" for v in rms_nm("raster_mild", str(path)))) in text
    integral, notch = (hil.design(str(tmp_path / f"{name}.toml")).margins().axes[0] for name in laws)
    assert (f"{integral.peak_s:.1f}", f"{integral.bandwidth_hz:.0f}") == ("2.4", "30")
    assert (f"{notch.peak_s:.1f}", f"{notch.bandwidth_hz:.0f}") == ("1.3", "55")
    assert "Ms is 1.3 in x and y and disturbances are attenuated to 55 Hz" in text


def test_the_heights_that_voltages_hold() -> None:
    text, stage = page("docs/do/hardware.md"), Stage.load("reconstructed")
    for volts in (5, 31, 69, 182):
        height_m = row_of(text, f"{volts} ")[0] * 1e-6
        assert stage.holding_voltages([0.0, 0.0, height_m])[0] == pytest.approx(volts, rel=0.04)
    assert f"shows {stage.holding_voltages([0.0, 0.0, 15e-9])[0]:.1f} V on each comb" in text


def test_the_stage_about_rest_and_over_its_workspace() -> None:
    stage = Stage.load("reconstructed")
    stiffness = np.diag(stage.stiffness([0.0, 0.0, 0.0]))
    words = f"{stiffness[0]:.0f} N/m in x and y and {stiffness[2]:.0f} N/m in z at rest"
    assert words in page("docs/do/own-law.md")
    text = page("docs/understand/mechanics.md")
    strokes = np.stack(np.meshgrid(*[np.linspace(0, 25e-6, 6)] * 3), axis=-1).reshape(-1, 3)
    hessians = stage.stiffness(stage.forward_kinematics(strokes))
    found = np.array([modes(h, stage.mass_kg).frequency_hz for h in hessians])
    growth = hessians[:, 2, 2].max() / stiffness[2] - 1
    assert f"H_zz grows by {growth:.0%} from rest to the top, f_z from".replace("%", " %") in text
    assert f"f_z from {found[:, 2].min():.0f} to {found[:, 2].max():.0f} Hz" in text
    assert f"stay within {found[:, :2].min():.0f} to {found[:, :2].max():.0f} Hz" in text
    assert f"{(90 / 50) ** 3:.1f} times that of 50 um and {(90 / 70) ** 3:.1f} times that of 70 um" in text
    for name, words in (("reconstructed", "slider at {:.0f} um"), ("printed", "({:.0f} um in the printed design")):
        geometry = Stage.load(name).config.geometry
        other = geometry.base_radius_m - geometry.projection_rest_m + geometry.crank_length_m
        assert words.format(other * 1e6) in text


def test_the_modes_that_a_law_acts_on() -> None:
    stage = Stage.load("reconstructed")
    middle = stage.forward_kinematics([12.5e-6] * 3)
    from pkxyz_ctrl.mechanics.stiffness import small_signal_stiffness_n_per_m

    held = small_signal_stiffness_n_per_m(stage, middle, stage.holding_forces(middle))
    hz = modes(held, stage.mass_kg).frequency_hz
    words = f"{hz[0]:.0f}, {hz[1]:.0f} and {hz[2]:.0f} Hz"
    assert words in page("docs/learn/index.md")
    assert words in page("docs/do/own-law.md")
    assert words in page("docs/understand/margins.md")
    assert stage.quality_factor == 20


def test_the_first_screen_and_the_first_output_are_those_of_the_default_law() -> None:
    nominal, mild, alone = rms_nm("raster"), rms_nm("raster_mild"), rms_nm("raster_mild", "open_loop")
    text = page("README.md")
    assert f"to {max(nominal):.0f} nm rms, and to {math.ceil(max(mild)):.0f} nm on a stage" in text
    assert f"where feed-forward alone is {max(alone) / 1e3:.1f} um off" in text
    tutorial = page("docs/learn/index.md")
    assert f"rms_error_nm {max(nominal):.4g} ≤ 5 holds" in tutorial
    noise = hil.run(hil.load_scenario("raster")).summary["hold_noise_nm"]
    assert f"hold_noise_nm {max(noise.values()):.4g} ≤ 2 holds" in tutorial


def test_measured_figures_of_the_readme_are_those_of_the_benchmarks() -> None:
    results = json.loads((ROOT / "benchmarks" / "results.json").read_text(encoding="utf-8"))["figures"]
    value = {f["name"]: f["value"] for f in results}
    text = page("README.md")
    assert f"({value['lockstep.realtime']:.0f} times real time)" in text
    assert f"({value['fast.realtime']:.0f} times)" in text


def test_what_learning_reaches_period_by_period() -> None:
    text = (ROOT / "docs/understand/learning.md").read_text(encoding="utf-8")
    run = hil.run(hil.load_scenario("frames_harsh"))
    periods = run.summary["learning"]["periods"]
    for words, key in (("as sensed", "sensed_nm"), ("true", "true_nm")):
        line = next(row for row in text.splitlines() if row.startswith(f"| harsh plant, {words} (nm)"))
        assert [float(c) for c in line.split("|")[2:-1]] == [float(f"{v:.1f}") for v in periods[key][:6]]


def test_the_paper_s_ratio_and_the_band() -> None:
    text, stage = page("docs/understand/mechanics.md"), Stage.load("reconstructed")
    k = np.diag(stage.stiffness([0.0, 0.0, 0.0]))
    assert f"is {math.sqrt(k[2] / k[0]):.5f} against the published 1.22321" in text
    assert all(500 < f < 1000 for f in modes(np.diag(k), stage.mass_kg).frequency_hz)


@pytest.mark.parametrize("law", ["youla", "lqg", "robust"])
def test_the_worst_sampled_plants_are_as_bad_as_told(law: str) -> None:
    """``python docs/tables/montecarlo.py`` runs all 200; here the worst one of each law runs again."""
    kept = json.loads((ROOT / "docs" / "tables" / "montecarlo.json").read_text(encoding="utf-8"))
    (cells,) = (row[1:] for row in kept["rows"] if row[0] == f"`{law}`")
    study = Study(hil.load_scenario("raster", controller=law), load("tolerances", "wide", Tolerances))
    found = run_one(study, int(cells[-1]))
    assert f"{found.rms_error_nm:.0f}" == cells[0].split(", ")[2]
    assert found.ok
    assert cells[-2] == "none"
    text = page("docs/do/tuning.md")
    if law != "youla":
        assert cells[2].split(", ")[2].startswith({"robust": "8.7", "lqg": "2.5"}[law])
        assert "Ms is 8.7 on the worst of these plants, 2.5 for `lqg`" in text


def test_ms_of_sampled_devices_is_that_of_the_last_run() -> None:
    """Of 500 under the default law by the benchmarks, of 200 under two others by the table of the tuning page."""
    measured = json.loads((ROOT / "benchmarks" / "results.json").read_text(encoding="utf-8"))["figures"]
    value = {figure["name"]: figure["value"] for figure in measured}
    p95, worst = f"{value['margins.sampled_95']:.2f}", f"{value['margins.sampled_worst']:.2f}"
    assert f"Ms is {worst} at most, {p95} at 95 %." in page("README.md")
    sampled = json.loads((ROOT / "docs" / "tables" / "montecarlo.json").read_text(encoding="utf-8"))["rows"]
    by_law = {row[0].strip("`"): row[3].split(", ")[1:] for row in sampled}
    cells = [", ".join(pair) for pair in ([p95, worst], by_law["lqg"], by_law["robust"])]
    assert f"Ms at 95 %, worst | {' | '.join(cells)} | |" in page("docs/understand/laws.md")
    peak = f"{value['margins.local_20k_peak_s']:.2f}"
    assert f"{value['margins.local_20k_rejection']:.0f} Hz in x and y, 815 in z, Ms {peak}." in page(
        "docs/understand/margins.md"
    )


def test_what_sense_counts_cover() -> None:
    analog = load("buses", "fd_5k", BusConfig).analog
    step_f = analog.sense_farad_per_count
    ends = [analog.sense_offset_f + step_f * n for n in (-32768, 32767)]
    words = "{:.2f}..{:.2f} pF in steps of {:.0f} aF".format(*(1e12 * f for f in ends), 1e18 * step_f)
    assert words in page("docs/lookup/wire.md")


def test_how_far_sampled_devices_are_off_in_a_circle() -> None:
    """As kept; the worst of them runs again."""
    kept = json.loads((ROOT / "docs" / "tables" / "montecarlo.json").read_text(encoding="utf-8"))["circle_nm"]
    told = "{median:.0f}, {p95:.0f} and {max:.0f} nm (median, 95 %, worst)".format(**kept)
    assert f"the circle errs by {told}" in page("docs/understand/laws.md")
    study = Study(hil.load_scenario("circle"), load("tolerances", "wide", Tolerances))
    assert run_one(study, kept["max_seed"]).rms_error_nm == pytest.approx(kept["max"], rel=1e-6)


def test_how_far_the_laws_reject() -> None:
    """As the pictures have it that stand beside."""
    rows = json.loads((ROOT / "docs" / "figures" / "margins.json").read_text(encoding="utf-8"))["rows"]
    hz = {row[0].strip("`"): row[3] for row in rows}
    s_at_60_hz = float(np.linalg.norm(hil.design("youla").response([60.0]).s[0], 2))
    words = f"{hz['youla']} Hz; {s_at_60_hz:.2f} | {hz['lqg']} Hz | {hz['robust']} Hz |"
    assert f"\\|S\\| < -3 dB; at 60 Hz | {words}" in page("docs/understand/laws.md")
    own = page("docs/do/own-law.md")
    assert f"rejection to {hz['youla']} Hz, 1 um jumps" in own
    assert f"disturbances above {hz['lqg']} Hz matter" in own
    assert f"rejection to {hz['robust']} Hz, stable on all" in own


def test_what_works_of_drawings_with_the_interval_of_each_and_what_differs_in_a_loop() -> None:
    """As the pictures have it that stand beside."""
    text = page("docs/do/wafer.md")
    found = json.loads((ROOT / "docs/figures/fabrication/for_yield.json").read_text(encoding="utf-8"))
    works = {name: row["works"] for name, row in found["drawings"].items()}
    told = {name: "{:.0f} % ({:.0f} to {:.0f})".format(*(100.0 * s[k] for k in ("value", "low", "high")))
            for name, s in works.items()}  # fmt: skip
    assert f"Of {works['design']['devices']} fresh devices {told['design']} of plain `design`'s work" in text
    assert f"{told['reconstructed']} of the paper's, {told['chosen']} of the best of {found['trials']} trials" in text
    fails = {name: {n: 1.0 - s["value"] for n, s in row["requirements"].items()}
             for name, row in found["drawings"].items()}  # fmt: skip
    assert {n for n, share in fails["design"].items() if share > 0.02} == {"split_hz", "top_v"}
    loops = json.loads((ROOT / "docs/figures/fabrication/wafer.json").read_text(encoding="utf-8"))
    of, hand = loops["percentiles_50_95_100"], loops["total_index_and_error"]
    peak = max(of[f"{law}.peak_s"][2] for law in ("shipped", "known"))
    assert f"All {loops['devices']} loops are stable: Ms is {peak:.1f} at most" in text.replace("**", "")
    assert f"rejected to {loops['least_rejection_hz']['shipped']:.0f} Hz at least" in text
    median_nm, p95_nm, _ = of["shipped.error_nm"]
    assert f"errors are {median_nm:.0f} nm (median; {p95_nm:.0f} at 95 %)" in text.replace("**", "")
    most = sorted(hand["shipped.error_nm"], key=lambda name: -hand["shipped.error_nm"][name][0])[:3]
    assert most == ["etch_bias_m", "sidewall_rad", "comb_gap_m"]
    assert "etch bias, sidewall and comb gap change gaps" in text
    left = {name: index for name, (index, _) in hand["known.error_nm"].items() if index > 0.05}
    assert list(left) == ["handle_m"]
    assert "With it the handle's thickness is left" in text


def many_devices() -> list[dict[str, Any]]:
    """Draws that are kept: two of 100 000 devices, and one of a million."""
    kept: list[dict[str, Any]] = json.loads((ROOT / "docs/tables/many_devices.json").read_text(encoding="utf-8"))
    return kept


def test_of_a_million_devices_as_many_work_as_of_100_000_in_intervals_a_third_as_wide() -> None:
    *fewer, most = many_devices()
    assert most["devices"] == 1_000_000
    assert most["seconds"] < 80.0 * 60.0
    for draw in fewer:
        for name, (share, low, high) in most["shares"].items():
            _, other_low, other_high = draw["shares"][name]
            assert max(low, other_low) <= min(high, other_high), name
            if name.startswith("shipped"):
                assert other_low <= share <= other_high, name
    width = most["shares"]["shipped"][2] - most["shares"]["shipped"][1]
    assert 10.0**0.5 * width == pytest.approx(
        fewer[0]["shares"]["shipped"][2] - fewer[0]["shares"]["shipped"][1], rel=0.03
    )
    told = "{:.2f} % ({:.2f} to {:.2f})".format(*(100.0 * end for end in most["shares"]["shipped"]))
    assert f"A million in {most['seconds'] / 60.0:.0f}: {told}." in " ".join(page("docs/do/wafer.md").split())


def test_of_two_draws_of_100_000_devices_as_many_work() -> None:
    """In a loop each share lies within the other's interval; of the drawing, where rare wafers fail whole, intervals
    meet.
    """
    first, second, _ = many_devices()
    assert first["devices"] == second["devices"] == 100_000
    assert max(first["seconds"], second["seconds"]) < 600.0
    for name, (share, low, high) in first["shares"].items():
        other, other_low, other_high = second["shares"][name]
        assert max(low, other_low) <= min(high, other_high), name
        if name.startswith("shipped"):
            assert low <= other <= high
            assert other_low <= share <= other_high
    told = "{:.1f} % work ({:.1f} to {:.1f})".format(*(100.0 * end for end in first["shares"]["shipped"]))
    others = f"of 100 000 others {100.0 * second['shares']['shipped'][0]:.1f}."
    text = " ".join(page("docs/do/wafer.md").split())
    assert f"100 000 devices in {second['seconds'] / 60.0:.0f} minutes (AVX-512): {told}, {others}" in text


def test_what_the_page_says_of_the_paper() -> None:
    """Beside the table of all numbers: those that the text of the page repeats."""
    rows = reproduction_table(entries(), Stage.load("printed"), Stage.load("reconstructed"))
    ours = {(row.where, row.quantity): row.reconstructed for row in rows}
    text = page("docs/understand/mechanics.md")
    for (where, quantity), words in {
        ("Eq. 8", "lambda_1 at rest, origin moved 100 um"): "λ₁ is {:.0f} um at rest",
        ("Eq. 19", "K_zz with pivots on all three chains"): "then K_zz is {:.3f} N/mm instead of",
        ("Eq. 16, 26", "K_xx with the four leaves of a spring counted once"): "K_xx is {:.4f} N/mm instead of",
        ("Eq. 34", "pull-in stroke, overlap taken off the root"): "Corrected it is {:.0f} um for the folded springs",
        ("IV.D", "pull-in stroke, all that the comb works against"): "and {:.0f} um with all that a lifting comb",
        ("IV.D", "comb force at 130 V"): "comb gives {:.2f} mN at 130 V",
        ("IV", "cube within the workspace"): "{:.2f} um standing on its corner",
    }.items():
        found = ours[where, quantity]
        assert found is not None
        assert words.format(found) in text
    frequencies = [ours["Eq. 40", quantity] for quantity in ("f_x = f_y", "f_z")]
    assert "gives {:.1f} and {:.1f} Hz".format(*frequencies) in text
    stage = Stage.load("reconstructed")
    volts = stage.holding_voltages(stage.forward_kinematics([25e-6] * 3))[0]
    assert text.count(f"{volts:.1f} V") == 2
    assert f"# V: {volts:.1f} on each comb" in page("README.md")


def test_what_a_count_of_voltage_moves() -> None:
    stage, count_v = Stage.load("reconstructed"), 200 / 32767
    heights = np.linspace(15e-6, 25e-6, 2001)
    volts = np.array([stage.holding_voltages([0.0, 0.0, z])[0] for z in heights])
    moved = (np.interp(133.0 + count_v, volts, heights) - np.interp(133.0, volts, heights)) * 1e9
    assert f"A count is {count_v * 1e3:.1f} mV, at 133 V about {moved:.1f} nm of height" in page(
        "docs/understand/laws.md"
    )


def test_where_the_changed_plants_stand() -> None:
    stage = Stage.load("reconstructed")
    strokes = np.array([case.strokes_m for case in load("tolerances", "wide", Tolerances).cases()])
    volts = stage.holding_voltages(stage.forward_kinematics(strokes))
    span_um = f"{strokes.min() * 1e6:.0f} to {strokes.max() * 1e6:.0f} um"
    assert f"strokes from {span_um} ({volts.min():.0f} to {volts.max():.0f} V to hold)" in page(
        "docs/understand/margins.md"
    )

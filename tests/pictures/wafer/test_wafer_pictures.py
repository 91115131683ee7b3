"""Pictures of a wafer: what they show are the table's numbers, read back from what was drawn."""

import numpy as np
import pytest
from process_rig import SHIPPED, STAGE

from hil.pictures.wafer import drawings, loops, overview
from hil.pictures.wafer.drawings import ERROR, PARTS, DrawingFigures, draw_drawings
from hil.pictures.wafer.overview import draw_wafer
from hil.runs.scenario import load_scenario
from hil.studies.wafer.causes import Indices
from hil.studies.wafer.closed_loop import ClosedLoops
from hil.studies.wafer.effects import MEAN
from hil.studies.wafer.shares import share_of
from hil.studies.wafer.study import WaferStudy


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were saved."""
    figures = []
    for module in (drawings, overview):
        monkeypatch.setattr(module, "save", lambda figure, path: figures.append(figure))
    return figures


def test_the_wafer_shows_the_share_that_fails_of_each_die_and_of_each_requirement(drawn, tmp_path):
    study = WaferStudy(SHIPPED, STAGE, 1)
    columns = study.columns(range(4))
    shares = {name.removeprefix("ok."): share_of(columns[name], columns["wafer"]) for name in study.requirement_columns}
    draw_wafer(SHIPPED, columns, shares, None, tmp_path / "wafer.png")
    left, middle, right = drawn[0].axes
    told = {tuple(np.round(text.xy, 6)): float(text.get_text()) for text in left.texts}
    for x_m, y_m in {(float(x), float(y)) for x, y in zip(columns["x_m"], columns["y_m"], strict=True)}:
        here = (columns["x_m"] == x_m) & (columns["y_m"] == y_m)
        fails = 100.0 * (1.0 - columns["ok"][here].mean())
        assert told[tuple(np.round((1e3 * x_m, 1e3 * y_m), 6))] == pytest.approx(fails, abs=0.5)
    lengths = [bar.get_width() for bar in middle.patches]
    assert lengths == pytest.approx([100.0 * (1.0 - share.value) for share in list(shares.values())[::-1]])
    assert len(right.get_yticklabels()) == len(SHIPPED.requirements)


def test_drawings_show_what_works_what_is_missed_their_errors_and_what_a_source_adds(drawn, tmp_path):
    error_nm = np.array([4.0, 1.0, np.nan, 2.0])  # one that has no loop
    effects = {MEAN: {ERROR: 3.0}, "hinge_m": {ERROR: 5.0}, "pressure_pa": {ERROR: 3.0}, "comb_gap_m": {ERROR: 3.05}}
    half, whole = (share_of(np.arange(40) % 2 < n, np.arange(40)) for n in (1, 2))
    shares = dict.fromkeys(PARTS, whole) | {"works": half}
    asked = {"split_hz": half, "top_v": whole}
    two = [
        DrawingFigures(name, shares, asked, scale * error_nm, effects)
        for name, scale in (("paper", 1.0), ("found", 2.0))
    ]
    draw_drawings(two, 3.0, tmp_path / "drawings.png")
    works, missed, errors, sources = drawn[0].axes
    assert [bar.get_width() for bar in works.patches] == 2 * [100.0, 100.0, 100.0, 100.0, 50.0]  # the first at the top
    interval = works.lines[-1].get_xdata()
    assert list(interval) == pytest.approx([100.0 * half.low, 100.0 * half.high])
    assert [label.get_text() for label in missed.get_yticklabels()] == ["split of the pair"]
    assert [bar.get_width() for bar in missed.patches] == [50.0, 50.0]
    for line, scale in zip(errors.lines, (1.0, 2.0), strict=False):
        assert line.get_xdata().tolist() == [scale * 1.0, scale * 2.0, scale * 4.0]
        assert line.get_ydata().tolist() == [25.0, 50.0, 75.0]
    names = [label.get_text() for label in sources.get_yticklabels()]
    assert names == ["comb gap", "hinge thickness"]  # a source that adds nothing is left out, the largest is at the top
    lengths = sorted({round(bar.get_width(), 9) for bar in sources.patches})
    assert lengths == pytest.approx([np.sqrt(3.05**2 - 3.0**2), 4.0])


def test_loops_show_every_figure_of_each_law_and_the_causes(monkeypatch, tmp_path):
    figures = []
    monkeypatch.setattr(loops, "save", lambda figure, path: figures.append(figure))
    asked = ClosedLoops(WaferStudy(SHIPPED, STAGE, 1), load_scenario("raster"), known=True)
    columns = {name: np.array([3.0, 1.0, 2.0, np.inf]) for name in asked.columns} | {"wafer": np.arange(4)}
    columns["handle_m"] = np.array([0.0, 1e-6, 2e-6, 3e-6])
    shares = dict.fromkeys(asked.laws, share_of(np.array([True, True, True, False]), np.arange(4)))
    names = (*asked.columns, "ok.shipped", "ok.known")
    found = Indices(("place", "hinge_m"), names, np.full((2, len(names)), 0.25), np.zeros((2, len(names))))
    for causes in (None, found):
        loops.draw_loops(asked, columns, shares, causes, tmp_path / "loops.png")
        panels = figures[-1].axes
        assert len(panels) == (5 if causes is None else 6)
        for plot in panels[:4]:
            assert [line.get_xdata().tolist() for line in plot.lines[:1]] == [[1.0, 2.0, 3.0]]
    heat = figures[-1].axes[-1]
    assert [label.get_text() for label in heat.get_xticklabels()][:2] == ["shipped: Ms", "shipped: rejection"]
    assert [text.get_text() for text in heat.texts] == 20 * ["25"]

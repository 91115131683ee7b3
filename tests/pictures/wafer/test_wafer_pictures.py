"""Pictures of a wafer: what they show are the table's numbers, read back from what was drawn."""

import numpy as np
import pytest
from process_rig import SHIPPED, STAGE

from hil.pictures.wafer import drawings, overview
from hil.pictures.wafer.drawings import ERROR, DrawingFigures, draw_drawings
from hil.pictures.wafer.overview import draw_wafer
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


def test_a_drawing_s_curve_is_the_share_of_all_its_devices_and_a_bar_is_what_a_source_adds(drawn, tmp_path):
    error_nm = np.array([4.0, 1.0, np.nan, 2.0])  # one that has no loop
    effects = {MEAN: {ERROR: 3.0}, "hinge_m": {ERROR: 5.0}, "pressure_pa": {ERROR: 3.0}, "comb_gap_m": {ERROR: 3.05}}
    two = [DrawingFigures(name, 0.5, scale * error_nm, effects) for name, scale in (("paper", 1.0), ("found", 2.0))]
    draw_drawings(two, 3.0, tmp_path / "drawings.png")
    left, right = drawn[0].axes
    for line, scale in zip(left.lines, (1.0, 2.0), strict=False):
        assert line.get_xdata().tolist() == [scale * 1.0, scale * 2.0, scale * 4.0]
        assert line.get_ydata().tolist() == [25.0, 50.0, 75.0]
    words = [label.get_text() for label in right.get_yticklabels()]
    assert words == ["comb gap", "hinge thickness"]  # a source that adds nothing is left out, the largest is at the top
    lengths = sorted({round(bar.get_width(), 9) for bar in right.patches})
    assert lengths == pytest.approx([np.sqrt(3.05**2 - 3.0**2), 4.0])

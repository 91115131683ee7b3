"""One style for all pictures: none brings colours, sheets or type of its own, and what is drawn twice is equal."""

import ast
import re
from pathlib import Path

import pytest

from hil.pictures.latency import draw_lateness
from hil.pictures.style import AXIS, COMB, SERIES, bound, dress, legend, save, sheet, whole_numbers

ROOT = Path(__file__).parents[2]
DRAWING = sorted(
    path
    for folder in ("hil", "docs", "benchmarks")
    for path in (ROOT / folder).rglob("*.py")
    if path.name != "style.py"
    and "drawings" not in path.parts  # docs/drawings/canvas.py has two themes of its own
    and re.search("matplotlib|pictures.style", path.read_text(encoding="utf-8"))
)
SHADES = {
    "docs/figures/margins.py": 1,
    "hil/pictures/faults.py": 3,
    "hil/pictures/report.py": 1,
    "hil/pictures/wafer/overview.py": 1,
}
"""Colours that mean something in one picture alone: a law's, degrees of lateness, the area under a line, a share half
way between bad and good.
"""

WRITTEN_TO_PAGES = {"docs/figures/bus_timing.py": 5, "docs/figures/faults.py": 1}
"""Strings with units that scripts write into tables of the docs, where micro is a u."""


def style_of_its_own(source: str) -> list[str]:
    """What a source does that is the style's: open a sheet, set sizes of type by number, hide a box, write a file."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called in ("plt.subplots", "plt.figure", "matplotlib.use") or called.endswith(".savefig"):
                found.append(called)
            if any(keyword.arg == "figsize" for keyword in node.keywords):
                found.append("figsize")
            found += [
                keyword.arg
                for keyword in node.keywords
                if keyword.arg in ("fontsize", "labelsize") and isinstance(keyword.value, ast.Constant)
            ]
    return found


def test_the_search_finds_each_of_them():
    source = 'f = Figure(figsize=(1, 2))\nf.savefig("x")\nplot.text(0, 0, "", fontsize=9)\nplt.subplots(2)\n'
    assert sorted(style_of_its_own(source)) == ["f.savefig", "figsize", "fontsize", "plt.subplots"]
    assert len(DRAWING) > 20


@pytest.mark.parametrize("path", DRAWING, ids=lambda path: path.name)
def test_no_picture_has_a_style_of_its_own(path):
    source = path.read_text(encoding="utf-8")
    assert style_of_its_own(source) == []
    colours = re.findall(r"[\"']#[0-9a-fA-F]{6}[\"']|[\"']tab:\w+[\"']", source)
    assert len(colours) == SHADES.get(str(path.relative_to(ROOT)), 0), colours


def in_plain_letters(source: str) -> list[str]:
    """Strings with a unit in which micro is a u, or a root is rt; docstrings don't count, since nobody draws them."""
    tree = ast.parse(source)
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    return [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and id(node) not in docstrings
        and re.search(r"(?<![\w$])u[mVsgN](?!\w)|rtHz", node.value)
    ]


def test_units_in_plain_letters_are_found():
    source = (
        '"""In um."""\ndef f(n):\n    """In us."""\n    g("x (um)", f"{n} us", "nm/rtHz", "µm, V/√Hz, sum, um_of")\n'
    )
    assert sorted(in_plain_letters(source)) == [" us", "nm/rtHz", "x (um)"]


@pytest.mark.parametrize("path", [*DRAWING, *(ROOT / "docs" / "drawings").glob("*.py")], ids=lambda path: path.name)
def test_pictures_write_micro_and_roots_as_such(path):
    """As the glossary says: µm in pictures, um on the screen and in pages."""
    found = in_plain_letters(path.read_text(encoding="utf-8"))
    assert len(found) == WRITTEN_TO_PAGES.get(str(path.relative_to(ROOT)), 0), found


def test_axes_and_combs_are_never_told_by_the_same_colour():
    assert not set(AXIS) & set(COMB)
    assert len(set(SERIES)) == len(SERIES)


def test_what_is_counted_has_whole_numbers_on_its_scale():
    plot = sheet(4, 3).subplots()
    plot.plot([0, 1, 2], [0, 2, 1])
    whole_numbers(plot.yaxis)
    assert all(tick == round(tick) for tick in plot.get_yticks())


def test_histograms_of_lateness_have_the_colours_of_series():
    plot = sheet(4, 3).subplots()
    draw_lateness(plot, {"wake-up": [5, 1], "cycle": [0, 4], "other": [1, 1]})
    assert [line.get_color() for line in plot.get_lines()] == list(SERIES[:3])


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_the_same_picture_has_the_same_bytes(tmp_path, kind):
    for name in ("a", "b"):
        figure = sheet(4, 3, "title")
        plot = figure.subplots()
        plot.plot([1, 2], [3, 5], label="line")
        bound(plot, 4.0, "four", 1.0)
        dress(plot, "x (µm)", "y (µm)")
        legend(plot)
        save(figure, tmp_path / f"{name}.{kind}")
    assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()

"""PlotJuggler's layouts against what it makes of our CSV: its loader's rules for columns, as its sources have them.

The delimiter is the one of tab, semicolon, comma and space that the header has most of; names are trimmed, a header of
numbers alone is none, and names that occur twice get a suffix. Lines with another number of columns are left out; a
column has the type of its first cell; time has to be a number that never falls.
"""

import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path

import pytest
from loop_rig import rows_of, setup, shortened

from hil.recording import export
from hil.recording.recording import Recording, RecordingWriter
from pkxyz_ctrl.config.files import CONFIG_DIR

LAYOUTS = sorted((CONFIG_DIR / "plotjuggler").glob("*.xml"))


def series_of(file: Path, time_axis: str) -> dict[str, list[float]]:
    """Numeric series by name, as the loader has them."""
    header, *lines = file.read_text(encoding="utf-8").splitlines()
    delimiter = max(" ,;\t", key=lambda c: (header.count(c), " ,;\t".index(c)))
    names = [name.strip() for name in header.split(delimiter)]
    assert not all(_is_number(name) for name in names)
    assert "" not in names
    twice = [name for name, count in Counter(names).items() if count > 1]
    assert not twice, f"would be renamed: {twice}"
    cells = [line.split(delimiter) for line in lines if line]
    assert {len(row) for row in cells} == {len(names)}, "would be left out"
    series = {}
    for name, column in zip(names, zip(*cells, strict=True), strict=True):
        first = next(cell for cell in column if cell)
        assert _is_number(first), f"{name} would be a column of texts"
        series[name] = [float(cell) for cell in column]
    assert all(b >= a for a, b in zip(series[time_axis], series[time_axis][1:], strict=False))
    return series


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plotjuggler")
    rows, _ = rows_of(shortened(setup(), 300), "fast")
    with RecordingWriter(folder / "recording.parquet", {}) as writer:
        writer.write(rows)
    file = folder / "recording.csv"
    export.as_csv(Recording.open(folder / "recording.parquet"), export.USUAL, file)
    return file


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda path: path.stem)
def test_every_curve_of_a_layout_is_a_column_of_the_export(layout, exported):
    root = ET.parse(layout).getroot()
    assert root.tag == "root"
    main = root.find("tabbed_widget")
    assert main is not None
    assert main.get("name") == "Main Window"
    loaded = root.find("previouslyLoaded_Datafiles/fileInfo")
    assert loaded is not None
    assert loaded.get("filename") == exported.name, "as `pkxyz recording` calls it, beside the layout"
    parameters = loaded.find("plugin[@ID='DataLoad CSV']/parameters")
    assert parameters is not None
    series = series_of(exported, parameters.get("time_axis", ""))
    plots = main.findall("Tab/Container/DockSplitter/DockArea/plot")
    assert len(plots) == len(list(root.iter("plot"))) >= 3
    for splitter in root.iter("DockSplitter"):
        assert int(splitter.get("count", "0")) == len(splitter) == len(splitter.get("sizes", "").split(";"))
    for plot in plots:
        curves = plot.findall("curve")
        assert curves
        for curve in curves:
            wanted = (
                [curve.get("curve_x"), curve.get("curve_y")] if plot.get("mode") == "XYPlot" else [curve.get("name")]
            )
            assert set(wanted) <= series.keys(), (layout.name, wanted)


def test_there_are_layouts():
    assert [path.stem for path in LAYOUTS] == ["scan", "tracking"]

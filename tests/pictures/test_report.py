"""The picture: what it is drawn from equals what was recorded; it is drawn for every kind of ending."""

import struct

import numpy as np
import pytest
from synthetic_rows import START_TICKS, default_scenario, metadata, tracking_rows

from hil.bus.frame_time import frame_duration_ns
from hil.bus.load_trace import read_bus_trace
from hil.lanes.lane import Lane
from hil.pictures import report
from hil.pictures.report import draw_report, read_signals
from hil.recording.recording import Recording, RecordingWriter
from hil.runs.metrics import Metrics, Verdict, bound_words
from hil.runs.summary import LoopFigures, summarise
from pkxyz_ctrl.can.frame import Frame


def recorded(path, rows):
    with RecordingWriter(path, metadata()) as writer:
        writer.write(rows)
    return Recording.open(path)


def summary_of(rows, interrupted=False):
    scenario = default_scenario()
    metrics = Metrics(scenario.trajectory, scenario.bus.period_us)
    metrics.update(rows)
    loop = LoopFigures(missed_ticks=0, bus_load=0.8, realtime_factor=9.0)
    return summarise(scenario, Lane.LOCKSTEP, "0" * 16, metrics.figures(), loop, interrupted=interrupted)


@pytest.mark.parametrize("repeats", [1, 8])
def test_envelopes_reach_every_extreme_and_the_path_is_the_scan(tmp_path, repeats):
    rows = np.concatenate([tracking_rows()] * repeats)
    rows["position_m"][4321, 1] += 0.5e-6
    rows["position_m"][1234, 2] -= 0.5e-6
    signals = read_signals(recorded(tmp_path / "r.parquet", rows))
    assert len(signals.t_s) <= 2500
    assert signals.t_s[-1] < len(rows) * 200e-6
    error_nm = (rows["position_m"] - rows["reference_m"]) * 1e9
    every = -(-len(rows) // len(signals.t_s))
    for n in (0, 7, len(signals.t_s) - 1):
        block = error_nm[n * every : (n + 1) * every]
        assert np.array_equal(signals.low["error_nm"][n], block.min(axis=0))
        assert np.array_equal(signals.high["error_nm"][n], block.max(axis=0))
    assert np.array_equal(signals.low["error_nm"].min(axis=0), error_nm.min(axis=0))
    assert np.array_equal(signals.high["position_m"].max(axis=0), rows["position_m"].max(axis=0))
    t_us = rows["t_us"][: len(rows) // repeats] - START_TICKS * 200
    begin, end = next(s.scan_us for s in default_scenario().trajectory.segments if s.scan_us)
    scan = rows["position_m"][: len(t_us)][(t_us >= begin) & (t_us < end)] * 1e6
    assert np.array_equal(signals.path_um[: len(scan)], scan)


def png_size(path):
    header = path.read_bytes()[:24]
    assert header.startswith(b"\x89PNG")
    return struct.unpack(">II", header[16:24])


@pytest.mark.parametrize(
    "kept",
    [slice(None), slice(3000), slice(START_TICKS - 50), slice(1)],
    ids=["whole", "cut", "never tracked", "one tick"],
)
def test_a_picture_is_drawn_however_the_run_ended(tmp_path, kept):
    rows = tracking_rows()[kept]
    recorded(tmp_path / "r.parquet", rows)
    summary = summary_of(rows, interrupted=kept != slice(None))
    draw_report(tmp_path / "r.parquet", None, summary, tmp_path / "report.png")
    width, height = png_size(tmp_path / "report.png")
    assert width == 1600
    assert 900 <= height <= 1200
    assert summary.ok is (kept == slice(None))


@pytest.mark.parametrize("still", [(), (1,), (0, 1, 2)], ids=["raster", "y stands still", "all stand still"])
def test_no_label_lies_on_the_numbers_of_its_scale(tmp_path, monkeypatch, still):
    rows, drawn = tracking_rows(), []
    for axis in still:
        noise = rows["position_m"][:, axis] - rows["reference_m"][:, axis]
        rows["reference_m"][:, axis] = rows["reference_m"][-1, axis]
        rows["position_m"][:, axis] = rows["reference_m"][:, axis] + noise
    recorded(tmp_path / "r.parquet", rows)
    monkeypatch.setattr(report, "save", lambda figure, path: drawn.append(figure))
    draw_report(tmp_path / "r.parquet", None, summary_of(rows), tmp_path / "report.png")
    drawn[0].canvas.draw()
    labelled = [plot for plot in drawn[0].axes if plot.get_ylabel() and plot.name == "rectilinear"]
    assert len(labelled) == 8
    for plot in labelled:
        low, high = sorted(plot.get_ylim())
        numbers = [t.get_window_extent() for t in plot.get_yticklabels() if low <= t.get_position()[1] <= high]
        label = plot.yaxis.label.get_window_extent()
        assert label.x1 < min(box.x0 for box in numbers), plot.get_ylabel()


def test_bus_load_over_time_is_that_of_the_frames(tmp_path):
    can = {"nominal_bitrate_bit_per_s": 1_000_000, "data_bitrate_bit_per_s": 5_000_000}
    frame = Frame(0x28A, bytes(range(8)), True, True)
    duration_us = frame_duration_ns(frame, 1_000_000, 5_000_000) / 1000
    lines = []
    for n in range(6000):  # first half with a frame every 200 us, second with one every 100 us
        t_us = n * 200 if n < 3000 else 600_000 + (n - 3000) * 100
        lines.append(f"({t_us // 10**6}.{t_us % 10**6:06d}) pkxyz 28A##1{frame.data.hex().upper()}\n")
    sync_us = frame_duration_ns(Frame(0x080, b"\x01", True, True), 1_000_000, 5_000_000) / 1000
    shifted = [line.replace("(0.", "(7.").replace("(1.", "(8.") for line in lines]
    shifted.insert(0, f"({7 + round(sync_us) * 1e-6:.6f}) pkxyz 080##101\n")  # a SYNC that began at 7 s
    lines.insert(100, "(0.019801) pkxyz 20000080#0000000000000000\n")  # an error frame is no frame of the wire's
    (tmp_path / "frames.log").write_text("".join(lines))
    trace = read_bus_trace(tmp_path / "frames.log", can)
    early, late = trace.t_s < 0.59, trace.t_s > 0.61
    assert trace.load[early] == pytest.approx(duration_us / 200, rel=1e-3)
    assert trace.load[late] == pytest.approx(duration_us / 100, rel=1e-3)
    assert early.sum() > 40
    assert late.sum() > 40
    (tmp_path / "late.log").write_text("".join(shifted))
    late_trace = read_bus_trace(tmp_path / "late.log", can)
    assert late_trace.t_s[1:] == pytest.approx(trace.t_s[1:], abs=2e-4)
    (tmp_path / "empty.log").write_text("")
    assert read_bus_trace(tmp_path / "empty.log", can) is None


def test_bounds_in_words():
    assert bound_words(Verdict("ticks", 1.0, None, 5.0, True)) == "≤ 5"
    assert bound_words(Verdict("ticks", 1.0, 0.5, None, True)) == "≥ 0.5"
    assert bound_words(Verdict("ticks", 1.0, 0.5, 2.0, True)) == "0.5 to 2"

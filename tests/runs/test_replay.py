"""Replay: every input of a tick is in its row, so the same bits come out; and whatever was altered is named."""

import contextlib
import dataclasses
import json
import os
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import pkxyz
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from loop_rig import Cycle, counts_at
from typer.testing import CliRunner

from hil.cli import app
from hil.lanes.lane import Lane
from hil.recording.recording import Recording, RecordingError, RecordingWriter, journal_of
from hil.runs.replay import replay
from hil.runs.run import run_into
from hil.runs.run_folder import RunFolder, metadata_of
from hil.runs.scenario import load_scenario, resolve, restore
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, load, names
from pkxyz_ctrl.loop.row import CONTROLLER_FIELDS, ROW, columns
from pkxyz_ctrl.safety.modes import Event, Mode

INPUTS = {"request", "sense_status", "node_events", "overrun", "outside_trips", "sense_count"}
CASES = [
    ("raster", "lockstep", {"plant": "harsh"}),
    ("raster", "fast", {"plant": "mild", "bus": "classic_2k"}),
    ("raster", "fast", {"bus": "local_20k"}),
    ("raster", "fast", {"controller": "open_loop"}),
    ("path", "lockstep", {}),
]


def scenario_of(name, duration_s=0.5, **changes):
    loaded = load_scenario(name, **changes)
    return dataclasses.replace(loaded, config=loaded.config.model_copy(update={"duration_s": duration_s}))


def rows_of(path):
    recording = Recording.open(path)
    rows = np.zeros(recording.ticks, ROW)
    for name in ROW.names:
        rows[name] = recording.vector(name)
    return rows, recording.metadata


def written(folder, rows, metadata):
    folder.mkdir(exist_ok=True)
    with RecordingWriter(folder / "recording.parquet", metadata) as writer:
        writer.write(rows)
    return folder / "recording.parquet"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of 0.5 s of the default scenario under lqg in the fast lane, its rows and metadata."""
    folder = RunFolder(tmp_path_factory.mktemp("replay") / "run")
    run_into(folder, scenario_of("raster", controller="lqg"), Lane.FAST)
    return folder.path, *rows_of(folder.recording)


@pytest.mark.parametrize(("name", "lane", "changes"), CASES)
def test_a_run_of_either_lane_replays_bit_for_bit(tmp_path, name, lane, changes):
    scenario = scenario_of(name, **changes)
    folder = RunFolder(tmp_path / "run")
    run_into(folder, scenario, Lane(lane))
    result = replay(folder.recording)
    assert result.differences == []
    assert result.notes == []
    assert result.ticks == round(0.5e6 / scenario.bus.period_us)
    assert (Recording.open(folder.recording)["mode"] == Mode.TRACKING).mean() > 0.8


@pytest.mark.parametrize("name", names("scenarios"))
def test_a_scenario_comes_back_from_what_it_was_resolved_to(tmp_path, name):
    scenario = load_scenario(name)
    folder = RunFolder(tmp_path / "run")
    resolved = folder.write_config(scenario)
    back = restore(json.loads(json.dumps(resolved)), folder.path)
    assert resolve(back) == resolved
    assert back.device == scenario.device
    first, second = (s.trajectory.sample(0, 3000, 333) for s in (scenario, back))
    assert first.tobytes() == second.tobytes()


TROUBLE = st.fixed_dictionaries(
    {"tick": st.integers(0, 400)},
    optional={
        "status": st.integers(0, 31),
        "event": st.sampled_from([int(e) for e in Event]),
        "trips": st.sampled_from([0, 1 << 22, 1 << 23]),
        "node_events": st.sampled_from([0, 0, 0, 1, 8, 16]),
        "overrun": st.integers(0, 12),
        "jump_m": st.floats(-3e-6, 3e-6),
    },
)


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(TROUBLE, max_size=8), st.integers(0, 2**32 - 1))
def test_whatever_happened_to_the_controller_is_in_the_recording(tmp_path, troubles, seed):
    """Requests in any mode, trips from outside, lost ticks, bad frames: the rows of a cycle fed by hand replay."""
    scenario = scenario_of("raster")
    cycle = Cycle(scenario.setup().law, scenario.trajectory.sample(0, 1000, scenario.bus.period_us))
    noise = np.random.default_rng(seed).normal(scale=2e-9, size=(420, 3))
    at = {trouble["tick"]: trouble for trouble in troubles}
    rows = np.zeros(420, ROW)
    for tick in range(420):
        trouble = dict(at.get(tick, {}))
        trouble.pop("tick", None)
        stroke_m = noise[tick] + trouble.pop("jump_m", 0.0)
        rows[tick] = cycle.tick(counts_at(stroke_m), **trouble)
    resolved = resolve(scenario)
    result = replay(written(tmp_path / "by_hand", rows, metadata_of(scenario, Lane.FAST, resolved)))
    assert result.differences == []
    assert result.ticks == 420


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_one_altered_bit_of_an_output_is_named_by_tick_and_signal(run, tmp_path, data):
    _, rows, metadata = run
    name = data.draw(st.sampled_from([n for n, *_ in CONTROLLER_FIELDS if n not in INPUTS | {"tick"}]))
    tick = data.draw(st.integers(0, len(rows) - 1))
    altered = rows.copy()
    values = altered[name].reshape(len(rows), -1)
    which = data.draw(st.integers(0, values.shape[1] - 1))
    bytes_ = values[tick, which : which + 1].copy()
    bytes_.view(np.uint8)[data.draw(st.integers(0, bytes_.itemsize - 1))] ^= 1 << data.draw(st.integers(0, 7))
    values[tick, which] = bytes_[0]
    altered[name] = values.reshape(altered[name].shape)
    result = replay(written(tmp_path / "altered", altered, metadata))
    assert [(d.signal, d.tick, d.ticks) for d in result.differences] == [(columns(name)[which], tick, 1)]
    assert result.differences[0].t_us == tick * 200


def test_one_altered_input_is_named_by_what_it_leads_to(run, tmp_path):
    _, rows, metadata = run
    altered = rows.copy()
    altered["sense_count"][1200, 1] += 1
    first = replay(written(tmp_path / "altered", altered, metadata)).differences[0]
    assert (first.tick, first.signal) == (1200, "sense_2_f")
    assert first.replayed - first.recorded == pytest.approx(68e-18, rel=1e-6)


def test_one_altered_gain_is_named_by_the_first_signal_that_it_moves(run, tmp_path):
    """The regulator's: the estimate agrees until the first force that it shapes, in the first tick with one."""
    folder, rows, metadata = run
    altered = json.loads(json.dumps(metadata))
    altered["config"]["controller"]["regulator"]["position_error_m"] *= 1 + 1e-9
    result = replay(written(tmp_path / "altered", rows, altered))
    first = result.differences[0]
    assert first.signal.startswith("demand_")
    assert rows["mode"][first.tick] in (Mode.ENABLED, Mode.TRACKING)
    assert abs(first.replayed - first.recorded) < 1e-6 * abs(first.recorded)
    assert result.notes[0] == "the configuration is not the recorded one"
    assert not any(d.tick < first.tick for d in result.differences)
    other = replay(folder / "recording.parquet", load("controllers", "open_loop", ControllerConfig))
    assert other.differences[0].signal.startswith("estimate_")  # its filter has another stiffness


def test_a_recording_that_was_cut_off_replays_as_far_as_it_goes(run, tmp_path):
    _, rows, metadata = run
    writer = RecordingWriter(tmp_path / "recording.parquet", metadata)
    for piece in (rows[:2000], rows[2000:]):  # a batch is full in the second, and handed on
        writer.write(piece)
    assert journal_of(tmp_path / "recording.parquet").is_file()  # never closed, as if killed
    result = replay(tmp_path / "recording.parquet")
    assert result.identical
    assert result.ticks == 2048
    assert not result.sound
    assert result.damages == ["the recording was cut off: nobody closed it after its 2048 ticks"]


def test_rows_that_are_missing_are_no_difference_but_an_error(run, tmp_path):
    _, rows, metadata = run
    with pytest.raises(RecordingError, match="row 700 is of tick 701: rows are missing"):
        replay(written(tmp_path / "gap", np.delete(rows, 700), metadata))


def test_a_table_is_kept_with_the_run_and_may_not_change(tmp_path):
    folder = RunFolder(tmp_path / "run")
    run_into(folder, scenario_of("path"), Lane.FAST)
    (table,) = folder.path.glob("reference.*.csv")
    run_into(RunFolder(folder.path, replace=True), scenario_of("path"), Lane.FAST)
    text = table.read_text(encoding="utf-8").rstrip()
    table.write_text(text + "0\n", encoding="utf-8")
    with pytest.raises(ValueError, match="its table is not the one of the run"):
        replay(folder.recording)


@pytest.fixture(scope="module")
def folder_of_a_run(tmp_path_factory):
    """A short run over the bus, with a table: everything that a folder holds."""
    folder = RunFolder(tmp_path_factory.mktemp("sealed") / "run")
    run_into(folder, scenario_of("path", 0.1), Lane.LOCKSTEP)
    return folder.path


def test_a_run_that_nobody_touched_is_sound_and_names_what_it_checked(folder_of_a_run):
    result = replay(folder_of_a_run / "recording.parquet")
    assert result.sound
    assert result.notes == []
    assert {"recording.parquet", "frames.log", "config.toml"} < set(result.kept)
    assert set(result.kept) | {"summary.json"} == {path.name for path in folder_of_a_run.iterdir()}


@pytest.mark.parametrize("name", ["recording.parquet", "frames.log", "config.toml", "summary.json", "reference.4.csv"])
def test_no_flipped_bit_in_any_file_of_a_run_is_taken_for_sound(folder_of_a_run, tmp_path, name):
    """Truth, footer, checksums and digits alike: it is named or can't be read; no traceback, and no "identical"."""
    rng = np.random.default_rng(7)
    folder = tmp_path / "copy"
    shutil.copytree(folder_of_a_run, folder)
    whole = (folder / name).read_bytes()
    outcomes = []
    for at in rng.integers(0, len(whole), 25):
        bent = bytearray(whole)
        bent[at] ^= 1 << int(rng.integers(8))
        (folder / name).write_bytes(bent)
        try:
            result = replay(folder / "recording.parquet")
        except (RecordingError, ConfigError, OSError):
            outcomes.append(2)
            continue
        assert not result.sound, at
        assert any(name in line for line in result.damages)
        outcomes.append(1)
    assert 1 in outcomes or name == "reference.4.csv"  # of a table, not even the reference can be planned


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.999])
@pytest.mark.parametrize("name", ["recording.parquet", "frames.log", "config.toml", "summary.json", "reference.4.csv"])
def test_no_file_of_a_run_can_be_cut_unseen(folder_of_a_run, tmp_path, name, share):
    folder = tmp_path / "copy"
    shutil.copytree(folder_of_a_run, folder)
    os.truncate(folder / name, int((folder / name).stat().st_size * share))
    with contextlib.suppress(RecordingError, ConfigError, OSError):
        assert not replay(folder / "recording.parquet").sound
    (folder / name).unlink()
    try:
        result = replay(folder / "recording.parquet")
    except (RecordingError, ConfigError):
        return
    assert not result.sound or (name == "summary.json" and "no digests to check" in result.notes[0])


def test_a_tail_that_is_missing_is_no_whole_recording(folder_of_a_run, tmp_path):
    """Cut by 30 per cent at a row, in sound Parquet: once that was "identical"."""
    rows, metadata = rows_of(folder_of_a_run / "recording.parquet")
    path = written(tmp_path / "sealed_anew", rows[:350], metadata)
    for name in ("reference.4.csv", "summary.json", "config.toml", "adapted.json"):
        shutil.copy(folder_of_a_run / name, path.parent)
    result = replay(path)
    assert result.identical
    assert result.damages == ["frames.log is missing", "recording.parquet is not as the run left it"]
    table = pq.read_table(folder_of_a_run / "recording.parquet")
    (path.parent / "summary.json").unlink()
    pq.write_table(table[:350], path)
    result = replay(path)
    assert result.ticks == 350
    assert result.damages == ["the recording was cut off: nobody closed it after its 350 ticks"]


def test_no_tick_is_nothing_to_be_identical(run, tmp_path):
    _, rows, metadata = run
    with pytest.raises(RecordingError, match="holds no tick"):
        replay(written(tmp_path / "empty", rows[:0], metadata))
    done = pkxyz("replay", tmp_path / "empty", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")


@pytest.mark.parametrize("column", ["voltage_1_v", "voltage_2_v", "voltage_3_v", "drive_2_count", "force_3_n"])
@pytest.mark.parametrize("tick", [0, 1234, 2499])
def test_not_one_bit_of_a_voltage_goes_unseen(run, tmp_path, column, tick):
    """What went to the combs is what a replay is for: its lowest bit, in the first, some and the last tick."""
    _, rows, metadata = run
    name = next(name for name in ROW.names if column in columns(name))
    altered = rows.copy()
    values = altered[name][:, columns(name).index(column)].copy()
    values.view(f"u{values.dtype.itemsize}")[tick] ^= 1
    altered[name][:, columns(name).index(column)] = values
    result = replay(written(tmp_path / "altered", altered, metadata))
    assert [(d.signal, d.tick, d.ticks) for d in result.differences] == [(column, tick, 1)]
    assert not result.sound


def test_the_command(run, tmp_path):
    folder, rows, metadata = run
    call = CliRunner().invoke
    same = call(app, ["replay", str(folder)])
    assert same.exit_code == 0
    assert same.stdout.splitlines() == [
        "2500 ticks replayed, identical in every bit", "as the run left them: config.toml, recording.parquet"
    ]  # fmt: skip
    altered = rows.copy()
    altered["voltage_v"][2000, 2] += 1e-9
    changed = written(tmp_path / "altered", altered, metadata).parent
    told = call(app, ["replay", str(changed), "--json"])
    assert told.exit_code == 1
    first = json.loads(told.stdout)["first_difference"]
    assert (first["signal"], first["tick"], first["ticks"]) == ("voltage_3_v", 2000, 1)
    shown = call(app, ["replay", str(changed)])
    assert shown.exit_code == 1
    assert shown.stdout.startswith("first difference: tick 2000, at 0.400000 s, voltage_3_v: recorded ")
    missing = pkxyz("replay", "nowhere", cwd=tmp_path)
    assert missing.returncode == 2
    assert missing.stderr == "pkxyz: nowhere/recording.parquet: no such recording\n"

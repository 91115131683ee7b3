"""Recordings that the page opens: which there are, their rows and their events."""

import json

import numpy as np
import pytest
from operated_rig import Script
from test_desk import DeskRig, switched_on

from hil.recording.recording import RecordingWriter
from hil.runs.run_folder import RECORDING
from hil.server.opening import ROWS_MOST, listed, opened
from pkxyz_ctrl.client.protocol import unpacked
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode


@pytest.fixture
def rig(tmp_path, monkeypatch):
    return DeskRig(tmp_path, monkeypatch)


def recorded(folder, ticks, *, period_us=200, overrun=None, first=0, fault_at=None):
    """A recording of a stage that tracks, in FAULT from ``fault_at`` on; ``overrun``: ticks missed before a tick."""
    rows = np.zeros(ticks, ROW)
    rows["tick"] = first + np.arange(ticks)
    rows["t_us"] = rows["tick"] * period_us
    rows["mode"] = Mode.TRACKING
    if fault_at is not None:
        rows["mode"][fault_at:] = Mode.FAULT
    rows["estimate_m"] = rows["tick"][:, None] * 1e-9
    for tick, missed in (overrun or {}).items():
        rows["overrun"][tick - first] = missed
    folder.mkdir(parents=True)
    with RecordingWriter(folder / RECORDING, {"kind": "saved"}) as writer:
        writer.write(rows)
    return rows


def missed(about):
    return [(event["tick"], event["words"]) for event in about["events"] if event["kind"] == "missed"]


def test_a_burst_of_missed_ticks_is_one_event_and_what_lies_apart_is_another(tmp_path):
    """Within a tenth of a second, 500 ticks here: one; each says how many, from where to where."""
    burst = {1000 + 2 * n: 1 for n in range(40)} | {1500: 3}
    recorded(tmp_path / "run", 6000, overrun=burst | {2001: 2, 4000: 7})
    about, _ = opened(tmp_path, "run", ())
    assert missed(about) == [(1000, "43 missed, tick 1000 to 1500"), (2001, "2 missed"), (4000, "7 missed")]


@pytest.mark.parametrize(("apart", "events"), [(500, 1), (501, 2)])
def test_a_burst_ends_where_nothing_was_missed_for_a_tenth_of_a_second(tmp_path, apart, events):
    recorded(tmp_path / "run", 3000, overrun={100: 1, 100 + apart: 1})
    assert len(missed(opened(tmp_path, "run", ())[0])) == events


def test_what_is_missed_in_a_fault_is_no_event_but_what_led_to_it_is(tmp_path):
    """Two hundred events that said nothing, of a loop in which nobody waited for a tick."""
    recorded(tmp_path / "run", 6000, overrun={999: 9, **dict.fromkeys(range(1001, 6000, 2), 1)}, fault_at=1000)
    assert missed(opened(tmp_path, "run", ())[0]) == [(999, "9 missed")]
    recorded(tmp_path / "again", 2000, overrun={1000: 12, 1700: 1}, fault_at=1000)
    assert missed(opened(tmp_path, "again", ())[0]) == [(1000, "12 missed")]


def test_a_slower_loop_has_fewer_ticks_in_a_burst(tmp_path):
    recorded(tmp_path / "run", 3000, period_us=500, overrun={100: 1, 300: 1, 501: 1})
    assert missed(opened(tmp_path, "run", ())[0]) == [(100, "2 missed, tick 100 to 300"), (501, "1 missed")]


def test_no_missed_tick_is_no_event_and_one_row_is_a_recording(tmp_path):
    recorded(tmp_path / "run", 1, first=7)
    about, block = opened(tmp_path, "run", ("estimate_m",))
    assert (about["ticks"], about["period_us"], missed(about)) == (1, 0, [])
    assert (block.first_tick, len(block)) == (7, 1)


def test_of_a_long_one_the_end_is_shown(tmp_path):
    rows = recorded(tmp_path / "run", ROWS_MOST + 500)
    about, block = opened(tmp_path, "run", ("estimate_m", "nothing"))
    assert about["left_out"] == 500
    assert block.first_tick == 500
    assert np.array_equal(block["estimate_m"], rows["estimate_m"][500:])
    assert list(block.columns) == ["estimate_m"]


def test_a_client_opens_what_was_kept_of_a_fault_and_sees_it_with_its_events(rig, tmp_path):
    """Through the desk, as the page does: list, open, the rows of what it shows."""
    client = rig.desk.enter()
    rig.desk._saves = tmp_path / "runs"

    def script() -> Script:
        yield from switched_on(rig, client)
        yield from rig.finish(client, do="release")
        yield from rig.wait_s(0.01)
        rig.ask(client, do="save", seconds=1.0)

    rows = rig.play(script())
    rig.heard(client)
    rig.ask(client, do="recordings")
    (kept,) = rig.heard(client)["recordings"]
    names = kept["names"]
    assert (kept["folder"], names) == (str(tmp_path / "runs"), listed(tmp_path / "runs"))
    rig.ask(client, do="subscribe", fields=["estimate_m"])
    rig.ask(client, do="open_recording", name=names[0], tag=3)
    heard = rig.heard(client)
    (about,), (data,) = heard["recording"], heard["bytes"]
    assert heard["answer"][-1]["state"] == "done"
    block = unpacked(data)
    of = rows[(rows["tick"] >= block.first_tick) & (rows["tick"] < block.first_tick + len(block))]
    assert about["ticks"] == len(block) == len(of)
    assert np.array_equal(block["estimate_m"], of["estimate_m"].astype("<f4"))
    fault = next(event for event in about["events"] if event["kind"] == "fault")
    assert of["trips"][fault["tick"] - block.first_tick] != 0
    assert of["trips"][fault["tick"] - block.first_tick - 1] == 0
    assert "FAULT" in about["modes"]


@pytest.mark.parametrize("name", ["none", "../runs", "", 3, None, ["run"]])
def test_what_is_not_in_the_list_is_refused(rig, tmp_path, name):
    client = rig.desk.enter()
    rig.desk._saves = tmp_path / "runs"
    recorded(tmp_path / "runs" / "run", 10)
    rig.heard(client)
    rig.ask(client, do="open_recording", name=name)
    (answer,) = rig.heard(client)["answer"]
    assert answer["state"] == "refused"
    assert f"no recording is called {name!r}" in answer["words"]


def test_a_file_that_is_no_recording_is_refused_with_its_reason(rig, tmp_path):
    client = rig.desk.enter()
    rig.desk._saves = tmp_path / "runs"
    (tmp_path / "runs" / "run").mkdir(parents=True)
    (tmp_path / "runs" / "run" / RECORDING).write_text(json.dumps({}))
    rig.ask(client, do="open_recording", name="run")
    assert [a["state"] for a in rig.heard(client)["answer"]] == ["refused"]

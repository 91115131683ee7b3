"""What people set: in the sample's coordinates at once and everywhere, kept with who and when, and with a way back."""

import numpy as np
import pytest
from operated_rig import MIDDLE_M, Script
from test_desk import DeskRig, switched_on

from hil.operate.sample_axes import SampleAxes, Turn
from hil.server.setting import Setting
from hil.server.stored_settings import SettingsStore, StageSettings
from pkxyz_ctrl.client.protocol import unpacked
from pkxyz_ctrl.client.settings import StageSettings as Told
from pkxyz_ctrl.config.files import ConfigError

SAMPLE = {"origin_m": [0.5e-6, -0.3e-6, 18e-6], "rotation_deg": 90.0, "slope_x": 0.02, "slope_y": -0.01}


@pytest.fixture
def rig(tmp_path, monkeypatch):
    rig = DeskRig(tmp_path, monkeypatch)
    desk = rig.desk
    store = SettingsStore(tmp_path / "kept" / "stage.settings.jsonl")
    desk._setting = Setting(desk.link, desk._planner, store, desk._settings_changed)
    return rig


def test_the_samples_axes_change_what_everybody_sees_and_moves_nothing(rig):
    client, looker = rig.desk.enter(), rig.desk.enter()
    turn = Turn(SampleAxes(**{k: tuple(v) if isinstance(v, list) else v for k, v in SAMPLE.items()}).matrix())

    def script() -> Script:
        yield from switched_on(rig, client)
        answer = yield from rig.finish(looker, do="sample", rotation_deg=5.0)
        assert answer["state"] == "refused", "read-only without control"
        answer = yield from rig.finish(client, do="sample", who="Ann", **SAMPLE)
        assert (answer["state"], answer["verb"]) == ("done", "sample")
        assert np.allclose(rig.session.stage.setpoints.target_m, MIDDLE_M, atol=1e-18)
        yield from rig.wait_s(0.002)
        rig.desk.tell_status()
        heard = rig.heard(looker)
        assert np.allclose(heard["status"][-1]["target_m"], turn.to_sample(np.array(MIDDLE_M)), atol=1e-15)
        assert heard["status"][-1]["in_sample_axes"]
        assert heard["settings"][-1]["history"][0]["who"] == "Ann"
        answer = yield from rig.finish(client, do="move", x_m=1e-6, y_m=0.0, z_m=0.0)
        assert answer["words"].startswith("in position at (1, 0, 0) um"), answer
        assert np.allclose(rig.rows[-1]["position_m"], turn.to_stage(np.array([1e-6, 0, 0])), atol=10e-9)
        rig.ask(looker, do="subscribe", fields=["reference_m", "estimate_m", "estimate_m_per_s"], precision="f8")
        rig.heard(looker)
        yield from rig.wait_s(0.01)
        rig.desk.show_telemetry(1000)
        block = unpacked(rig.heard(looker)["bytes"][-1])
        assert np.allclose(block["reference_m"][-1], [1e-6, 0, 0], atol=1e-15)
        assert np.allclose(block["estimate_m"][-1], [1e-6, 0, 0], atol=10e-9)
        scan = {"kind": "raster", "line_length_m": 2e-6, "lines": 4, "line_pitch_m": 0.2e-6, "line_rate_hz": 60.0}
        scan |= {"velocity_max_m_per_s": 0.5e-3, "acceleration_max_m_per_s2": 0.5, "jerk_max_m_per_s3": 300.0}
        rig.ask(client, do="preview", segments=[scan], tag="p")
        shown = rig.heard(client)["preview"][-1]
        points = np.array(shown["points_m"])
        assert np.ptp(points[:, 1]) == pytest.approx(0.6e-6, rel=1e-3)
        assert np.abs(points[:, 2]).max() < 1e-11, "in the plane of the sample"
        begun = len(rig.rows)
        assert (yield from rig.finish(client, do="path", segments=[scan]))["state"] == "done"
        reference = np.array([row["reference_m"] for row in rig.rows[begun:]])
        assert np.abs(turn.to_sample(reference)[:, 2]).max() < 1e-11
        assert np.ptp(reference[:, 1]) > 2e-6, "lines along the sample's x go along the stage's y"

    rig.play(script())


def test_positions_planes_and_windows_are_kept_with_a_way_back(rig, tmp_path):
    client = rig.desk.enter()
    file = tmp_path / "kept" / "stage.settings.jsonl"

    def script() -> Script:
        yield from switched_on(rig, client)
        fresh = Told.of(rig.heard(client).get("settings", [rig.desk._setting.told()])[-1])
        answer = yield from rig.finish(client, do="name_position", name="corner", x_m=2e-6, y_m=1e-6, who="Ann")
        assert answer["words"] == "corner is (2, 1, 18) um"
        assert (yield from rig.finish(client, do="move", to="corner"))["words"].startswith("in position at (2, 1, 18)")
        answer = yield from rig.finish(client, do="move", to="nowhere")
        assert answer["words"] == "no position is called 'nowhere'; there are: corner"
        answer = yield from rig.finish(client, do="settle", window_m=30e-9, dwell_s=1e-3)
        assert answer["state"] == "done"
        assert rig.session.settings.window_m == 30e-9
        answer = yield from rig.finish(client, do="settle", window_m=1.0, dwell_s=1e-3)
        assert "window_m" in answer["words"]
        assert answer["state"] == "refused"
        points = [[0, 0, 18e-6], [2e-6, 0, 18.1e-6], [0, 2e-6, 17.9e-6]]
        answer = yield from rig.finish(client, do="tilt_plane", points_m=points, who="Bob")
        assert answer["state"] == "done"
        now = Told.of(rig.desk._setting.told())
        assert (now.sample.slope_x, now.sample.slope_y) == (pytest.approx(0.05), pytest.approx(-0.05))
        assert now.sample.origin_m[2] == pytest.approx(18e-6)
        assert [change.who for change in now.history] == ["Bob", "somebody", "Ann", ""]
        assert len({change.digest for change in now.history}) == 4
        again = SettingsStore(file)
        assert again.now.digest == now.digest
        assert again.now.positions == {"corner": (2e-6, 1e-6, 18e-6)}
        rig.desk._setting.joined()  # a new loop is told what is kept
        yield from rig.wait_s(0.005)
        assert np.allclose(rig.session.state["matrix"][0], again.now.sample.matrix())
        answer = yield from rig.finish(client, do="restore", digest=fresh.digest[:6])
        assert answer["state"] == "done"
        assert SettingsStore(file).now == StageSettings()
        assert rig.session.settings.window_m == 20e-9
        assert rig.session.stage.reach.turn.is_plain
        answer = yield from rig.finish(client, do="restore", digest="nothing")
        assert "names 0 settings; there are" in answer["words"]

    rig.play(script())


def test_a_file_that_was_changed_by_hand_is_told_with_its_line(tmp_path):
    file = tmp_path / "s.jsonl"
    store = SettingsStore(file)
    store.set("Ann", "window", StageSettings().model_copy(update={"positions": {"a": (0.0, 0.0, 1e-6)}}))
    store.set("Ann", "again", StageSettings().model_copy(update={"positions": {"b": (0.0, 0.0, 1e-6)}}))
    whole = file.read_text()
    assert len(SettingsStore(file).changes) == 2
    file.write_text(whole.replace('"b"', '"c"'))
    with pytest.raises(ConfigError, match=r"line 2: is not what was written .* delete what follows line 1"):
        SettingsStore(file)
    file.write_text(whole[:-20])
    with pytest.raises(ConfigError, match="line 2"):
        SettingsStore(file)


def test_what_cannot_be_kept_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    store = SettingsStore(tmp_path / "s.jsonl")
    store._file = tmp_path / "file" / "s.jsonl"
    with pytest.raises(ConfigError, match="nothing was changed"):
        store.set("Ann", "x", StageSettings().model_copy(update={"positions": {"a": (0.0, 0.0, 1e-6)}}))
    assert store.now == StageSettings()


def test_a_law_is_changed_by_its_name_or_text(rig):
    client = rig.desk.enter()

    def script() -> Script:
        yield from switched_on(rig, client)
        answer = yield from rig.finish(client, do="law", controller="lqg")
        assert answer["words"] == "the law is lqg"
        rig.desk.tell_status()
        assert rig.heard(client)["status"][-1]["law"] == "lqg"
        for wrong, words in (({"controller": "../x"}, "shipped controller"), ({"toml": "a ="}, "not valid TOML")):
            answer = yield from rig.finish(client, do="law", **wrong)
            assert answer["state"] == "refused"
            assert words in answer["words"]
        assert (yield from rig.finish(client, do="quiet", on=True))["state"] == "done"

    rig.play(script())

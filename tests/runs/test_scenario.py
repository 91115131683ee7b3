"""Scenario files: what they resolve to, and the one line that each mistake gets."""

import re

import pytest
from synthetic_rows import default_scenario

from hil.runs.scenario import load_scenario, resolve
from pkxyz_ctrl.config.files import CONFIG_DIR, ConfigError, digest

DEFAULT = (CONFIG_DIR / "scenarios" / "raster.toml").read_text(encoding="utf-8")


def written(folder, *changes):
    """Path of the default scenario with some text replaced."""
    text = DEFAULT
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "changed.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_default_scenario_is_a_second_of_scanning_in_the_middle_of_the_workspace():
    scenario = default_scenario()
    assert (scenario.stage.name, scenario.bus.name) == ("reconstructed", "fd_5k")
    assert 0.9 <= scenario.config.duration_s <= 1.2
    (scan,) = [s for s in scenario.trajectory.segments if s.scan_us]
    assert scan.scan_us[1] - scan.scan_us[0] > 0.6e6
    start_up_s = scenario.controller.homing_s + 0.05
    assert scenario.trajectory.duration_us * 1e-6 + start_up_s < scenario.config.duration_s
    bounds = {name: (b.min, b.max) for name, b in scenario.config.checks.items()}
    assert bounds == {
        "rms_error_nm": (None, 5.0), "hold_noise_nm": (None, 2.0), "saturated_ticks": (None, 0.0),
        "missed_ticks": (None, 0.0), "faults": (None, 0.0), "bus_load": (None, 0.85),
    }  # fmt: skip


def test_resolved_holds_every_file_and_its_digest_names_the_content():
    resolved = resolve(default_scenario())
    assert resolved["stage"]["geometry"]["crank_length_m"] == 500e-6
    assert resolved["bus"]["period_us"] == 200
    assert resolved["controller"]["law"] == "youla"
    assert resolved["plant"]["name"] == "nominal"
    content = {key: value for key, value in resolved.items() if key != "digest"}
    assert resolved["digest"] == digest(content)
    assert resolve(load_scenario("raster"))["digest"] == resolved["digest"]
    others = [
        resolve(load_scenario("raster", **change))["digest"]
        for change in ({"seed": 2}, {"stage": "printed"}, {"plant": "mild"}, {"bus": "classic_2k"})
    ]
    assert len({resolved["digest"], *others}) == 5


def test_paths_are_taken_from_the_scenarios_folder_and_overrides_from_the_working_folder(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    stage = (CONFIG_DIR / "stages" / "reconstructed.toml").read_text(encoding="utf-8")
    for folder, name in (("here", "mine"), ("there", "other")):
        renamed = stage.replace('name = "reconstructed"', f'name = "{name}"')
        (tmp_path / folder / "stage.toml").write_text(renamed, encoding="utf-8")
    path = written(tmp_path / "there", ('stage = "reconstructed"', 'stage = "stage.toml"'))
    monkeypatch.chdir(tmp_path / "here")
    assert load_scenario(path).stage.name == "other"
    assert load_scenario(path, stage="stage.toml").stage.name == "mine"
    assert load_scenario(path, stage="printed").stage.name == "printed"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("lines = 10", "linse = 10", r"reference\.3\.raster\.linse: unknown key"),
        ("lines = 10", "lines = 0", r"reference\.3\.raster\.lines: .*greater than or equal to 1 \(got 0\)"),
        ("lines = 10", "lines = 10.5", r"reference\.3\.raster\.lines: .*integer"),
        ("to_m = [0.0, 0.0, 19.2495e-6]", "to_m = [0.0, 19.2495e-6]", r"reference\.1\.move\.to_m"),
        ('kind = "raster"', 'kind = "rastr"', r"reference\.3: .*'rastr'.*'hold', 'move', 'raster'"),
        ("rms_error_nm =", "rms_eror_nm =", r"checks: no metric .*'rms_eror_nm'; did you mean 'rms_error_nm'\?"),
        ("{ max = 5.0 }", "{}", r"checks\.rms_error_nm: give max, min or both"),
        ("{ max = 5.0 }", "{ min = 6.0, max = 5.0 }", r"min 6 is above max 5"),
        ("seed = 1", "seed = -1", r"seed: .*\(got -1\)"),
        ("seed = 1", "seed = 1.5", r"seed: .*integer"),
        ("duration_s = 1.1", "duration_ms = 1100.0", r"duration_ms: unknown key; .*'duration_s', in seconds"),
        ("duration_s = 1.1", "duration_s = nan", r"duration_s: .*finite"),
        ("duration_s = 1.1", "duration_s = 0.5", r"duration_s: 0\.5 s are over before the reference.*0\.95"),
        ("duration_s = 0.1\n", "duration_s = 1e4\n", r"are over before the reference, which alone takes 1e\+04 s"),
        ("duration_s = 0.1\n", "duration_s = 1e18\n", "must be between 1e-12 and 1e\\+12"),
        ("line_rate_hz = 60.0", "line_rate_hz = 600.0", r"reference\.3 \(raster\): 600 lines/s is beyond the 85"),
        ("19.2495e-6", "49e-6", r"reference\.1 \(move .*at its target .*stroke 1 would be 3\d\.\d+ um"),
        ("max = 0.85 }", "max = 0.85", r"not valid TOML.*line"),
    ],
)  # fmt: skip
def test_each_mistake_gets_a_line_that_names_file_and_key(tmp_path, old, new, message):
    path = written(tmp_path, (old, new))
    with pytest.raises(ConfigError, match=message) as refused:
        load_scenario(path)
    lines = str(refused.value).splitlines()
    assert all(line.startswith(f"{path}: ") for line in lines)
    assert re.search(message, str(refused.value))


@pytest.mark.parametrize("key", ["stage", "plant", "controller", "bus"])
def test_an_unknown_name_or_path_is_refused_with_what_is_known(key):
    folder = {"stage": "stages", "plant": "plants", "controller": "controllers", "bus": "buses"}[key]
    with pytest.raises(ConfigError, match=f"{folder}: no configuration named 'nope'.*known: "):
        load_scenario("raster", **{key: "nope"})
    with pytest.raises(ConfigError, match=r"nope\.toml: no such file"):
        load_scenario("raster", **{key: "nope.toml"})


def test_mistakes_in_several_files_are_all_told(tmp_path):
    for name in ("stage", "bus"):
        (tmp_path / f"{name}.toml").write_text("nonsense = 1\n", encoding="utf-8")
    path = written(
        tmp_path, ('stage = "reconstructed"', 'stage = "stage.toml"'), ('bus = "fd_5k"', 'bus = "bus.toml"')
    )  # fmt: skip
    with pytest.raises(ConfigError) as refused:
        load_scenario(path)
    text = str(refused.value)
    assert "stage.toml: nonsense: unknown key" in text
    assert "bus.toml: nonsense: unknown key" in text
    assert len(text.splitlines()) == len(set(text.splitlines()))

"""Configuration files: every kind of mistake gets a line with file, key and remedy; what is right survives the disk."""

import math

import numpy as np
import pytest
import tomlkit
from hypothesis import given, settings
from hypothesis import strategies as st

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import (
    ConfigError,
    digest,
    find,
    load,
    names,
    parse,
    plain,
    read_toml,
    require_finite,
    write_toml,
)
from pkxyz_ctrl.config.stage import StageConfig

MODELS = {"stages": StageConfig, "controllers": ControllerConfig, "buses": BusConfig}
SHIPPED = [(kind, name) for kind in MODELS for name in names(kind)]


def error_of(kind, data):
    with pytest.raises(ConfigError) as caught:
        parse(data, MODELS[kind], "a.toml")
    return str(caught.value)


def changed(kind, name, key, value):
    """Plain data of a shipped file with one nested key set, or removed if the value is None."""
    data = read_toml(find(kind, name))
    *way, last = key.split(".")
    place = data
    for part in way:
        place = place[part]
    if value is None:
        del place[last]
    else:
        place[last] = value
    return data


def test_the_shipped_files_are_found():
    assert {("stages", "reconstructed"), ("stages", "printed"), ("controllers", "lqg"), ("buses", "fd_5k")} <= set(
        SHIPPED
    )


@pytest.mark.parametrize(("kind", "name"), SHIPPED)
def test_shipped_files_survive_being_written(kind, name, tmp_path):
    model = load(kind, name, MODELS[kind])
    assert model.name == name
    write_toml(plain(model), tmp_path / "again.toml")
    again = load(kind, tmp_path / "again.toml", MODELS[kind])
    assert again == model
    assert digest(plain(again)) == digest(plain(model))


MISTAKES = [
    # another unit of the same quantity, a typo, nothing alike
    (
        "stages",
        "geometry.crank_length_um",
        500.0,
        "geometry.crank_length_um: unknown key; this quantity is given as 'crank_length_m', in metres",
    ),
    ("stages", "limits.voltage_max_mv", 2e5, "this quantity is given as 'voltage_max_v', in volts"),
    ("stages", "amplifier.bandwidth_khz", 30.0, "this quantity is given as 'bandwidth_hz', in hertz"),
    (
        "buses",
        "period_ms",
        0.2,
        "period_ms: unknown key; this quantity is given as 'period_us', in integer microseconds",
    ),
    ("stages", "geometry.crank_lenght_m", 500e-6, "unknown key; did you mean 'crank_length_m'?"),
    (
        "controllers",
        "monitors.stale_counts",
        5,
        "monitors.stale_counts: unknown key; this quantity is given as 'stale_count'",
    ),
    (
        "buses",
        "analog.zzz",
        1.0,
        "analog.zzz: unknown key; known here: drive_volt_per_count, sense_farad_per_count, sense_offset_f",
    ),
    ("controllers", "colour", "red", "colour: unknown key; known here: name, law, "),
    ("buses", "can.driver.nodeid", 3, "can.driver.nodeid: unknown key; did you mean 'node_id'?"),
    # missing
    ("stages", "dynamics.mass_kg", None, "dynamics.mass_kg: missing; add this key, in kilograms"),
    ("controllers", "limits", None, "limits: missing; add this key"),
    ("buses", "period_us", None, "period_us: missing; add this key, in integer microseconds"),
    # out of range
    (
        "stages",
        "geometry.crank_length_m",
        -1e-3,
        "geometry.crank_length_m: input should be greater than 0 (got -0.001), in metres",
    ),
    (
        "stages",
        "limits.voltage_max_v",
        5000.0,
        "limits.voltage_max_v: input should be less than or equal to 1000 (got 5000.0), in volts",
    ),
    ("stages", "flexures.out_of_plane_chains", 2, "flexures.out_of_plane_chains: input should be 1 or 3 (got 2)"),
    ("buses", "delay_periods", 3, "delay_periods: input should be less than or equal to 2 (got 3)"),
    (
        "buses",
        "can.standstill_max_us",
        1000,
        "can: standstill_max_us is for interface pkxyz-unix, where the amplifier "
        "may be simulated; what is behind pkxyz-sim does not wait: leave it out",
    ),
    ("buses", "can.driver.node_id", 128, "can.driver.node_id: input should be less than or equal to 127 (got 128)"),
    ("stages", "name", "", "name: string should have at least 1 character (got '')"),
    # not a number
    ("stages", "dynamics.mass_kg", math.nan, "dynamics.mass_kg: input should be"),
    (
        "stages",
        "limits.stroke_max_m",
        math.inf,
        "limits.stroke_max_m: input should be a finite number (got inf), in metres",
    ),
    (
        "controllers",
        "monitors.stroke_min_m",
        -math.inf,
        "monitors.stroke_min_m: input should be a finite number (got -inf), in metres",
    ),
    # of another type, which is never converted
    (
        "stages",
        "dynamics.mass_kg",
        "4.8e-6",
        "dynamics.mass_kg: input should be a valid number (got '4.8e-6'), in kilograms",
    ),
    ("buses", "period_us", 200.5, "period_us: input should be a valid integer (got 200.5), in integer microseconds"),
    ("buses", "period_us", "200", "period_us: input should be a valid integer (got '200'), in integer microseconds"),
    ("controllers", "limits.noise_shaping", 1, "limits.noise_shaping: input should be a valid boolean (got 1)"),
    ("stages", "dynamics", 3, "dynamics: input should be a valid dictionary"),
    ("controllers", "operating_strokes_m", [1e-6, 2e-6], "operating_strokes_m"),
    # pieces that contradict each other
    (
        "stages",
        "geometry.link_length_m",
        589e-6,
        "geometry: give the link either by link_projection_rest_m and link_height_rest_m or by",
    ),
    ("stages", "geometry.base_radius_m", 1e-3, "geometry: links do not close: base_radius_m must exceed"),
    ("stages", "limits.stroke_min_m", 30e-6, "limits: stroke_min_m must lie below stroke_max_m"),
    (
        "buses",
        "can.data_bitrate_bit_per_s",
        None,
        "can: driver.fd and data_bitrate_bit_per_s belong together: give both for CAN FD",
    ),
    (
        "buses",
        "can.sense_deadline_us",
        199,
        "can.sense_deadline_us + compute_us and can.heartbeat_deadline_us must lie within period_us",
    ),
]


@pytest.mark.parametrize(("kind", "key", "value", "message"), MISTAKES, ids=[f"{m[1]}={m[2]}" for m in MISTAKES])
def test_a_mistake_is_one_line_with_file_key_and_remedy(kind, key, value, message):
    name = {"stages": "reconstructed", "controllers": "lqg", "buses": "fd_5k"}[kind]
    told = error_of(kind, changed(kind, name, key, value))
    assert told.startswith("a.toml: ")
    assert message in told
    assert "\n" not in told


def test_every_mistake_of_a_file_is_told():
    data = changed("stages", "reconstructed", "dynamics.mass_g", 4.8e-3)
    data["limits"]["voltage_max_v"] = -1.0
    del data["sense"]["noise_density_f_per_rthz"]
    lines = error_of("stages", data).splitlines()
    assert len(lines) == 3
    for key in ("dynamics.mass_g", "limits.voltage_max_v", "sense.noise_density_f_per_rthz"):
        assert sum(f"a.toml: {key}: " in line for line in lines) == 1


def test_files_that_cannot_be_read(tmp_path):
    broken = tmp_path / "broken.toml"
    broken.write_text("name = \n")
    with pytest.raises(ConfigError, match=r"broken\.toml: not valid TOML: .*line 1"):
        load("stages", broken, StageConfig)
    (tmp_path / "latin.toml").write_bytes(b'name = "\xe9"\n')
    with pytest.raises(ConfigError, match=r"latin\.toml: cannot be read: .*utf-8"):
        read_toml(tmp_path / "latin.toml")
    with pytest.raises(ConfigError, match=r"cannot be read"):
        read_toml(tmp_path)
    with pytest.raises(ConfigError, match=r"absent\.toml: no such file$"):
        read_toml(tmp_path / "absent.toml")


@pytest.mark.parametrize("path", ["here/absent.toml", "absent.toml", "here/absent", r"here\absent"])
def test_a_path_that_is_not_there_names_what_is_shipped(path):
    with pytest.raises(ConfigError) as caught:
        find("stages", path)
    told = str(caught.value)
    assert told.endswith(f"no such file; give the path of a TOML file or one of: {', '.join(names('stages'))}")
    assert "absent" in told


def test_a_name_that_is_not_known_is_answered_with_those_that_are():
    with pytest.raises(ConfigError) as caught:
        find("stages", "reconstruced")
    assert str(caught.value) == (
        "stages: no configuration named 'reconstruced'; did you mean 'reconstructed'? "
        f"known: {', '.join(names('stages'))}; or give the path of a TOML file"
    )
    with pytest.raises(ConfigError, match=r"no configuration named 'xyz'; known: .*fd_5k"):
        find("buses", "xyz")
    with pytest.raises(ConfigError, match="known: none"):
        find("nonsense", "xyz")


def test_models_cannot_be_changed():
    model = load("buses", "fd_5k", BusConfig)
    with pytest.raises(ValueError, match="frozen"):
        model.period_us = 100
    with pytest.raises(ValueError, match="frozen"):
        model.analog.sense_offset_f = 1.0


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=10,
)


@settings(max_examples=100)
@given(st.dictionaries(st.text(max_size=5), JSON, max_size=4))
def test_the_digest_is_of_the_content_not_of_its_order(data):
    turned = dict(reversed(list(data.items())))
    assert digest(data) == digest(turned)
    assert len(digest(data)) == 16
    assert int(digest(data), 16) >= 0
    assert digest(data | {"one more": 1}) != digest(data)


def test_the_digest_is_the_same_on_every_machine():
    """SHA-256 of canonical JSON, its first 16 digits, here by sha256sum; old recordings go by it."""
    assert digest({"a": 1, "b": [1.5, "x"], "c": {"z": None, "y": True}}) == "2f3c7a05abcf6cfc"
    with pytest.raises(ValueError, match="not JSON compliant"):
        digest({"a": math.nan})


def test_a_change_of_any_number_changes_the_digest():
    data = plain(load("stages", "reconstructed", StageConfig))
    seen = {digest(data)}
    for section, values in data.items():
        for key, value in values.items() if isinstance(values, dict) else ():
            if isinstance(value, float):
                other = data | {section: values | {key: float(np.nextafter(value, 1.0))}}
                seen.add(digest(other))
    assert len(seen) == 1 + sum(
        isinstance(v, float) for values in data.values() if isinstance(values, dict) for v in values.values()
    )


def test_numbers_from_elsewhere_are_finite_or_refused():
    assert require_finite(3, "gain") == 3.0
    for bad in (math.nan, math.inf, -math.inf):
        with pytest.raises(ConfigError, match="gain must be a finite number, got"):
            require_finite(bad, "gain")


def test_what_write_toml_writes_anyone_can_read(tmp_path):
    data = plain(load("controllers", "lqg", ControllerConfig))
    write_toml(data, tmp_path / "c.toml")
    assert tomlkit.parse((tmp_path / "c.toml").read_text()).unwrap() == data


@pytest.mark.parametrize("name", names("controllers"))
def test_every_shipped_law_is_watched_alike(name):
    """A fault is decided after as many ticks whatever law runs: ``pkxyz faults`` holds them all to one bound."""
    watched = load("controllers", name, ControllerConfig).monitors
    if name == "open_loop":  # nothing brings a soft device back to its force: safety/thresholds.py
        assert watched.force_change_share == 0.58
        watched = watched.model_copy(update={"force_change_share": 0.47})
    assert watched == load("controllers", "lqg", ControllerConfig).monitors

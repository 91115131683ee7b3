"""Faults as data: what a text or a file may say, and what each fault does where it lives."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_rig import bus, setup

from hil.faults.catalogue import KINDS, PARTS, targets
from hil.faults.fault import Fault, parse
from hil.faults.plant import FaultyPlant
from hil.lanes.lane import Lane
from hil.runs.run import require_bus
from hil.runs.scenario import load_scenario, resolve
from pkxyz_ctrl.config.files import CONFIG_DIR, ConfigError

PAIRS = [
    (target, kind)
    for target in targets()
    for kind in KINDS[target.partition(".")[0]]
    if not (kind == "babbling" and "." in target)
]


@st.composite
def faults(draw):
    target, kind = draw(st.sampled_from(PAIRS))
    known = KINDS[target.partition(".")[0]][kind].parameters
    chosen = draw(st.sets(st.sampled_from(sorted(known)))) if known else ()
    return Fault(
        target=target,
        kind=kind,
        at_s=draw(st.integers(0, 10**6)) * 1e-4,
        duration_s=draw(st.none() | st.integers(1, 10**5).map(lambda n: n * 1e-4)),
        parameters={name: draw(st.floats(known[name].low, known[name].high)) for name in chosen},
    )


@given(faults())
def test_what_is_printed_is_read_back(fault):
    again = parse(str(fault))
    assert (again.target, again.kind) == (fault.target, fault.kind)
    assert again.at_s == pytest.approx(fault.at_s, rel=1e-5)
    assert again.parameters == pytest.approx(fault.parameters, rel=1e-5)
    assert (again.duration_s is None) == (fault.duration_s is None)


def test_every_pair_of_target_and_kind_is_accepted_or_refused_as_the_catalogue_says():
    every_kind = {kind for kinds in KINDS.values() for kind in kinds}
    for target in targets():
        for kind in every_kind:
            text = f"{target}:{kind}@0.1"
            if (target, kind) in PAIRS:
                assert parse(text).kind == kind
            else:
                with pytest.raises(ConfigError, match=f"{target} has no fault '{kind}'; it has"):
                    parse(text)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sense.2:stuck", "is not TARGET:KIND@SECONDS"),
        ("sense.2@0.3", "is not TARGET:KIND@SECONDS"),
        ("sense:stuck@0.3", "no target is called 'sense'; there are sense.1, sense.2, sense.3"),
        ("sense.4:stuck@0.3", "no target is called 'sense.4'"),
        ("node.1:reset@0.3", "no target is called 'node.1'; there are node"),
        ("laser:off@0.3", "no target is called 'laser'"),
        ("bus.sense:babbling@0.3", "has no fault 'babbling'"),
        ("sense.1:offset@0.3,gain=2", "has no parameter 'gain'; it has: offset_m"),
        ("sense.1:stuck@0.3,gain=2", "has no parameter 'gain'; it has: none"),
        ("sense.1:wrong_gain@0.3,gain=11", "gain = 11 is not within 0 to 10"),
        ("sense.1:wrong_gain@0.3,gain=nan", "finite number"),
        ("sense.1:stuck@soon", "a number is expected"),
        ("sense.1:stuck@-1", "at_s: Input should be greater than or equal to 0"),
        ("sense.1:stuck@0.3+0", "duration_s: Input should be greater than 0"),
    ],
)
def test_a_fault_that_does_not_exist_is_refused_with_what_there_is(text, words):
    with pytest.raises(ConfigError) as caught:
        parse(text)
    assert words in str(caught.value)


def test_faults_of_a_file_and_of_the_command_line_come_together(tmp_path):
    text = (CONFIG_DIR / "scenarios" / "raster.toml").read_text(encoding="utf-8")
    entry = '[[faults]]\ntarget = "sense.2"\nkind = "offset"\nat_s = 0.3\nparameters = { offset_m = 1e-6 }\n'
    path = tmp_path / "mine.toml"
    path.write_text(text.replace("[checks]", f"{entry}\n[checks]"), encoding="utf-8")
    loaded = load_scenario(path, faults=[parse("bus:babbling@0.5+0.01")])
    assert [str(f) for f in loaded.setup().faults] == ["sense.2:offset@0.3,offset_m=1e-06", "bus:babbling@0.5+0.01"]
    assert resolve(loaded)["faults"][0]["parameters"] == {"offset_m": 1e-6}
    with pytest.raises(ConfigError, match="the fast lane has no frames"):
        require_bus(loaded, Lane.FAST)
    path.write_text(text.replace("[checks]", f"{entry.replace('offset_m', 'gain')}\n[checks]"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"mine.toml: faults\.0: sense.2:offset has no parameter 'gain'"):
        load_scenario(path)


# -- what a fault does where it lives -------------------------------------------------------------------------------


def sampled(*texts, ticks=40, counts=(9000, 9000, 9000)):
    """Sense counts (ticks, 3) and comb voltages (ticks, 3) of a plant that is driven with the same counts all along,
    with faults and without."""
    run = dataclasses.replace(setup(), faults=tuple(parse(t) for t in texts))
    found = []
    for some in (run.faults, ()):
        plant = FaultyPlant(run.new_plant(), some, run.bus, seed=5)
        seen, volts = [], []
        for k in range(ticks):
            seen.append(plant.exchange(1000 + 200 * k, counts, sample=True))
            volts.append(plant.plant.voltage_v)
        found.append((np.array(seen), np.array(volts)))
    (seen, volts), (seen_whole, volts_whole) = found
    return seen, volts, seen_whole, volts_whole


FROM, UNTIL = 10, 20  # ticks of "@0.002+0.002"


@pytest.mark.parametrize("channel", [1, 2, 3])
@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("off", lambda x, whole: np.full_like(x, -32768)),
        ("stuck", lambda x, whole: np.full_like(x, whole[FROM])),
        ("offset,offset_m=1e-6", lambda x, whole: whole[FROM:UNTIL] + 1e-6 * GRADIENT),
        ("wrong_gain,gain=1.5", lambda x, whole: REST + 1.5 * (whole[FROM:UNTIL] - REST)),
        ("delayed,samples=3", lambda x, whole: whole[np.maximum(np.arange(FROM, UNTIL) - 3, FROM)]),
    ],
)
def test_a_sense_channel_shows_what_its_fault_makes_of_it_and_the_others_do_not(channel, kind, expected):
    head, comma, rest = kind.partition(",")
    seen, _, whole, _ = sampled(f"sense.{channel}:{head}@0.002+0.002{comma}{rest}")
    hit = channel - 1
    wanted = expected(seen[FROM:UNTIL, hit], whole[:, hit])
    assert np.abs(seen[FROM:UNTIL, hit] - wanted).max() <= 1.0
    untouched = np.ones(seen.shape, bool)
    untouched[FROM:UNTIL, hit] = False
    assert np.array_equal(seen[untouched], whole[untouched])


GRADIENT = 2 * 360 * 8.8541878128e-12 * 100e-6 / 5e-6 / bus().analog.sense_farad_per_count
REST = (GRADIENT * 20e-6) - bus().analog.sense_offset_f / bus().analog.sense_farad_per_count


def test_random_sense_faults_are_random_and_the_same_for_the_same_seed():
    for kind in ("garbage", "intermittent,probability=0.5", "noise_burst"):
        head, comma, rest = kind.partition(",")
        seen, _, whole, _ = sampled(f"sense.1:{head}@0.002{comma}{rest}", ticks=200)
        again, _, _, _ = sampled(f"sense.1:{head}@0.002{comma}{rest}", ticks=200)
        assert np.array_equal(seen, again)
        off = seen[FROM:, 0] == -32768
        if head == "intermittent":
            assert 60 < off.sum() < 130
            assert np.array_equal(seen[FROM:, 0][~off], whole[FROM:, 0][~off])
        else:
            spread = np.std(seen[FROM:, 0] - whole[FROM:, 0])
            assert {"garbage": 12_000, "noise_burst": 3e-6 * GRADIENT * 0.8}[head] < spread
            assert spread < {"garbage": 26_000, "noise_burst": 3e-6 * GRADIENT * 1.2}[head]


@pytest.mark.parametrize("channel", [1, 2, 3])
@pytest.mark.parametrize(
    ("kind", "volts_then"),
    [
        ("dead", lambda whole: 0.0),
        ("saturated,voltage_v=20", lambda whole: 20.0),
        ("offset,offset_v=-15", lambda whole: whole - 15.0),
        ("offset,offset_v=15", lambda whole: whole + 15.0),
    ],
)
def test_an_amplifier_channel_gives_what_its_fault_lets_it(channel, kind, volts_then):
    head, comma, rest = kind.partition(",")
    _, volts, _, whole = sampled(f"amplifier.{channel}:{head}@0.002+0.002{comma}{rest}")
    hit = channel - 1
    steady = whole[5, hit]
    assert 50 < steady < 60
    assert volts[FROM + 1 : UNTIL, hit] == pytest.approx(np.full(9, volts_then(steady)), abs=0.02)
    assert volts[UNTIL + 1 :, hit] == pytest.approx(np.full(19, steady), abs=0.02)
    others = [i for i in range(3) if i != hit]
    assert np.abs(volts[:, others] - whole[:, others]).max() < 1e-9


def test_a_stuck_amplifier_keeps_its_voltage_and_a_slow_one_moves_by_so_much_a_period():
    run = dataclasses.replace(
        setup(), faults=(parse("amplifier.1:stuck@0.002"), parse("amplifier.2:slew_collapse@0.002"))
    )
    plant = FaultyPlant(run.new_plant(), run.faults, run.bus, seed=5)
    volts = []
    for k in range(40):
        plant.exchange(200 * k, (9000, 9000, 9000) if k < 15 else (0, 0, 0), sample=True)
        volts.append(plant.plant.voltage_v)
    volts = np.array(volts)
    assert volts[5:, 0] == pytest.approx(np.full(35, volts[5, 0]), abs=0.01)
    assert np.diff(volts[17:, 1]) == pytest.approx(np.full(22, -300 * 200e-6), abs=0.007)  # a count is 6 mV
    assert volts[17:, 2] == pytest.approx(np.zeros(23), abs=1e-6)


def test_forces_and_stiffness_act_for_their_time_only():
    run = dataclasses.replace(setup(), faults=(parse("plant:shock@0.002+0.001"), parse("plant:stiffness@0.004+0.001")))
    plant = FaultyPlant(run.new_plant(), run.faults, run.bus, seed=5)
    forces, leaf = [], []
    for k in range(40):
        plant.exchange(200 * k, (0, 0, 0), sample=True)
        forces.append(plant.plant.external_force_n[0])
        leaf.append(plant.plant.params["leaf_n_per_m"][0, 0])
    assert np.flatnonzero(forces).tolist() == list(range(10, 15))
    assert set(np.flatnonzero(np.array(leaf) != leaf[0])) == set(range(20, 25))
    assert leaf[22] == pytest.approx(1.5 * leaf[0])
    assert leaf[-1] == leaf[0]


def test_the_catalogue_is_whole():
    assert len(PAIRS) > 70
    assert all(part in "123" for part in PARTS["sense"] + PARTS["amplifier"])
    for kinds in KINDS.values():
        for kind in kinds.values():
            assert len(kind.meaning) > 5
            for parameter in kind.parameters.values():
                assert parameter.low <= parameter.default <= parameter.high

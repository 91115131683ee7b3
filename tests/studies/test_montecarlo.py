"""Monte Carlo: plants sampled by seeds, kept line by line, resumed, and run again alone to the bit."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_rig import setup
from typer.testing import CliRunner

from hil.cli import app
from hil.pictures.montecarlo import draw_montecarlo
from hil.recording.recording import Recording
from hil.runs.scenario import load_scenario
from hil.studies.montecarlo import (
    PLANTS_AT_ONCE,
    Result,
    Results,
    Study,
    changed_plant,
    run_one,
    run_study,
    summary,
    worst,
)
from hil.studies.spread.missing import pieces
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.design.model.loop_plant import ParasiticMode, Perturbation
from sim.config import PlantConfig


def a_study(controller="lqg"):
    return Study(load_scenario("raster", controller=controller), load("tolerances", "wide", Tolerances))


def a_result(seed, error=1.0, peak=1.6, fault=None):
    return Result(seed, error, 0.8, peak, 0, fault)


def test_the_sampled_plant_has_what_was_sampled_and_otherwise_what_it_had():
    change = Perturbation(0.1, -0.05, 50.0, (0.01, -0.02, 0.03))
    plant = changed_plant(setup().plant, change)
    assert plant.stiffness_mismatch.on
    assert plant.stiffness_mismatch.leaf == plant.stiffness_mismatch.link_hinge == (0.1, 0.1, 0.1)
    assert (plant.mass_error.on, plant.mass_error.relative) == (True, -0.05)
    assert (plant.damping.on, plant.damping.quality_factor) == (True, 50.0)
    assert plant.comb_mismatch.relative == (0.01, -0.02, 0.03)
    assert plant.sense_noise == setup().plant.sense_noise
    assert changed_plant(setup().plant, Perturbation()) == PlantConfig.model_validate(
        setup().plant.model_dump() | {n: getattr(changed_plant(setup().plant, Perturbation()), n) for n in KINDS}
    )


KINDS = ("stiffness_mismatch", "mass_error", "comb_mismatch")
"""Switched on by any perturbation, if only by 0."""


def test_electronics_and_modes_that_were_sampled_are_simulated():
    """Delay and poles, and the first parasitic mode; a delay below 0 is none, and lab keeps its own chain and modes."""
    modes = (ParasiticMode(2500.0, 30.0, 3e-4), ParasiticMode(4500.0, 60.0, 1e-4))
    change = Perturbation(delay_s=40e-6, amplifier_bandwidth=-0.2, sense_bandwidth_hz=20e3, parasitic=modes)
    plant = changed_plant(setup("mild").plant, change)
    assert (plant.sense_delay.on, plant.sense_delay.delay_s) == (True, pytest.approx(41e-6))  # 1 us is mild's own
    assert plant.amplifier_bandwidth.corner_hz == pytest.approx(0.8 * 28e3)
    assert (plant.sense_bandwidth.on, plant.sense_bandwidth.corner_hz) == (True, 20e3)
    found = plant.parasitic
    assert (found.on, found.frequency_hz, found.quality_factor, found.compliance_share) == (True, 2500.0, 30.0, 3e-4)
    early = changed_plant(setup().plant, Perturbation(delay_s=-40e-6))
    assert early.sense_delay == setup().plant.sense_delay
    lab = changed_plant(setup("lab").plant, change)
    assert not lab.parasitic.on
    assert lab.flexible_modes == setup("lab").plant.flexible_modes
    assert lab.sense_bandwidth == setup("lab").plant.sense_bandwidth
    assert lab.sense_delay.delay_s == pytest.approx(40e-6)


@given(st.integers(1, 5000), st.integers(1, 40))
def test_pieces_are_all_plants_once_and_several_for_each_worker(plants, workers):
    handed = pieces(range(plants), workers, PLANTS_AT_ONCE)
    assert [seed for piece in handed for seed in piece] == list(range(plants))
    assert max(map(len, handed)) <= PLANTS_AT_ONCE
    assert len(handed) >= min(plants, 4 * workers)


def test_a_study_goes_on_where_it_was_and_every_plant_runs_again_to_the_bit(tmp_path):
    study, path = a_study(), tmp_path / "results.jsonl"
    results = Results(path, study)
    run_study(study, range(3, 5), results, 1)
    text = path.read_text()
    path.write_text(text + '{"seed": 5, "rms_err')  # as a killed process leaves it
    again = Results(path, study)
    assert again.found == results.found
    assert path.read_text() == text
    told = []
    run_study(study, range(3, 5), again, 1, on_progress=lambda done, total: told.append((done, total)))
    assert told == [(2, 2)]  # nothing was left to do
    for seed, result in again.found.items():
        assert run_one(study, seed) == result
        assert result.ok
        assert 0.3 < result.rms_error_nm < 200.0
    assert again.found[3] != again.found[4]
    with pytest.raises(ConfigError, match="another study"):
        Results(path, a_study("lqg_wide"))
    path.write_text("no JSON\n")
    with pytest.raises(ConfigError, match="not a file of results"):
        Results(path, study)
    draw_montecarlo(study, list(again.found.values()), tmp_path / "p.png")
    assert (tmp_path / "p.png").stat().st_size > 10_000


def test_the_worst_is_a_fault_then_an_unstable_loop_then_the_largest_error():
    calm, wild, unstable = a_result(1, 1.0), a_result(2, 9.0), a_result(3, 2.0, None)
    lost = Result(4, None, None, 1.6, 0, "at 1 s: sensor")
    assert worst([calm, wild]) is wild
    assert worst([calm, wild, unstable]) is unstable
    assert worst([unstable, lost, calm]) is lost
    found = summary([calm, wild, unstable, lost])
    assert found["not_held"] == 2
    assert found["worst_seed"] == 4
    assert found["rms_error_nm"] == {"median": 2.0, "p95": pytest.approx(8.3), "max": 9.0, "max_seed": 2}
    assert summary([lost])["rms_error_nm"] is None


def test_one_plant_alone_leaves_a_run_folder(tmp_path):
    done = CliRunner().invoke(app, ["montecarlo", "--alone", "3", "--out", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    data = json.loads(done.stdout)
    recorded = json.loads((tmp_path / "seed-3" / "summary.json").read_text())
    assert max(recorded["rms_error_nm"].values()) == data["rms_error_nm"]
    assert Recording.open(tmp_path / "seed-3" / "recording.parquet").metadata["seed"] == 3
    sampled = a_study().tolerances.sample(3).perturbation
    assert data["sampled"]["stiffness"] == sampled.stiffness

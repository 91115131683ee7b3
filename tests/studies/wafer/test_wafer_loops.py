"""Sampled devices in a closed loop: what the plant and the linear plant are told is the device that was made."""

from dataclasses import replace

import numpy as np
import pytest
from process_rig import SHIPPED, STAGE, devices, process
from sim_truth import stiffness_at

from hil.bench.study import short_scan
from hil.lanes import in_process as lanes
from hil.lanes import many
from hil.lanes.lane import Lane
from hil.runs.metrics import Metrics
from hil.runs.scenario import load_scenario
from hil.studies.margins.loop import Loop
from hil.studies.wafer.closed_loop import PART_DEVICES, ClosedLoops, Truth
from hil.studies.wafer.study import WaferStudy
from pkxyz_ctrl.config.bound import Bound
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.design.margins import sensitivity
from pkxyz_ctrl.fabrication.statics import pose, pose_of_strokes
from pkxyz_ctrl.fabrication.wafer import dies_per_wafer, sample_devices, sample_numbered
from pkxyz_ctrl.stage import Stage

MIDDLE = np.full(3, 12.5e-6)
SCENARIO = load_scenario("raster")


def loops(of=SHIPPED, known=True):
    return ClosedLoops(WaferStudy(of, STAGE, 1), SCENARIO, known)


def unlike():
    """A device whose chains differ, with links that are too long, and its truth."""
    made = devices(
        youngs_modulus=[0.02, -0.03, 0.01], etch_bias_m=[0.1e-6, -0.05e-6, 0.02e-6], handle_m=4e-6, layer_1_m=0.5e-6,
        hinge_m=0.3e-6, comb_gap_m=[0.1e-6, 0.0, -0.05e-6],
    )  # fmt: skip
    return made, Truth(STAGE, devices(), made)


def test_a_device_as_drawn_runs_and_holds_as_the_scenario_itself():
    asked = loops(process())
    setup = SCENARIO.setup()
    metrics = Metrics(setup.trajectory, setup.bus.period_us)
    lanes.run(setup, Lane.FAST, on_block=metrics.update)
    truth, drawn = Truth(STAGE, devices(), devices()), Loop(Stage(setup.stage), setup.bus, setup.law).margins(MIDDLE)
    assert truth.margins(setup) == pytest.approx((drawn.mimo.peak_s, drawn.mimo.bandwidth_hz), rel=1e-3)
    found = asked.device(0)
    drawn_nm = max(metrics.figures().rms_error_nm.values())
    for law in ("shipped", "known"):
        assert found[f"{law}.error_nm"] == pytest.approx(drawn_nm, rel=0.1)  # another seed of the noise


def test_the_plant_has_the_springs_and_combs_that_were_made():
    made, truth = unlike()
    setup = SCENARIO.setup()
    plant = truth.plant(setup.plant)
    params = replace(setup, plant=plant, device=truth.device(setup.device)).new_plant().params[0]
    for strokes in (np.zeros(3), MIDDLE, np.array([25e-6, 3e-6, 11e-6])):
        there, position = pose_of_strokes(made, strokes)
        assert stiffness_at(params, position[0]) == pytest.approx(there.stiffness_n_per_m[0], rel=1e-9, abs=1e-7)
    assert params["force_gain_n_per_v2"] == pytest.approx(made.comb_n_per_v2[0], rel=1e-12)
    assert params["mass_kg"] == pytest.approx(made.mass_kg[0], rel=1e-12)
    drawn_f_per_m = setup.new_plant().params[0]["sense_f_per_m"]
    assert params["sense_f_per_m"] == pytest.approx(drawn_f_per_m * made.sense_gain[0], rel=1e-12)


def test_what_an_identification_would_find_has_the_devices_resonances_in_the_plane():
    made, truth = unlike()
    mass = float(made.mass_kg[0]) / STAGE.dynamics.mass_kg
    known, itself = Stage(truth.stage).stiffness(np.zeros(3)) * mass, pose(made, np.zeros(3)).stiffness_n_per_m[0]
    assert known[:2, :2] == pytest.approx(itself[:2, :2], rel=1e-9, abs=1e-9)
    assert known[2, 2] != pytest.approx(itself[2, 2], rel=1e-3)  # links that are too long nobody sees from inside


def test_combs_that_are_sensed_two_per_cent_too_large_make_errors_of_that_size():
    """Wider gaps: the same stroke is sensed as a smaller one, so the table is held as much farther out."""
    asked = loops(
        process(comb_gap_m=SHIPPED.comb_gap_m.model_copy(update={"mean": 0.1e-6, "wafer": 0.0, "chain": 0.0}))
    )
    found = asked.device(0)
    highest_nm = 20e3  # of the raster above rest, about
    assert 0.3 * 0.02 * highest_nm < found["shipped.error_nm"] < 3 * 0.02 * highest_nm
    assert found["known.error_nm"] < 2.0


def test_a_handle_that_is_thicker_by_1_um_leaves_60_nm_that_nothing_inside_can_see():
    thicker = process(
        handle_m=SHIPPED.handle_m.model_copy(update=dict.fromkeys(("wafer", "bowl", "die"), 0.0) | {"mean": 1e-6})
    )
    assert 45.0 < loops(thicker).device(0)["known.error_nm"] < 75.0


def test_a_part_is_its_devices_one_on_each_wafer():
    asked = loops(known=False)
    numbers = asked.numbers(1)
    assert (numbers // dies_per_wafer(SHIPPED)).tolist() == list(range(PART_DEVICES, 2 * PART_DEVICES))
    assert len(set((numbers % dies_per_wafer(SHIPPED)).tolist())) > PART_DEVICES // 2
    part = asked.part(1)
    assert part["device"].tolist() == list(range(PART_DEVICES, 2 * PART_DEVICES))
    alone = asked.device(int(numbers[3]))
    assert all(part[name][3] == value for name, value in alone.items())
    assert set(asked.verdict_columns) <= part.keys()
    assert part["ok.shipped"].dtype == bool


@pytest.mark.parametrize("per_wafer", [2, 3, 76])
def test_so_many_devices_lie_on_each_wafer_all_over_it(per_wafer):
    asked = replace(loops(known=False), per_wafer=per_wafer)
    dies = dies_per_wafer(SHIPPED)
    numbers = np.concatenate([asked.numbers(part) for part in range(-(-per_wafer * 8 // PART_DEVICES))])
    numbers = numbers[: per_wafer * 8]
    assert (numbers // dies).tolist() == np.repeat(np.arange(8), per_wafer).tolist()
    gaps = np.diff(np.sort((numbers % dies).reshape(8, per_wafer), axis=1), axis=1)
    assert gaps.min() >= dies // per_wafer  # so each die once at most
    assert numbers[::per_wafer].tolist() == loops(known=False).numbers(0)[:8].tolist()
    assert asked.digest() != loops(known=False).digest()


@pytest.mark.parametrize("per_wafer", [0, 77])
def test_more_devices_than_a_wafer_has_are_refused(per_wafer):
    with pytest.raises(ConfigError, match=f"has 76 devices a wafer; {per_wafer} were asked for"):
        replace(loops(), per_wafer=per_wafer)


def test_devices_at_once_are_the_same_to_the_bit_as_each_alone():
    asked = loops(known=False).wafers
    numbers = np.array([7, 3, 4, 5000, 5001, 2])
    some = asked.made(sample_numbered(asked.process, asked.seed, numbers))
    for n, number in enumerate(numbers.tolist()):
        alone = asked.made(sample_devices(asked.process, asked.seed, number, 1))
        for name, values in vars(alone).items():
            assert np.array_equal(vars(some.take(np.array([n])))[name], values), name


def test_devices_together_have_the_figures_of_each_by_its_rows_and_by_substitution(monkeypatch):
    """Errors from a recording's rows, Ms without modes: as one device was looked at before there were many."""
    asked = ClosedLoops(WaferStudy(SHIPPED, STAGE, 1), short_scan(), known=True)
    numbers = asked.numbers(2)[:6]
    found = asked.devices(numbers)
    monkeypatch.setattr(many, "can_run", lambda setup: False)
    monkeypatch.setattr(sensitivity, "split", lambda *of: None)
    for row, other in zip(found, asked.devices(numbers), strict=True):
        assert row == pytest.approx(other, rel=1e-9)


def test_a_requirement_on_a_loop_that_is_none_is_refused():
    with pytest.raises(ConfigError, match=r"closed_loop.'shipped.error_m': no such figure"):
        loops(SHIPPED.model_copy(update={"closed_loop": {"shipped.error_m": Bound(max=1.0)}}))

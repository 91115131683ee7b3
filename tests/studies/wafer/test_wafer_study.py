"""Studies of a wafer: the same bits however they are spread, kept while they go on, and what they say of causes."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from process_rig import SHIPPED, STAGE, process

from hil.studies.wafer.causes import PLACE, causes
from hil.studies.wafer.shares import share_of
from hil.studies.wafer.study import PART_WAFERS, WaferStudy, parts_for, run_study
from hil.studies.wafer.table import Table
from pkxyz_ctrl.config.bound import Bound
from pkxyz_ctrl.config.calibration import Calibration
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.fabrication.process import Spread
from pkxyz_ctrl.fabrication.wafer import dies_per_wafer

PART = PART_WAFERS * dies_per_wafer(SHIPPED)


def study(of=SHIPPED, seed=1):
    return WaferStudy(of, STAGE, seed)


def kept(asked, folder, devices, workers=1):
    table = Table(folder, asked.digest())
    run_study(asked, parts_for(SHIPPED, devices), table, workers)
    return table


def test_parts_wafers_and_a_device_alone_have_the_same_bits():
    asked = study()
    whole = asked.columns(range(3))
    each = [asked.columns(range(w, w + 1)) for w in range(3)]
    for name, values in whole.items():
        assert values.tobytes() == np.concatenate([part[name] for part in each]).tobytes(), name
    for number in (0, 100, 227):
        alone = asked.alone(number)
        for name in (*SHIPPED.requirements, "mass", "held_m", "ok"):
            assert alone[name] == whole[name][number].item()


@pytest.mark.slow
def test_two_processes_write_the_bytes_of_one(tmp_path):
    for workers in (1, 2):
        kept(study(), tmp_path / str(workers), 2 * PART, workers)
    names = sorted(path.name for path in (tmp_path / "1").iterdir())
    assert names == ["part-000000.parquet", "part-000001.parquet"]
    assert all((tmp_path / "1" / n).read_bytes() == (tmp_path / "2" / n).read_bytes() for n in names)


def test_an_interrupted_study_goes_on_and_is_the_same(tmp_path):
    asked = study()
    table = Table(tmp_path / "a", asked.digest())

    def interrupt(done, total):
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(asked, 2, table, 1, on_progress=interrupt)
    assert table.parts == {0}
    half = table.read(["ok"], 2 * PART)["ok"]  # a partial result at any time
    worked = []
    resumed = Table(tmp_path / "a", asked.digest())
    run_study(asked, 2, resumed, 1, on_progress=lambda done, total: worked.append(done))
    assert worked == [1, 2]
    whole = resumed.read(["ok", "top_v"], 2 * PART)
    assert whole["ok"][:PART].tolist() == half.tolist()
    assert (
        whole["top_v"].tobytes()
        == np.concatenate(
            [asked.columns(range(k * PART_WAFERS, (k + 1) * PART_WAFERS))["top_v"] for k in (0, 1)]
        ).tobytes()
    )
    assert len(resumed.read(["ok"], 100)["ok"]) == 100


def test_the_table_is_parquet_that_anyone_reads_and_no_other_studys(tmp_path):
    kept(study(), tmp_path / "t", 10)
    table = pq.read_table(tmp_path / "t")
    assert {"device", "wafer", "x_m", "y_m", "etch_bias_m", "frequency_low_hz", "ok.top_v", "ok"} <= set(
        table.column_names
    )
    assert table.num_rows == PART
    assert table.column("device").to_pylist() == list(range(PART))
    with pytest.raises(ConfigError, match="devices of another study"):
        Table(tmp_path / "t", study(seed=2).digest())
    (tmp_path / "t" / "part-000001.parquet").write_text("no")
    with pytest.raises(ConfigError, match="is not a table of devices"):
        Table(tmp_path / "t", study().digest())


def test_a_share_agrees_with_that_of_other_wafers(tmp_path):
    tight = SHIPPED.model_copy(update={"requirements": {"top_v": Bound(max=186.0), "stiffness": Bound(max=0.12)}})
    shares = []
    for seed in (1, 2):
        columns = study(tight, seed).columns(range(60))
        shares.append(share_of(columns["ok"], columns["wafer"]))
    first, second = shares
    assert 0.3 < first.value < 0.9
    assert first.low <= second.value <= first.high
    assert second.low <= first.value <= second.high
    assert first.effective < 0.2 * first.devices  # wafers differ


def test_the_causes_of_a_product_share_its_variance_as_their_own():
    """f goes as the root of E over a mass that goes with the handle: at small spreads the variances add up."""
    of = process(
        youngs_modulus=Spread(wafer=0.010, chain=0.0), layer_2_m=Spread(die=3e-6), alignment_x_m=Spread(wafer=1e-7),
        requirements={"frequency_low_hz": Bound(min=631.0), "mass": Bound(max=0.5)},
    )  # fmt: skip
    found = causes(study(of), 1024)
    assert found.indices.names == (PLACE, "layer_2_m", "alignment_x_m", "youngs_modulus")
    of_mass = SHIPPED.made_of.mass_layer_2 * 3.0 / 27.0
    expected = np.array([0.0, of_mass**2, 0.0, 0.010**2]) / (of_mass**2 + 0.010**2)
    assert found.indices.total[:, 0] == pytest.approx(expected, abs=0.03)
    assert np.all(np.abs(found.indices.total[:, 0] - expected) < 4 * found.indices.error[:, 0] + 5e-4)
    assert found.indices.total[:, 1] == pytest.approx([0.0, 1.0, 0.0, 0.0], abs=0.1)
    # half fails; without the larger cause it is still half: what is won is told only by where the bound lies
    assert found.share == pytest.approx(0.5, abs=0.06)


def test_what_costs_devices_is_what_wins_them_without_its_spread():
    of = process(hinge_m=Spread(wafer=0.5e-6), youngs_modulus=Spread(wafer=0.001),
                 requirements={"top_v": Bound(max=186.0)})  # fmt: skip
    found = causes(study(of), 512)
    assert 0.6 < found.share < 0.9
    assert found.share_without["hinge_m"] == 1.0
    assert found.share_without["youngs_modulus"] == pytest.approx(found.share, abs=0.02)
    assert json.loads(json.dumps(found.as_json()))["share"] == found.share


def test_any_number_of_devices_tells_causes():
    """One that is no power of 2."""
    of = process(hinge_m=Spread(wafer=0.5e-6), requirements={"top_v": Bound(max=186.0)})
    found = causes(study(of), 100).indices
    assert found.total[1] == pytest.approx(1.0, abs=4.0 * found.error[1, 0])


class Counted:
    """Parts of two rows that say which they are."""

    together = 4

    def part(self, number):
        return {"device": np.arange(2 * number, 2 * number + 2)}


def test_parts_are_handed_out_together_where_many_are_left_and_are_the_same_table(tmp_path):
    """Those in the middle were there."""
    table = Table(tmp_path, "asked")
    table.add(range(5, 7), Counted().part(5) | {"device": np.arange(10, 14)})
    told = []
    run_study(Counted(), 20, table, 1, on_progress=lambda done, total: told.append((done, total)))
    assert told == [(2, 20), (6, 20), (7, 20), (11, 20), (15, 20), (19, 20), (20, 20)]
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names[:3] == ["part-000000-000003.parquet", "part-000004.parquet", "part-000005-000006.parquet"]
    again = Table(tmp_path, "asked")
    assert again.parts == set(range(20))
    assert again.read(["device"], 33)["device"].tolist() == list(range(33))


def test_a_worker_gets_single_parts_where_few_are_left(tmp_path):
    run_study(Counted(), 7, Table(tmp_path, "asked"), 1)
    assert len(list(tmp_path.iterdir())) == 7


def test_what_can_not_be_asked_is_refused_in_a_line():
    with pytest.raises(ConfigError, match="no such figure; known: frequency_low_hz"):
        study(SHIPPED.model_copy(update={"requirements": {"frequency": Bound(min=1.0)}}))
    with pytest.raises(ConfigError, match="not a drawing"):
        WaferStudy(SHIPPED, STAGE.model_copy(update={"calibration": Calibration()}), 1)
    wild = study(SHIPPED.model_copy(update={"etch_bias_m": Spread(wafer=5e-6)}))
    with pytest.raises(ConfigError, match="its spread is too wide"):
        wild.columns(range(20))

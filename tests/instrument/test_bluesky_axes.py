"""The stage's axes in a plan of bluesky's, without a server of EPICS between."""

import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from bluesky import Msg, RunEngine
from bluesky import plan_stubs as bps
from bluesky import plans as bp
from bluesky import protocols as bs
from bluesky.utils import FailedStatus
from command_line import alive, driven, served

from pkxyz_ctrl.client.plain import Stage
from pkxyz_ctrl.client.reply import StageError
from pkxyz_ctrl.instrument.bluesky_axes import StageAxis, axes

pytestmark = pytest.mark.at_rate


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    with served(tmp_path_factory.mktemp("bluesky")), alive() as stage:
        driven(stage)
        yield stage


@pytest.fixture(scope="module")
def xyz(stage: Stage) -> tuple[StageAxis, StageAxis, StageAxis]:
    return axes(stage)


@pytest.fixture(scope="module")
def run_engine() -> RunEngine:
    return RunEngine({}, context_managers=[])


def test_it_needs_nothing_of_bluesky():
    loads = "import sys, pkxyz_ctrl.instrument.bluesky_axes; sys.exit('bluesky' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", loads], check=False).returncode == 0


def test_it_is_what_plans_ask_for(xyz):
    for protocol in (bs.Readable, bs.Movable, bs.Locatable, bs.Stoppable, bs.Checkable, bs.Configurable):
        assert isinstance(xyz[0], protocol), protocol


def test_a_grid(xyz, run_engine):
    x, y, _ = xyz
    documents: dict[str, list] = {}
    run_engine(
        bp.grid_scan([], y, -1e-6, 1e-6, 2, x, -1e-6, 1e-6, 3, snake_axes=True),
        lambda kind, document: documents.setdefault(kind, []).append(document),
    )
    read = [[event["data"][key] for key in ("x", "y", "x_setpoint", "y_setpoint")] for event in documents["event"]]
    wanted = np.array([(-1, -1), (0, -1), (1, -1), (1, 1), (0, 1), (-1, 1)]) * 1e-6
    assert np.allclose(np.array(read)[:, 2:4], wanted, atol=1e-12)
    assert np.allclose(np.array(read)[:, 0:2], wanted, atol=50e-9)
    assert documents["descriptor"][0]["data_keys"]["x"]["units"] == "m"
    assert documents["stop"][0]["exit_status"] == "success"


def test_what_the_combs_cannot_hold_is_refused(xyz, run_engine, stage):
    before = stage.next_status().target_m
    with pytest.raises(FailedStatus):
        run_engine(bps.mv(xyz[0], 50e-6))
    with pytest.raises(StageError, match=r"x = 5e-05 m, limits -1\.\d+e-05 to 1\.\d+e-05 m"):
        xyz[0].check_value(50e-6)
    assert (stage.next_status().target_m == before).all()


def _stop_and_wait(x):
    yield from bps.stop(x)
    yield from bps.wait("going")


def test_a_stop_in_flight(xyz, run_engine, stage):
    x = xyz[0]
    run_engine(bps.mv(x, 0.0))
    slow = stage.description["limits"]
    stage.description["limits"] = [20e-6, *slow[1:]]
    try:

        def plan():
            status = yield Msg("set", x, 8e-6, group="going")
            while (yield from bps.rd(x)) < 0.5e-6:
                yield from bps.null()
            with pytest.raises(FailedStatus):  # whichever message it meets
                yield from _stop_and_wait(x)
            assert status.done
            assert not status.success

        run_engine(plan())
    finally:
        stage.description["limits"] = slow
    assert 0.5e-6 < x.locate()["setpoint"] < 7e-6
    run_engine(bps.mv(x, 0.0, xyz[1], 0.0))

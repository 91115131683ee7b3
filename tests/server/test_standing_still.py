"""A stage that is served as shipped, simulated, on a computer that stands still: processes are stopped and go on."""

import os
import signal
import threading
import time
from collections.abc import Iterator

import numpy as np
import psutil
import pytest
from command_line import alive, driven, served

from hil.lanes.standstill import STANDSTILL_US
from pkxyz_ctrl.client import place

pytestmark = pytest.mark.at_rate

STOPS_S = (0.002, 0.01, 0.04)
"""A moment, half a heartbeat's period, and less than is waited for at once."""


@pytest.fixture(scope="module", params=["--native", "--no-native"])
def loop(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with served(tmp_path_factory.mktemp("still"), request.param, bus=None):
        yield request.param


def process_of(kind: str) -> int:
    """A native loop is a process begun by its session's."""
    found = place.read("stage", kind)
    assert found is not None
    begun = [child.pid for child in psutil.Process(found["pid"]).children() if "python" not in child.name()]
    return begun[0] if begun else int(found["pid"])


def stopped(pid: int, seconds: float) -> None:
    os.kill(pid, signal.SIGSTOP)
    time.sleep(seconds)
    os.kill(pid, signal.SIGCONT)
    time.sleep(0.05)


@pytest.mark.parametrize("kind", ["loop", "plant"])
def test_in_a_scan_either_may_stand_still_and_neither_has_missed_anything(loop, kind):
    with alive() as stage:
        driven(stage)
        stage.move_to(*stage.description["middle_m"])
        before = stage.next_status()
        errors_nm: list[float] = []
        pid = process_of(kind)
        stops = threading.Thread(target=lambda: [stopped(pid, seconds) for seconds in 5 * STOPS_S])
        stage.follow("raster", wait=False)
        stops.start()
        while stops.is_alive():
            status = stage.next_status()
            error_m = np.abs(status.position_m - status.setpoint_m).max()
            errors_nm.append(1e9 * error_m if status.driven else np.inf)
        stops.join()
        after = stage.next_status()
        assert after.last_fault == before.last_fault == ""
        assert after.missed_ticks == before.missed_ticks
        assert max(errors_nm) < 30  # of a raster that nobody holds up: about 10, with noise
        assert after.stood_still_s - before.stood_still_s > 0.8 * 5 * sum(STOPS_S)
        stage.stop()


def test_what_is_waited_for_is_what_the_docs_say():
    assert STANDSTILL_US == 100_000 > 2e6 * max(STOPS_S)  # 0.1 s


def test_a_plant_that_stays_away_is_a_fault_and_the_loop_goes_on_in_real_time(loop):
    with alive() as stage:
        driven(stage)
        stopped(process_of("plant"), 1.0)
        end_s = time.monotonic() + 20
        while not (status := stage.next_status()).last_fault and time.monotonic() < end_s:
            pass
        assert status.last_fault
        assert not status.driven
        stage.clear()
        driven(stage)
        assert stage.move_to(x=0.5e-6).state == "done"

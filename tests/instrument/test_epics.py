"""``pkxyz ioc`` with the clients that laboratories have: caproto's own, ophyd, ophyd-async, bluesky; loopback only."""

import asyncio
import itertools
import os
import time
from collections.abc import Iterator

import numpy as np
import pytest
from bluesky import RunEngine
from bluesky import plan_stubs as bps
from bluesky import plans as bp
from bluesky.utils import FailedStatus
from caproto import ErrorResponseReceived
from caproto.sync.client import read, write
from command_line import STARTS_S, alive, beside_a_stage
from ophyd import EpicsMotor
from ophyd.utils import LimitError
from ophyd_async.core import init_devices
from ophyd_async.epics.motor import Motor, MotorLimitsError

from pkxyz_ctrl.client.plain import Stage
from pkxyz_ctrl.instrument.motor_record import FIELDS

pytestmark = pytest.mark.at_rate

PORT = int(os.environ["EPICS_CA_SERVER_PORT"])


@pytest.fixture(scope="module")
def ioc(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """In the middle of the workspace; control is the IOC's."""
    with beside_a_stage(tmp_path_factory.mktemp("ioc"), "ioc", "--port", str(PORT)) as said:
        assert said == f"pkxyz:x, pkxyz:y, pkxyz:z at 127.0.0.1:{PORT}"
        yield


@pytest.fixture
def looker(ioc: None) -> Iterator[Stage]:
    """One that looks on past EPICS."""
    with alive(control=False) as stage:
        yield stage


@pytest.fixture(scope="module")
def motors(ioc: None) -> tuple[EpicsMotor, EpicsMotor]:
    found = EpicsMotor("pkxyz:x", name="x"), EpicsMotor("pkxyz:y", name="y")
    for motor in found:
        motor.wait_for_connection(timeout=STARTS_S)
    return found


@pytest.fixture(scope="module")
def run_engine() -> RunEngine:
    return RunEngine({}, context_managers=[])


def test_every_field_is_there_and_says_what_is_so(looker):
    values = {field: read(f"pkxyz:z.{field}", data_type="control") for field in FIELDS}
    assert values["VAL"].data[0] == pytest.approx(18.0)
    assert values["RBV"].data[0] == pytest.approx(18.0, abs=0.05)
    for field in ("VAL", "RBV"):
        metadata = values[field].metadata
        assert metadata.units == b"um"
        assert metadata.precision == 4
        low, high = looker.status.range_m[2] * 1e6
        assert metadata.lower_ctrl_limit == pytest.approx(low, abs=1e-4) == values["LLM"].data[0]
        assert metadata.upper_ctrl_limit == pytest.approx(high, abs=1e-4) == values["HLM"].data[0]
    assert values["VELO"].metadata.units == b"um/s"
    assert values["VELO"].data[0] == pytest.approx(500.0)
    assert values["EGU"].data[0] == b"um"
    assert values["DMOV"].data[0] == 1
    assert read("pkxyz:state").data[0] == b"holding"


def test_it_listens_on_loopback_alone(ioc):
    with open("/proc/net/tcp", encoding="ascii") as tcp, open("/proc/net/udp", encoding="ascii") as udp:
        ours = [line.split()[1] for line in (*tcp, *udp) if f":{PORT:04X} " in line[:30]]
    assert len(ours) >= 2
    assert {address.partition(":")[0] for address in ours} == {"0100007F"}


def test_a_put_is_done_when_the_stage_is_in_position(looker):
    for target in (1.5, 0.0):
        write("pkxyz:x", [target], notify=True, timeout=20)
        assert read("pkxyz:x.RBV").data[0] == pytest.approx(target, abs=0.05)
        assert read("pkxyz:x.DMOV").data[0] == 1


def test_what_the_combs_cannot_hold_is_refused_and_nothing_moves(looker):
    with pytest.raises(ErrorResponseReceived, match=r"RefusedError .*x = 50 um is asked for, limits -13\.51 to 13\.51"):
        write("pkxyz:x", [50.0], notify=True, timeout=20)
    assert read("pkxyz:x.LVIO").data[0] == 1
    assert read("pkxyz:x", data_type="control").data[0] == pytest.approx(0.0)
    assert looker.status.target_m[0] == 0.0
    write("pkxyz:x", [0.0], notify=True, timeout=20)
    assert read("pkxyz:x.LVIO").data[0] == 0


def test_ophyd_moves_and_knows_the_limits(motors, looker):
    x, _ = motors
    assert x.egu == "um"
    assert x.precision == 4
    assert x.limits == pytest.approx((-13.51, 13.51), abs=0.01)
    edges: list[int] = []
    x.motor_done_move.subscribe(lambda value, **_: edges.append(value), run=False)
    assert x.move(2.0, wait=True, timeout=20).success
    assert x.position == pytest.approx(2.0, abs=0.05)
    assert x.move(2.0, wait=True, timeout=20).success  # of zero length
    assert [int(value) for value, _ in itertools.groupby(edges)] == [0, 1, 0, 1], edges
    with pytest.raises(LimitError):
        x.move(50.0)
    x.move(0.0, wait=True, timeout=20)


def test_ophyd_stops_in_flight(motors, looker):
    x, _ = motors
    x.velocity.put(20.0, wait=True)
    try:
        moving = x.move(8.0, wait=False)
        _until(lambda: x.position > 0.5)
        x.stop()
        _until(lambda: moving.done and x.motor_done_move.get(use_monitor=False) == 1)
        stands = looker.next_status().target_m[0] * 1e6
        assert 0.5 < stands < 7.0
        assert x.user_setpoint.get(use_monitor=False) == pytest.approx(stands, abs=1e-6)
        assert x.user_readback.alarm_severity == 0
    finally:
        x.velocity.put(500.0, wait=True)
    assert x.move(0.0, wait=True, timeout=20).success


def test_user_coordinates_are_shifted_by_set(motors, looker):
    x, _ = motors
    x.set_current_position(100.0)
    _until(lambda: x.limits == pytest.approx((86.49, 113.51), abs=0.01))
    assert x.position == pytest.approx(100.0, abs=0.05)
    assert looker.next_status().target_m[0] == 0.0
    assert x.move(101.0, wait=True, timeout=20).success
    assert looker.next_status().target_m[0] * 1e6 == pytest.approx(1.0, abs=0.05)
    x.user_offset.put(0.0, wait=True)
    _until(lambda: x.limits == pytest.approx((-13.51, 13.51), abs=0.1))
    x.move(0.0, wait=True, timeout=20)


def test_bluesky_scans_a_grid(motors, run_engine):
    x, y = motors
    read_at: list[tuple[float, float]] = []

    def note(kind: str, document: dict) -> None:
        if kind == "event":
            read_at.append((document["data"]["x"], document["data"]["y"]))

    run_engine(bp.grid_scan([], y, -1, 1, 2, x, -1, 1, 3, True), note)
    wanted = [(-1, -1), (0, -1), (1, -1), (1, 1), (0, 1), (-1, 1)]
    assert np.allclose(read_at, wanted, atol=0.05)


def test_a_scan_that_leaves_the_limits_fails(motors, run_engine):
    with pytest.raises((LimitError, FailedStatus)):
        run_engine(bp.scan([], motors[0], 0, 60, 2))


def test_ophyd_async_moves_is_refused_and_stops(ioc, run_engine):
    with init_devices(timeout=20.0):
        z = Motor("pkxyz:z", name="z")

    def plan():
        yield from bps.abs_set(z, 19.0, wait=True)
        assert (yield from bps.rd(z)) == pytest.approx(19.0, abs=0.05)
        yield from bps.abs_set(z, 19.0, wait=True)
        with pytest.raises(FailedStatus) as refused:
            yield from bps.abs_set(z, 500.0, wait=True)
        assert isinstance(refused.value.__cause__ or refused.value.args[0].exception(), MotorLimitsError)
        yield from bps.abs_set(z.velocity, 10.0, wait=True)
        yield from bps.abs_set(z, 14.0, group="going")
        while (yield from bps.rd(z)) > 18.5:
            yield from bps.sleep(0.05)
        yield from bps.stop(z)
        with pytest.raises(FailedStatus):
            yield from bps.wait("going", timeout=20)
        assert 14.5 < (yield from bps.rd(z)) < 18.6
        yield from bps.abs_set(z.velocity, 500.0, wait=True)
        yield from bps.abs_set(z, 18.0, wait=True)

    run_engine(plan())


def test_verbs_and_control(looker):
    with alive(control=False) as other, pytest.raises(Exception, match="another client has control"):
        other.take_control()
    write("pkxyz:control", [0], notify=True)
    with alive() as other:
        other.move_to(x=0.0)
        with pytest.raises(ErrorResponseReceived, match="another client has control"):
            write("pkxyz:x", [1.0], notify=True, timeout=20)
    write("pkxyz:park", [1], notify=True, timeout=20)
    _until(lambda: looker.status.activity == "off")
    with pytest.raises(ErrorResponseReceived, match="home, then enable"):
        write("pkxyz:x", [1.0], notify=True, timeout=20)


def _until(is_so) -> None:
    end_s = time.monotonic() + 20
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_nobody_asks_outside_of_this_machine():
    assert asyncio.run(_addresses()) == {"127.0.0.1"}


async def _addresses() -> set[str]:
    from caproto import get_address_list, get_beacon_address_list

    from pkxyz_ctrl.instrument.ioc import listen_at

    before = dict(os.environ)
    try:
        listen_at("127.0.0.1", PORT)
        return {host for host, _ in get_beacon_address_list()} | set(get_address_list())
    finally:
        os.environ.clear()
        os.environ.update(before)

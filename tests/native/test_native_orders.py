"""The C that takes orders and sheets, and the Python that makes them, tick by tick, the session as late as it may be:
no row that the law has seen ever becomes another one, and no set-point jumps.
"""

import ctypes
import dataclasses
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.native.mapped import Mapped
from hil.native.program import FLAGS, compiler
from hil.native.teller import Teller
from hil.operate.running.ordered import Ordered
from hil.operate.running.sheets import Sheets
from hil.operate.setpoints import planned_rows_of, rows_of
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.export.folder import LOOP_SOURCES
from pkxyz_ctrl.export.shared import LoopEnd
from pkxyz_ctrl.export.structs import loop_header
from pkxyz_ctrl.loop import controller
from pkxyz_ctrl.loop.reference import REFERENCE
from pkxyz_ctrl.safety.modes import Event, Mode
from pkxyz_ctrl.trajectory.segments import Limits

HERE = Path(__file__).parent
LIMITS = Limits(0.5e-3, 0.5, 300.0)
PERIOD_S = 200e-6
BLIND_TICKS = 3000


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    if (cc := compiler()) is None:
        pytest.skip("no C compiler")
    folder = tmp_path_factory.mktemp("orders")
    (folder / "pkxyz.h").write_text(loop_header(), encoding="utf-8")
    sources = [str(LOOP_SOURCES / "orders.c"), str(HERE / "orders_alone.c")]
    words = [cc, *FLAGS, "-shared", "-fPIC", "-I", str(folder), "-I", str(LOOP_SOURCES), *sources]
    subprocess.run([*words, "-o", str(folder / "orders.so")], check=True)
    return ctypes.CDLL(str(folder / "orders.so"))


@pytest.fixture(scope="module")
def setup():
    return load_scenario("raster").setup()


class Side:
    """Both sides: the loop's, which looks at rows in each tick as the law does, and the session's, which is late."""

    def __init__(self, library, setup):
        self.library, mapped = library, Mapped(blocks=1)
        self.shared = mapped.shared[0]
        self.ordered = Ordered(setup, self.shared)
        self.ordered.lay_out(self.shared)
        self.shared["settings"]["blind_ticks"] = BLIND_TICKS
        sheets = self.shared["operated"]["sheets"][0]
        law = self.ordered.law
        self.setpoints = Sheets(200, *rows_of(law), sheets, self.ordered.present_row, planned_rows_of(law))
        self.memory = self.shared["memory"]["own"][0, 0]
        self.keep = mapped
        self.delay = rows_of(self.ordered.law)[0]
        self.seen: dict[int, np.ndarray] = {}
        self.played: list[np.ndarray] = []
        self.refused = 0
        library.alone_begin(ctypes.c_void_p(mapped.shared.ctypes.data))
        self.ordered.hand_in(self.setpoints)
        self.ordered.request(Event.TRACK)
        library.alone_mode(int(Mode.ENABLED))
        self.tick()
        library.alone_mode(int(Mode.TRACKING))

    def tick(self):
        """The loop's: take what was ordered, look at the rows, leave a snapshot."""
        rows, count = ctypes.c_void_p(), ctypes.c_int32()
        self.library.orders_take(ctypes.byref(rows), ctypes.byref(count))
        cycle = self.memory["cycle"][0]
        at = int(cycle["reference_tick"])
        buffer = (ctypes.c_char * (count.value * REFERENCE.itemsize)).from_address(rows.value)
        table = np.frombuffer(buffer, REFERENCE)
        for row in range(at, at + self.delay + 3):
            index = min(max(row - int(table["tick"][0]), 0), len(table) - 1)
            motion = table["motion"][index].copy()
            before = self.seen.setdefault(row, motion)
            assert np.array_equal(before, motion), f"row {row}, seen before, is another one in tick {at}"
        self.played.append(self.seen[at][0:3])
        cycle["reference_tick"] += 1
        cycle["tick_index"] += 1
        self.memory["begun_us"] += 200
        self.library.orders_leave()

    def step(self, late, asked):
        """The session's: look, and decide while ``late`` ticks pass; whether it could."""
        is_new, setpoints = self.ordered.look(), self.setpoints
        was = self.ordered._obeyed["refusals"].item() if self.ordered.seen else 0
        decides = is_new and self.ordered.answered(setpoints)
        self.refused = max(self.refused, was)
        if decides:
            setpoints.advance(int(self.ordered.memory["reference_tick"][0]))
            asked(setpoints)
        for _ in range(late):
            self.tick()
        self.ordered.hand_in(setpoints)
        setpoints.extend()
        return decides


def require_smooth(played):
    """Velocity, acceleration and jerk of what was played."""
    for order, most in zip((1, 2, 3), LIMITS, strict=True):
        assert np.abs(np.diff(np.array(played), order, axis=0)).max() / PERIOD_S**order <= most * 1.001, order


def fine(rows, periods):
    return None


def slowly(side, ticks):
    """A judge who takes so many ticks."""

    def judge(rows, periods):
        for _ in range(ticks):
            side.tick()

    return judge


step = st.tuples(
    st.integers(1, 12),  # ticks between two steps
    st.sampled_from([0, 0, 0, 0, 1, 1, 2, 3, 5, 9, 20, 60]),  # ticks that pass while it decides
    st.sampled_from(["nothing", "nothing", "nothing", "go", "go", "brake", "stop", "on"]),
    st.floats(-3e-6, 3e-6),
)


@settings(max_examples=25, deadline=None)
@given(schedule=st.lists(step, min_size=5, max_size=60))
def test_whatever_is_asked_and_however_late_no_set_point_jumps(library, setup, schedule):
    side = Side(library, setup)
    for between, late, what, where in schedule:

        def asked(setpoints, what=what, where=where, late=late):
            if what == "go":
                setpoints.go(np.array([where, -where, 2e-6]), LIMITS, slowly(side, late // 2))
            elif what == "brake":
                setpoints.brake(LIMITS)
            elif what == "stop":
                setpoints.stop_on_path()
            elif what == "on" and setpoints.is_stopping:
                setpoints.go_on()

        side.step(late, asked)
        for _ in range(between):
            side.tick()
    assert side.library.alone_asked() == 0
    speed = np.abs(np.diff(np.array(side.played), axis=0)).max() / PERIOD_S
    assert speed <= LIMITS.velocity_m_per_s * 1.05  # a path that stops and starts may be a little beyond its limits


def test_a_sheet_that_is_late_is_refused_and_made_again_from_the_free_row(library, setup):
    side = Side(library, setup)
    target = np.array([2e-6, 0.0, 1e-6])
    side.step(0, lambda setpoints: setpoints.go(target, LIMITS, fine))
    for _ in range(5):
        side.tick()
        side.step(0, lambda setpoints: None)
    back = -target
    side.tick()
    assert side.step(7, lambda setpoints: setpoints.go(back, LIMITS, fine))  # in flight, and seven ticks too late
    side.tick()
    assert not side.step(0, lambda setpoints: None), "nothing else is decided before it is done again"
    assert side.ordered._obeyed["refusals"] == 1
    for _ in range(400):
        side.tick()
        side.step(0, lambda setpoints: None)
    assert side.ordered._obeyed["refusals"] == 1
    assert np.allclose(side.played[-1], back, rtol=0, atol=1e-15)
    assert np.array(side.played)[:, 0].max() > 1e-9  # it had set out
    require_smooth(side.played)


@pytest.mark.parametrize("ticks", [1, 7, 40, 300, 1100])
def test_a_motion_from_rest_begins_as_soon_as_it_is_planned_however_long_that_took(library, setup, ticks):
    side, target = Side(library, setup), np.array([2e-6, 0.0, 1e-6])
    side.step(0, lambda setpoints: None)
    side.tick()
    assert side.step(0, lambda setpoints: setpoints.go(target, LIMITS, slowly(side, ticks)))
    begun = len(side.played)
    for _ in range(400):
        side.tick()
        side.step(0, lambda setpoints: None)
    assert side.ordered._obeyed["refusals"] == 0
    moved = np.flatnonzero(np.diff(np.array(side.played), axis=0).any(axis=1))
    assert begun <= moved[0] <= begun + side.delay + 3  # behind what the law has seen
    assert np.allclose(side.played[-1], target, rtol=0, atol=1e-15)
    require_smooth(side.played)


def test_what_cannot_be_done_again_is_told_and_what_was_asked_before_goes_on(library, setup):
    side, target = Side(library, setup), np.array([2e-6, 0.0, 1e-6])
    side.step(0, lambda setpoints: setpoints.go(target, LIMITS, fine))
    side.tick()
    answers = iter([None, "comb 2 would have to push"])
    side.step(9, lambda setpoints: setpoints.go(-target, LIMITS, lambda rows, periods: next(answers)))
    for _ in range(400):
        side.tick()
        side.step(0, lambda setpoints: None)
    assert side.setpoints.objection == "comb 2 would have to push"
    assert np.allclose(side.played[-1], target, rtol=0, atol=1e-15)


def test_rows_that_end_while_the_set_point_moves_lead_the_stage_down_and_not_while_it_stands(library, setup):
    side, target = Side(library, setup), np.array([9e-6, 0.0, 1e-6])
    for _ in range(2000):
        side.tick()
    assert side.library.alone_asked() == 0
    side.step(0, lambda setpoints: None)
    side.tick()
    assert side.step(0, lambda setpoints: setpoints.go(target, Limits(50e-6, 0.5, 300.0), fine))
    before = len(side.played)
    for _ in range(400):
        side.tick()
        if side.library.alone_asked():
            break
    assert side.library.alone_asked() == LoopEnd.SET_POINTS_LATE
    assert side.library.alone_requested() == Event.DISABLE
    assert len(side.played) - before > 0.025 / PERIOD_S


@pytest.mark.parametrize("horizon", [10, 20])
def test_a_law_that_plans_finds_all_rows_to_its_horizon_or_is_led_down(library, horizon):
    setup = load_scenario("raster", controller="mpc").setup()
    longer = setup.controller.mpc.model_copy(update={"horizon": horizon})
    setup = dataclasses.replace(setup, controller=setup.controller.model_copy(update={"mpc": longer}))
    side = Side(library, setup)
    side.step(0, lambda setpoints: None)
    side.tick()
    ordered, setpoints = side.ordered, side.setpoints
    assert ordered.look()
    assert ordered.answered(setpoints)
    setpoints.advance(int(ordered.memory["reference_tick"][0]))
    setpoints.go(np.array([9e-6, 0.0, 1e-6]), Limits(50e-6, 0.5, 300.0), fine)
    ordered.hand_in(setpoints)
    side.tick()  # before more rows are made
    assert library.alone_asked() == 0
    setpoints.extend()
    while not library.alone_asked():
        side.tick()
    assert library.alone_asked() == LoopEnd.SET_POINTS_LATE
    (page,) = [page for page in side.shared["operated"]["sheets"][0] if page["first"] > 0]
    furthest = int(side.memory["cycle"]["reference_tick"][0]) - 1 + side.delay + horizon + 1  # of the tick that is over
    assert furthest == page["first"] + page["count"]  # the first row that is not there


def test_a_session_that_looks_at_nothing_for_too_long_has_the_stage_led_down_and_the_last_tick_before_not(
    library, setup
):
    side = Side(library, setup)
    side.step(0, lambda setpoints: None)
    for _ in range(BLIND_TICKS + 1):
        side.tick()
        assert side.library.alone_asked() == 0
    side.tick()
    assert side.library.alone_asked() == LoopEnd.SESSION_GONE


def test_a_stage_without_voltage_waits_for_a_session_as_long_as_it_takes(library, setup):
    side = Side(library, setup)
    library.alone_mode(int(Mode.IDLE))
    for _ in range(BLIND_TICKS + 10):
        side.tick()
    assert side.library.alone_asked() == 0


def test_beside_hardware_no_tick_waits_for_the_session(library, setup):
    side = Side(library, setup)
    side.tick()
    assert library.alone_awaited(3) == 0


def test_in_simulation_time_stands_still_until_the_session_has_looked_and_not_for_one_that_stays_away(library, setup):
    side = Side(library, setup)
    side.shared["settings"]["standstill_us"] = 1000
    assert library.alone_awaited(7) == 7
    assert library.alone_awaited(1) == 0  # it has looked
    side.tick()
    assert library.alone_awaited(0) == 20  # for 1000 us, 50 at once
    side.tick()
    assert library.alone_awaited(5) == 0  # once
    side.step(0, lambda setpoints: None)
    assert library.alone_awaited(5) == 0  # it is back, so ...
    side.tick()
    assert library.alone_awaited(5) == 5


def test_who_only_tells_what_a_loop_did_loads_no_kernel_to_run_one(setup, monkeypatch):
    """A fifth of a second of each start."""
    monkeypatch.setattr(controller, "direct", lambda kernel, *examples: pytest.fail(f"loads {kernel.__name__}"))
    assert Teller(setup).mode == Mode.BOOT

"""A session beside the loop in C, each a process at rate: whatever is asked, and whichever of the two stands still or
is killed. Nothing is asserted about the machine.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from beside_native import WORDS, operating, require_no_jump
from operated_rig import raster_rows
from patience import patient_law
from two_processes import DRIVE, EMCY, ROOT, assert_missed_by_the_node, bench, changes, next_with

from hil.bus.unix_bus import UnixBus
from hil.native.program import compiled, compiler
from hil.native.settings import BLIND_S
from hil.operate.commands import Activity, State, Verb
from hil.operate.law_change import OFFER
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.client import place
from pkxyz_ctrl.compiled.kernel_cache import choose_kernel_cache
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.law_store import law_of
from pkxyz_ctrl.safety.modes import Mode

pytestmark = [
    pytest.mark.at_rate,
    pytest.mark.timeout(300),  # who waits for a line of the plant waits for ever
    pytest.mark.skipif(compiler() is None, reason="no C compiler"),
]

__all__ = ["bench", "changes"]

NAN = np.nan
SPEED = 0.5e-3


@pytest.fixture(scope="module", autouse=True)
def program():
    choose_kernel_cache()
    return compiled()


@contextlib.contextmanager
def holding(bench, changes, *words):
    """An operator of a stage that is switched on."""
    changes("pre-operational", False)
    with operating(bench, *words) as operator:
        operator.switched_on()
        yield operator


@contextlib.contextmanager
def scanning(bench, changes):
    """An operator of a stage that is under way on a path, and the path's command."""
    path, start = raster_rows(1000)
    with holding(bench, changes) as operator:
        yield operator, operator.follow(1, path, start)


def offer(operator, bench, name):
    """Another law that forgives a machine which stands still; its number."""
    setup = load_scenario(bench / "on_slow.toml").setup()
    (folder := bench / name).mkdir(exist_ok=True)
    controller = load("controllers", str(patient_law(folder, name)), ControllerConfig)
    offered = np.zeros(1, OFFER)
    offered["number"], offered["name"] = 7, name.encode()
    offered["law"] = law_of(setup.stage, controller, setup.bus, autostart=False)
    operator.link.offer(offered.view(np.uint8).data)
    return 7


def test_everything_that_may_be_asked(bench, changes):
    path, start = raster_rows(1000)
    with holding(bench, changes) as operator:
        first = operator.give(Verb.MOVE, target_m=(4e-6, NAN, NAN))
        time.sleep(0.01)
        assert "in position at (-3, 2, 18) um" in operator.do(Verb.MOVE, target_m=(-3e-6, 2e-6, NAN))
        assert operator.answers[first][0] in (State.ABORTED, State.DONE)
        scan = operator.follow(1, path, start)
        time.sleep(0.05)
        assert "stands on its path" in operator.do(Verb.PAUSE)
        assert operator.state["activity"] == Activity.PAUSED
        operator.do(Verb.RESUME)
        assert operator.ended(scan) == (State.DONE, f"the path has been followed to its end, {len(path)} set-points")
        jog = operator.give(Verb.JOG, target_m=(1.0, 0.0, 0.0), velocity_m_per_s=10e-6)
        state, words = operator.ended(jog)
        assert state is State.DONE
        assert "the lease was not renewed" in words
        for name in ("youla", "lqg"):
            assert operator.do(Verb.LAW, law=offer(operator, bench, name)) == f"the law is {name}"
        operator.do(Verb.QUIET, on=1)
        operator.do(Verb.SETTLE, window_m=50e-9, dwell_s=0.003, sigmas=2.0)
        operator.do(Verb.TRIGGER, axis=0, first_m=0.0, pitch_m=1e-7, count=3, direction=0)
        operator.do(Verb.AUTO_ZERO)
        operator.do(Verb.RELEASE)
        operator.until(Activity.FAULT)
        assert operator.state["activity"] == Activity.FAULT
        operator.do(Verb.CLEAR)
        operator.switched_on()
        operator.do(Verb.PARK)
        time.sleep(0.1)
        rows = operator.rows
    require_no_jump(rows, SPEED)
    assert (np.diff(rows["tick"]) == 1).all()
    assert {int(mode) for mode in rows["mode"]} >= {Mode.HOMING, Mode.TRACKING, Mode.LANDING, Mode.FAULT}
    assert rows["quiet"].any()
    assert not rows["voltage_v"][-1].any()


def test_a_stage_by_the_law_that_plans_follows_a_path_and_keeps_its_law(bench, changes):
    path, start = raster_rows(1000)
    (folder := bench / "mpc").mkdir(exist_ok=True)
    with holding(bench, changes, "--native", "--controller", str(patient_law(folder, "mpc"))) as operator:
        scan = operator.follow(1, path, start)
        assert operator.ended(scan)[0] is State.DONE
        state, words = operator.ended(operator.give(Verb.LAW, law=offer(operator, bench, "lqg")))
        assert state is State.REFUSED
        assert "plans beside the tick" in words
        rows = operator.rows
    require_no_jump(rows, SPEED)
    begun = int(np.argmax(rows["mode"] == Mode.TRACKING))
    assert (rows["mode"][begun:] == Mode.TRACKING).all()
    assert not rows["trips"].any()


def test_a_session_that_stands_still_for_20_ms_in_a_scan_is_not_noticed(bench, changes):
    with scanning(bench, changes) as (operator, scan):
        for _ in range(3):
            os.kill(operator.session, signal.SIGSTOP)
            time.sleep(0.02)
            os.kill(operator.session, signal.SIGCONT)
            time.sleep(0.03)
        assert operator.ended(scan)[0] is State.DONE
        time.sleep(0.1)
        rows = operator.rows
    assert (np.diff(rows["tick"]) == 1).all()
    begun = int(np.argmax(rows["mode"] == Mode.TRACKING))
    assert (rows["mode"][begun:] == Mode.TRACKING).all()
    require_no_jump(rows, SPEED)


def test_a_session_that_stands_still_for_longer_than_the_set_points_reach(bench, changes):
    """Then the stage is led down, and the session says so once it goes on."""
    with scanning(bench, changes) as (operator, _):
        os.kill(operator.session, signal.SIGSTOP)
        lines = changes("pre-operational", False)
        assert lines[-2]["driven"]
        os.kill(operator.session, signal.SIGCONT)
        _, err = operator.run.communicate(timeout=30)
        assert operator.run.returncode == 1
        assert "pkxyz: the set-points were not made in time, so the stage was led down; free the machine" in err


def test_a_session_that_stands_still_while_the_stage_holds_is_not_noticed(bench, changes):
    with holding(bench, changes) as operator:
        os.kill(operator.session, signal.SIGSTOP)
        time.sleep(0.6)
        os.kill(operator.session, signal.SIGCONT)
        operator.do(Verb.MOVE, target_m=(1e-6, NAN, NAN))
        time.sleep(0.1)
        rows = operator.rows
    assert (np.diff(rows["tick"]) == 1).all()
    require_no_jump(rows, SPEED)


def test_a_session_that_stands_still_for_good_does_not_leave_a_stage_that_nobody_can_stop(bench, changes):
    with holding(bench, changes) as operator:
        os.kill(operator.session, signal.SIGSTOP)
        begin_s = time.monotonic()
        assert changes("pre-operational", False)[-2]["driven"]
        assert time.monotonic() - begin_s > 0.9 * BLIND_S
        os.kill(operator.session, signal.SIGCONT)
        _, err = operator.run.communicate(timeout=30)
        assert operator.run.returncode == 1
        assert "pkxyz: nobody looked after the stage, so it was led down" in err


def test_a_session_that_is_killed_leaves_a_stage_that_is_led_down(bench, changes):
    with scanning(bench, changes) as (operator, _):
        with UnixBus(f"{bench}/bus") as observer:
            loop = operator.loop
            next_with(observer, DRIVE)
            os.kill(operator.session, signal.SIGKILL)
            seen, end_s = [], time.monotonic() + 20
            is_there = True
            while is_there and time.monotonic() < end_s:
                is_there = place._is_alive(loop)  # before what it left is taken
                message = observer.recv(0.05)
                while message is not None:
                    seen.append(message)
                    message = observer.recv(0)
        assert changes("pre-operational", False)[-2]["driven"]
    assert not any(message.arbitration_id == EMCY and any(message.data) for message in seen)
    most = [max(np.frombuffer(m.data[:6], "<i2").tolist()) for m in seen if m.arbitration_id == DRIVE]
    last = max(n for n, count in enumerate(most) if count)
    assert most[-1] == 0
    assert most[last] < 0.4 * max(most)


def test_a_loop_that_is_killed_is_missed_by_the_node_and_told(bench, changes):
    with holding(bench, changes, "--bus", "quick.toml", "--native") as operator, UnixBus(f"{bench}/bus") as observer:
        while next_with(observer, DRIVE).timestamp < time.time() - 0.1:  # what went before
            pass
        os.kill(operator.loop, signal.SIGKILL)
        assert_missed_by_the_node(observer, time.time())
        _, err = operator.run.communicate(timeout=30)
        assert operator.run.returncode == 1
        assert "the native loop was killed by signal 9; the node takes the combs to 0 V by itself" in err
        changes("pre-operational", False)


def test_a_server_that_falls_silent_in_a_scan_leaves_a_stage_that_stops_on_its_path(bench, changes):
    with scanning(bench, changes) as (operator, scan):
        operator.is_silent = True
        assert operator.ended(scan) == (State.ABORTED, "the server has fallen silent")
        operator.until(Activity.HOLDING)
        time.sleep(0.1)
        rows = operator.rows
    require_no_jump(rows, SPEED)
    assert (rows["mode"][-50:] == Mode.TRACKING).all()
    assert (rows["reference_m"][-20:] == rows["reference_m"][-1]).all()


def said_by(bench, *words, **environment):
    """Lines of ``pkxyz operate`` that nobody's amplifier answers, and its exit code."""
    command = [sys.executable, "-m", "hil.cli", *WORDS, *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": str(bench), **environment}
    run = subprocess.Popen(command, cwd=bench, env=environment, text=True, stderr=subprocess.PIPE)
    assert run.stderr is not None
    lines = []
    for line in run.stderr:
        lines.append(line.rstrip("\n"))
        if line.startswith(("the loop is ", "real time")):
            run.terminate()
            break
    run.communicate(timeout=600)  # what is being compiled is compiled to its end
    return lines, run.returncode


def test_a_line_says_which_loop_it_is_and_native_alone_refuses(bench, changes):
    changes("pre-operational", False)
    for law in ("patient.toml", "mpc"):
        assert said_by(bench, "--controller", law)[0][-1] == "the loop is the native one, in C"
    slow = (bench / "slow.toml").read_text(encoding="utf-8")
    loud = slow.replace("[can.driver]", "[can.options]\nreceive_own_messages = true\n[can.driver]")
    (bench / "loud.toml").write_text(loud, encoding="utf-8")
    lines, code = said_by(bench, "--native", "--bus", "loud.toml")
    assert code == 2
    assert lines[-1].startswith("pkxyz: ")
    lines, _ = said_by(bench, "--bus", "loud.toml")
    assert lines[-1].startswith("the loop is Python's, as the native one can't be had: ")
    lines, _ = said_by(bench, CC="no-such-compiler")
    assert lines[-1].startswith("the loop is Python's; `--native` compiles the one in C")
    lines, code = said_by(bench, "--native", CC="no-such-compiler")
    assert code == 2
    assert "no-such-compiler is not on the PATH" in lines[-1]

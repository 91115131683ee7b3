"""What no voltage waits for: done behind the drive frame or at the beginning of the next period, it is the same."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from hil.lanes import in_process
from hil.lanes.blocks import Blocks
from hil.lanes.lane import Lane
from hil.lanes.lockstep import LockstepRig
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.core import adaptation
from pkxyz_ctrl.core.linear_law import ORDER_MAX
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.loop.law_change import change_to, take_over
from pkxyz_ctrl.loop.period import period_of
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.safety.modes import Mode

TICKS = 1500
ASKED = {"sense_status": "sense_status", "event": "request", "sense_count": "sense_count"}


class Played:
    """A controller's cycle over what a stage showed it, one tick after the other."""

    def __init__(self, law: str, plant: str = "mild") -> None:
        setup, rows = shown(law, plant)
        self.law, self.memory, self.rows = setup.law.copy(), cycling.new_memory(Mode.IDLE), rows
        self.reference = reference_rows(setup.trajectory.sample(0, TICKS + 8, 200), 0)
        self._cycle = period_of(self.law, self.reference)
        self.done, self.obeys = 0, True

    @property
    def expected(self) -> NDArray[np.float64]:
        """(9,) of the next sample."""
        return self.memory["tick"]["estimate"]["predicted"][0].copy()

    def go_on(self, count: int, prepares: str) -> list[bytes]:
        """The rows of so many ticks; ``prepares``: "at once" behind each, "sometimes", or "never"."""
        found = []
        for k in range(self.done, self.done + count):
            for name, recorded in ASKED.items():
                self.memory["input"][name] = self.rows[recorded][k]
            self._cycle(self.law, self.memory, self.reference)
            found.append(self.memory["row"].tobytes())
            if not self.obeys:  # but the voltages that the stage had
                self.memory["tick"]["count"][0, 0] = self.rows["drive_count"][k]
            if prepares == "at once" or (prepares == "sometimes" and k % 7 < 3):
                cycling.prepare(self.law, self.memory)
        self.done += count
        return found


@cache
def shown(law: str, plant: str):
    """A run of 1500 ticks, homing and the first lines of a raster, with its rows."""
    setup = load_scenario("raster", controller=law, plant=plant).setup()
    blocks = []
    in_process.run(setup, Lane.FAST, on_block=lambda rows: blocks.append(rows.copy()))
    return setup, np.concatenate(blocks)


@pytest.mark.parametrize("law", ["youla", "lqg", "irc", "open_loop", "mpc"])
def test_when_it_is_done_changes_no_bit_of_rows_and_memory(law):
    players = [Played(law) for _ in range(3)]
    rows = [p.go_on(TICKS, how) for p, how in zip(players, ("never", "sometimes", "at once"), strict=True)]
    assert rows[0] == rows[1] == rows[2]
    for player in players:
        cycling.prepare(player.law, player.memory)
    assert players[0].memory.tobytes() == players[1].memory.tobytes() == players[2].memory.tobytes()
    assert int(players[0].memory["mode"][0]) == Mode.TRACKING


def test_once_it_is_done_it_does_nothing():
    player = Played("youla")
    player.go_on(TICKS, "never")
    before = player.memory.tobytes()
    cycling.prepare(player.law, player.memory)
    after = player.memory.tobytes()
    cycling.prepare(player.law, player.memory)
    assert before != after == player.memory.tobytes()


def test_a_release_to_0_v_leaves_nothing_to_follow():
    """The model of the set-points stands at rest then, and must not be led away by forces that are taken back."""
    player = Played("youla")
    player.go_on(1000, "at once")
    player.memory["input"]["trips"] = 1 << 5
    player.go_on(1, "never")
    assert int(player.memory["mode"][0]) == Mode.FAULT
    state = player.memory["tick"]["set_point_model"]["state"].copy()
    assert not player.memory["tick"]["to_follow"][0]
    cycling.prepare(player.law, player.memory)
    assert np.array_equal(player.memory["tick"]["set_point_model"]["state"], state)


def test_a_law_that_takes_over_finds_the_last_period_done():
    """Done by the old law's numbers, before the memory is moved: whether somebody did it before or not."""
    late, early = Played("youla"), Played("youla")
    new = load_scenario("raster", controller="lqg").setup().law
    for player in (late, early):
        player.go_on(1200, "at once")
        player.go_on(1, "never")
    cycling.prepare(early.law, early.memory)
    for player in (late, early):
        take_over(player.law, player.memory, change_to(new, np.zeros(ORDER_MAX), adapts_alike=False))
    assert late.memory.tobytes() == early.memory.tobytes()


def test_what_was_learnt_moves_the_prediction_as_if_the_filter_had_always_known():
    """Two filters on one record of samples and voltages, one that knows an error all the time, one that is told of it
    in between: from then on both expect the same.
    """
    player, knowing = Played("youla"), Played("youla")
    theta = np.zeros(adaptation.PARAMETERS)
    theta[adaptation.SLIDER : adaptation.SLIDER + 3], theta[adaptation.DELAY] = 0.5, 1.0
    for each in (player, knowing):
        numbers = each.law["tick"]["adaptation"]
        numbers["least"], numbers["follow"] = np.inf, 1.0  # nothing is learnt by itself, and what is acts at once
        each.obeys = False
    knowing.law["tick"]["adaptation"]["start"] = theta
    for each in (player, knowing):
        each.go_on(1250, "at once")
    before = player.expected - knowing.expected
    player.memory["tick"]["adaptation"]["learnt"][0, : len(theta)] = theta
    for each in (player, knowing):
        each.go_on(1, "at once")
    after = player.expected - knowing.expected
    for part in (slice(0, 3), slice(3, 6), slice(6, 9)):
        assert np.abs(after[part]).max() < 1e-3 * np.abs(before[part]).max()
    assert np.abs(before[6:]).max() > 1e-6  # N: what it did not know was disturbance


def test_the_voltages_of_a_controller_are_out_before_it():
    """In every tick in which the loop is closed, something is owed when the drive frame goes, and nothing behind it."""
    setup = dataclasses.replace(load_scenario("raster").setup(), duration_s=0.1)
    owed: dict[str, list[int]] = {"drive": [], "later": []}

    class Watched(Controller):
        def __init__(self, law, bus, gate, send, *others):
            super().__init__(law, bus, gate, lambda frame: (self.look(frame), send(frame)), *others)

        def look(self, frame):
            if frame.can_id == self.driver.drive_id:
                owed["drive"].append(int(self.memory["tick"]["to_learn"][0]))

        def finish(self, t_us, heartbeat_until_us):
            super().finish(t_us, heartbeat_until_us)
            owed["later"].append(int(self.memory["tick"]["to_learn"][0] + self.memory["tick"]["to_follow"][0]))

    rig = LockstepRig(setup, whole_ticks=False, controller=Watched)
    rig.run(Blocks(setup.trajectory, 200, setup.ticks, lambda rows: None, lambda done, total: None))
    assert len(owed["later"]) > 100
    assert set(owed["drive"][5:]) == {2}
    assert set(owed["later"]) == {0}

"""Which protections an amplifier does not give, and what replaces them, is said as a run begins and in its summary."""

import dataclasses
import threading
from contextlib import suppress

import pytest

from hil.bus.unix_bus import UnixBus
from hil.commands import sil
from hil.lanes.ending import Ended, Ending
from hil.lanes.lane import Lane
from hil.lanes.wall import WallRig
from hil.lanes.wall_plant import WallPlant
from hil.runs.run import run_in_memory
from hil.runs.scenario import load_scenario

pytestmark = pytest.mark.at_rate

LACKS = ["protection = false: no alive counter, no CRC", "no signature of its safety objects"]
_END = 15


class Nobody:
    """Takes what there is to record."""

    def frame(self, frame, t_us):
        pass

    def row(self, row):
        pass


def plain(scenario, **can):
    """On plain PDOs, with a start-up that bears a busy machine."""
    bus = scenario.bus
    patient = {"sdo_timeout_us": 5_000_000, "start_timeout_us": 5_000_000, "node_heartbeat_timeout_ms": 2000}
    driver = bus.can.driver.model_copy(update=patient | {"protection": False, "controller_heartbeat_timeout_ms": 900})
    return dataclasses.replace(
        scenario, bus=bus.model_copy(update={"can": bus.can.model_copy(update=can | {"driver": driver})})
    )


def test_at_rate_it_is_said_once_the_amplifier_is_started(tmp_path):
    setup = plain(load_scenario("raster", bus="unix_1k"), channel=f"{tmp_path}/bus").setup()
    ending, over, said = Ending(), threading.Event(), []

    def leave():
        if over.is_set():
            raise Ended(_END)

    def serve():
        with UnixBus(f"{tmp_path}/bus") as bus, suppress(Ended):
            WallPlant(setup, setup.bus.can, bus, lambda *changes: None).serve(leave)

    amplifier = threading.Thread(target=serve)
    amplifier.start()
    rig = WallRig(setup, Nobody(), ending)
    try:
        while rig.others == 0:
            over.wait(0.01)
        rig.start(said.append)
    finally:
        over.set()
        rig.close()
        amplifier.join()
    assert all(words.startswith("this amplifier lacks a protection: ") for words in said)
    assert [next(lack for lack in LACKS if lack in words) for words in said] == LACKS


def test_in_lockstep_the_summary_says_it_and_the_command_shows_it(tmp_path, capsys):
    scenario = load_scenario("raster")
    scenario.config.__dict__["duration_s"] = 0.1
    for loaded, lacks in ((scenario, []), (plain(scenario), LACKS)):
        summary, _ = run_in_memory(loaded, Lane.LOCKSTEP)
        told = summary.as_json()["protections_lacking"]
        assert [next(lack for lack in LACKS if lack in words) for words in told] == lacks
        sil.show(summary, tmp_path)
        shown = " ".join(capsys.readouterr().out.split())
        assert [lack for lack in LACKS if lack in shown] == lacks

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

SAID = "protection = false: no alive counter, no CRC"
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
    assert [words for words in said if SAID in words] == said
    assert len(said) == 1
    assert said[0].startswith("this amplifier lacks a protection: ")


def test_in_lockstep_the_summary_says_it_and_the_command_shows_it(tmp_path, capsys):
    scenario = load_scenario("raster")
    scenario.config.__dict__["duration_s"] = 0.1
    for loaded, count in ((scenario, 0), (plain(scenario), 1)):
        summary, _ = run_in_memory(loaded, Lane.LOCKSTEP)
        told = summary.as_json()["protections_lacking"]
        assert [SAID in words for words in told] == count * [True]
        sil._show(summary, tmp_path)
        assert (SAID in " ".join(capsys.readouterr().out.split())) == bool(count)

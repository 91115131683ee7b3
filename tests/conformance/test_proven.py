"""A report of check-amplifier on one very module stands for trying that module: passed, whole, unchanged, and of it."""

import dataclasses
import json
from datetime import UTC, datetime
from functools import cache

import pytest
from conformance_defects import StillPlant, WithoutConsumer

import hil.lanes.lockstep as lockstep_lane
from hil.commands import run as run_cli
from hil.commands.operation import operate as operate_cli
from hil.commands.operation import serve as serve_cli
from hil.conformance import report as reports
from hil.conformance.objects import identity_of
from hil.conformance.proven import with_report
from hil.conformance.run import run_all
from hil.conformance.simulated import simulated_talker
from hil.node.amplifier import AmplifierNode
from hil.node.wired import wired_node
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.loop.controller import StartUpError

BUS = load("buses", "fd_5k", BusConfig)
EMCY, HEARTBEAT_ERROR = 0x08A, b"\x30\x81"


@cache
def report_on(node_type, allow_voltage=True):
    """What the command makes of a module."""
    talker = simulated_talker(
        BUS, plant=StillPlant(), node_type=node_type, allow_voltage=allow_voltage, sample_cycles=60
    )
    lines = run_all(talker)
    made = datetime(2026, 11, 22, 13, tzinfo=UTC)
    return reports.as_json(talker, "comb_amplifier.eds", lines, identity_of(talker), made)


def file_of(folder, report):
    path = folder / "conformance.json"
    path.write_text(json.dumps(report, indent=1), encoding="utf-8")
    return path


def started(monkeypatch, bus, node_type=AmplifierNode, serial=1):
    """The rig of a run with a module, once it is started; ``missed``: how often the module missed our heartbeat."""

    def wired(can, clock, send, plant, switch):
        node = wired_node(can, clock, send, plant, node_type, switch)
        node.od.entry(0x1018, 4).default = serial
        return node

    monkeypatch.setattr(lockstep_lane, "wired_node", wired)
    rig = lockstep_lane.LockstepRig(dataclasses.replace(load_scenario("raster").setup(), bus=bus))
    rig.missed = 0

    def listen(frame, t_us):
        rig.missed += frame.can_id == EMCY and frame.data[:2] == HEARTBEAT_ERROR

    rig.wire.attach("listener").on_frame = listen
    rig.node.power_on()
    lockstep_lane.start(rig.clock, rig.port, rig.controller)
    return rig


def test_a_module_that_has_passed_is_not_tried_at_the_start(monkeypatch, tmp_path):
    proven = with_report(BUS, file_of(tmp_path, report_on(AmplifierNode)))
    assert {"heartbeat lost", "leaving operational", "drive time-out", "own step limit"} <= set(
        proven.can.driver.proven.lines
    )
    assert [started(monkeypatch, bus).missed for bus in (BUS, proven)] == [1, 0]


def test_one_without_voltage_shows_nothing_that_counts(monkeypatch, tmp_path):
    proven = with_report(BUS, file_of(tmp_path, report_on(AmplifierNode, allow_voltage=False)))
    assert started(monkeypatch, proven).missed == 1


def test_a_module_that_does_not_listen_to_us_is_driven_on_its_report_alone(monkeypatch, tmp_path):
    """Its own time without drive frames was tried with voltage; the same kind with another serial number was not."""
    with pytest.raises(StartUpError, match=r"no 0x1016 .* and nothing else takes the combs to 0 V"):
        started(monkeypatch, BUS, WithoutConsumer)
    report = report_on(WithoutConsumer)
    verdicts = {line["name"]: line["verdict"] for line in report["lines"]}
    assert (verdicts["heartbeat consumer"], verdicts["heartbeat lost"]) == ("OTHER CONTRACT", "NOT TESTED")
    proven = with_report(BUS, file_of(tmp_path, report))
    rig = started(monkeypatch, proven, WithoutConsumer)
    assert "its drive time-out (0x2012) takes over" in " ".join(rig.controller.driver.lost)
    with pytest.raises(StartUpError, match="no 0x1016"):
        started(monkeypatch, proven, WithoutConsumer, serial=2)


def changes():
    """Reports that must not count, and why."""
    good = report_on(AmplifierNode)

    def sealed(**other):
        changed = good | other
        return changed | {"digest": reports.digest_of(changed)}

    lines = [dict(line) for line in good["lines"]]
    lines[-1]["verdict"] = "NOT TESTED"
    yield good | {"lines": lines}, "it was changed since it was made"
    yield good | {"module": good["module"] | {"serial": 2}}, "it was changed since it was made"
    yield good | {"made": "2036-11-22T13:00:00+00:00"}, "it was changed since it was made"
    yield {key: value for key, value in good.items() if key != "digest"}, "no conformance.json"
    yield [good], "no conformance.json"
    yield sealed(ok=False), "of 2026-11-22: the module did not pass"
    yield sealed(module=good["module"] | {"serial": None}), "tells its identity and serial number"
    yield sealed(lines=3), "not a whole report"
    yield sealed(made="yesterday"), "not a whole report"


@pytest.mark.parametrize("place", range(9))
def test_a_report_that_was_changed_or_shows_nothing_is_refused_in_one_line(tmp_path, place):
    changed, words = list(changes())[place]
    with pytest.raises(ConfigError, match=words) as caught:
        with_report(BUS, file_of(tmp_path, changed))
    assert "\n" not in str(caught.value)


def test_a_file_that_is_none_or_of_a_simulated_module_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        with_report(BUS, tmp_path / "no.json")
    path = file_of(tmp_path, report_on(AmplifierNode))
    with pytest.raises(ConfigError, match="of a simulated module; socketcan leads to another one"):
        with_report(load("buses", "socketcan_fd", BusConfig), path)
    with pytest.raises(ConfigError, match=r"has no \[can\]"):
        with_report(load("buses", "local_20k", BusConfig), path)
    path.write_text(path.read_text()[:-100])
    with pytest.raises(ConfigError, match="cannot be read"):
        with_report(BUS, path)


def test_the_commands_refuse_it_before_anything_is_started(tmp_path):
    path = file_of(tmp_path, report_on(AmplifierNode) | {"ok": False})
    for command in (run_cli.run, operate_cli.operate, serve_cli.serve):
        with pytest.raises(ConfigError, match="it was changed since it was made"):
            command(bus="unix_1k", report=path)

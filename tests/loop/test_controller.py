"""The controller between a bus and a law: what it says, and what it does when something is in its way."""

import dataclasses
import re
from functools import cache

import pytest
from loop_rig import rows_of

from hil.faults.fault import parse
from hil.studies.faults.outcome import setup_for


@cache
def scan():
    return setup_for("lqg")


def faults_of(*texts):
    run = dataclasses.replace(scan(), faults=tuple(parse(text) for text in texts), duration_s=0.3)
    vars(run)["law"] = scan().law
    return rows_of(run, "lockstep")[1].faults


@pytest.mark.parametrize(
    ("fault", "said", "unsaid"),
    [
        ("amplifier.2:trip@0.22", ("EMCY 0x2310: current, output side", "short or dust"), ("heartbeat",)),
        ("bus.heartbeat:drop@0.22", ("EMCY 0x8130: heartbeat of the controller missed",), ("over-current",)),
        ("bus.drive:drop@0.22", ("EMCY 0x8250: no drive PDO was applied in time",), ("over-current",)),
    ],
)
def test_a_fault_of_the_node_is_told_by_its_emergency(fault, said, unsaid):
    """Not by the record of the program, with times from another origin and the remedy of another code."""
    (told,) = faults_of(fault)
    assert told.startswith("at 0.2")
    assert "NODE_EMERGENCY" in told
    for words in ("ms before", *said):
        assert words in told
    for words in ("Emergency(", "t_us", *unsaid):
        assert words not in told
    (before_ms,) = re.findall(r"([\d.]+) ms before", told)
    assert 0.0 <= float(before_ms) < 0.5  # ticks are 0.2 ms

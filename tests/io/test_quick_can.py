"""python-can in a process of a command: without asammdf and all that it brings, and in nobody's way."""

import subprocess
import sys

import pytest

pytest.importorskip("asammdf")
SEEN = "print('can' in sys.modules, 'asammdf' in sys.modules, 'pandas' in sys.modules)"


def said(program: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_it_is_loaded_without_and_whoever_wants_asammdf_has_it():
    program = f"""
import sys
from pkxyz_ctrl.io.quick_can import load_can_quickly
load_can_quickly()
{SEEN}
import can
bus = can.Bus("quick", interface="virtual")
bus.shutdown()
import asammdf
print(asammdf.MDF.__name__)
"""
    assert said(program) == ["True", "False", "False", "MDF"]


def test_a_program_that_has_loaded_it_already_keeps_its_own():
    program = f"import sys, can; from pkxyz_ctrl.io.quick_can import load_can_quickly; load_can_quickly(); {SEEN}"
    assert said(program) == ["True", "True", "True"]


@pytest.mark.parametrize("words", ["operate", "plant", "run"])
def test_the_commands_at_rate_start_without_it(words):
    """Refused for a bus that is nowhere, after all is loaded."""
    program = f"""
import sys
from hil.cli import main
sys.argv = ["pkxyz", "{words}", "--bus", "local_20k"]
try:
    main()
except SystemExit:
    pass
{SEEN}
"""
    assert said(program)[-3:] == ["True", "False", "False"]

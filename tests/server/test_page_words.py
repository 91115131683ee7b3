"""What the page says does the same as a click: a command of ``pkxyz ask``, and a method of the client."""

import re
from pathlib import Path

import pytest

import hil
from hil.commands.operation.ask import _OTHERS, _PLAIN
from hil.server.app import PAGE
from hil.server.designing import CHOICE
from pkxyz_ctrl.client.plain import Stage

SOURCES = {path.name: path.read_text(encoding="utf-8") for path in [*PAGE.glob("*.js"), PAGE / "index.html"]}
SCRIPTS = "\n".join(SOURCES.values())
BUTTONS = sorted(set(re.findall(r'data-do="(\w+)"', SOURCES["index.html"])))
"""Of verbs alone: `verb(name)` says `pkxyz ask NAME` and `stage.NAME()`."""


@pytest.mark.parametrize("verb", BUTTONS)
def test_the_verb_of_a_button_is_a_command_and_a_method(verb):
    assert verb.replace("_", "-") in _PLAIN
    assert callable(getattr(Stage, verb))


def test_every_other_command_and_line_exists():
    words = set(re.findall(r"`pkxyz ask ([a-z-]+)[ `]", SCRIPTS))
    assert words >= {"move", "jog", "law", "sample", "settle", "tilt", "go", "restore"}
    assert words <= set(_PLAIN) | set(_OTHERS)
    methods = set(re.findall(r"stage\.([a-z_]+)\(", SCRIPTS))
    assert methods >= {"move_to", "jog", "change_law", "set_sample", "quiet_holds"}
    assert [name for name in methods if not callable(getattr(Stage, name, None))] == []
    assert callable(hil.open_run)
    assert "hil.open_run(" in SCRIPTS


def test_whatever_is_said_to_the_server_by_a_click_is_told_as_command_and_line():
    """What is said without that is only looked at, or goes on with what was told."""
    quietly = set(re.findall(r'link\??\.say\(\{ do: "(\w+)"', SCRIPTS))
    assert quietly == {"subscribe", "recordings", "body", "jog_again", "jog_end", "parameters", "values", "laws"}
    assert Path(PAGE / "main.js").read_text(encoding="utf-8").count("link.say(message)") == 1  # of `ask` itself


def test_the_laws_of_the_list_are_those_that_are_looked_for():
    listed = SOURCES["index.html"].partition('<select name="law">')[2].partition("</select>")[0]
    assert re.findall(r"<option>(\w+)</option>", listed) == list(CHOICE)

"""Names are the field's, and say what they hold; what has a name of its own has it once."""

import ast
from collections import Counter

import pytest
from rooms import ROOT, House

SOURCES = House.of(ROOT).sources
SAYING_NOTHING = frozenset({"pace", "hands", "given", "worth", "gone", "surprise_m"})
"""Which quantity, or of what? Time scaling is ``feed_hold``, a standard error is called one."""
ONCE = ("Outcome", "Clock", "Counts")


def names(source: str) -> list[str]:
    """Names that a source gives: variables, attributes, parameters, functions and classes, without ``_`` about them."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            found.append(node.id if isinstance(node, ast.Name) else node.attr)
        elif isinstance(node, ast.arg):
            found.append(node.arg)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.append(node.name)
    return [name.strip("_") for name in found]


@pytest.mark.parametrize("module", sorted(SOURCES))
def test_names_say_what_they_hold(module):
    assert [name for name in names(SOURCES[module]) if name in SAYING_NOTHING] == []


def test_what_is_meant_once_is_called_so_once():
    count = Counter(name for source in SOURCES.values() for name in names(source) if name in ONCE)
    assert count == dict.fromkeys(ONCE, 1)


def test_every_way_to_give_a_name_is_found():
    source = (
        "class Clock:\n  def pace(self, hands): self.worth, gone = 1, [_given for _given in hands]\nCounts: type = 1"
    )
    assert sorted(names(source)) == ["Clock", "Counts", "given", "gone", "hands", "pace", "self", "worth"]

"""The measure of conditions: what it calls covered is, and what it doesn't isn't."""

import ast
from typing import Any

import pytest
from mcdc import Notes, Noting


def measured(source: str, calls: list[tuple[Any, ...]]) -> list[list[str]]:
    """Conditions not covered, by decision, after these calls of ``f``."""
    notes = Notes()
    tree = ast.fix_missing_locations(Noting("module", notes).visit(ast.parse(source)))
    space: dict[str, Any] = {"__notes__": notes}
    exec(compile(tree, "<source>", "exec"), space)
    plain: dict[str, Any] = {}
    exec(source, plain)
    for arguments in calls:
        assert space["f"](*arguments) == plain["f"](*arguments)
    return [decision.uncovered() for decision in notes.decisions]


@pytest.mark.parametrize(
    ("source", "calls", "expected"),
    [
        ("def f(a, b): return a and b", [(1, 1), (0, 1), (1, 0)], [[]]),
        ("def f(a, b): return a and b", [(1, 1), (0, 1)], [["b"]]),
        ("def f(a, b): return a and b", [(1, 1)], [["a", "b"]]),
        ("def f(a, b): return a or not b", [(0, 0), (0, 1), (1, 1)], [[]]),
        ("def f(a, b): return a or not b", [(1, 0), (0, 1)], [["b"]]),
        ("def f(x): return 0 <= x <= 9", [(5,), (-1,), (10,)], [[]]),
        ("def f(x): return 0 <= x <= 9", [(5,), (10,)], [["0 <= x"]]),
        ("def f(a, b, c): return a and (b or c)", [(1, 1, 0), (0, 1, 0), (1, 0, 0), (1, 0, 1)], [[]]),
        ("def f(a, b, c): return a and (b or c)", [(1, 1, 0), (0, 1, 0), (1, 0, 0)], [["c"]]),
        # the same condition twice: the second one never changes alone
        ("def f(a, b):\n  if (a or b) and not (a and b): return 1", [(0, 1), (0, 0), (1, 1), (1, 0)], [["a"]]),
    ],
)
def test_what_is_covered(source: str, calls: list[tuple[Any, ...]], expected: list[list[str]]) -> None:
    assert measured(source, calls) == expected


@pytest.mark.parametrize(("calls", "expected"), [([(0,), (1,)], []), ([(1,)], ["False of the value"])])
def test_a_value_or_its_default_is_no_decision_but_both_are_to_be_met(
    calls: list[tuple[Any, ...]], expected: list[str]
) -> None:
    assert measured("def f(a): return a or ()", calls) == [expected]


def test_a_decision_that_an_exception_leaves_does_no_harm() -> None:
    source = "def f(a):\n  try:\n    return a and g(a)\n  except NameError:\n    return a or 2"
    assert measured(source, [(1,), (0,)]) == [["a", "g(a)"], ["False of the value"]]

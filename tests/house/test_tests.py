"""Tests of the tests: none holds an assertion that cannot fail, or a comparison that nobody asks about."""

import ast
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
FILES = sorted(TESTS.rglob("*.py"))
QUESTIONS = (
    "allclose",
    "isclose",
    "array_equal",
    "isfinite",
    "all",
    "any",
    "startswith",
    "endswith",
    "is_file",
    "is_dir",
    "exists",
)
TWICE = {
    "fuzz_frames('gate', 4000, SEED)": "one seed, the same frames",
    "run_all(talk_to(AmplifierNode))": "two conversations, the same lines",
}
"""Both sides of a comparison are the same expression, and that is the question: does it give the same twice?"""


def cannot_fail(tree: ast.AST) -> Iterator[str]:
    """What in a test can't fail, each as a line: where it is, what it is, and its text."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Assert):
            for what in _idle(node.test):
                yield f"{node.lineno}: {what}: {ast.unparse(node.test)}"
        elif isinstance(node, ast.Expr):
            if isinstance(node.value, ast.Compare | ast.BoolOp | ast.UnaryOp):
                yield f"{node.lineno}: without assert: {ast.unparse(node)}"
            elif isinstance(node.value, ast.Call) and ast.unparse(node.value.func).split(".")[-1] in QUESTIONS:
                yield f"{node.lineno}: answer unused: {ast.unparse(node)}"


def _idle(test: ast.expr) -> Iterator[str]:
    always = ast.Constant | ast.Tuple | ast.List | ast.Dict | ast.JoinedStr | ast.Lambda | ast.GeneratorExp
    if isinstance(test, ast.IfExp):
        yield "conditional"  # `a < 1 if c else 2` is `(a < 1) if c else 2`
    elif isinstance(test, always) and not (isinstance(test, ast.Constant) and not test.value):
        yield "always true"
    elif isinstance(test, ast.BoolOp) and any(isinstance(value, always | ast.IfExp) for value in test.values):
        yield "a part is always true, or conditional"
    elif isinstance(test, ast.Compare):
        sides = [test.left, *test.comparators]
        for left, right in pairwise(sides):
            if ast.dump(left) == ast.dump(right) and ast.unparse(left) not in TWICE:
                yield "compared with itself"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(TESTS)))
def test_no_assertion_cannot_fail(path):
    assert list(cannot_fail(ast.parse(path.read_text(encoding="utf-8")))) == []


@pytest.mark.parametrize(
    ("source", "what"),
    [
        ("assert a < 1e-6 if c else 1e-12", "conditional"),
        ("assert (a, b)", "always true"),
        ("assert 'words'", "always true"),
        ("assert (x > 1 for x in xs)", "always true"),
        ("assert a == b or 'words'", "a part is always true, or conditional"),
        ("assert a == b and (c if d else e)", "a part is always true, or conditional"),
        ("assert a.b == a.b", "compared with itself"),
        ("a == b", "without assert"),
        ("not a", "without assert"),
        ("np.allclose(a, b)", "answer unused"),
        ("path.is_file()", "answer unused"),
    ],
)
def test_each_kind_is_found(source, what):
    (line,) = cannot_fail(ast.parse(f"def test_it():\n    {source}\n"))
    assert line.startswith(f"2: {what}: ")


@pytest.mark.parametrize(
    "source",
    [
        "assert a < (1e-6 if c else 1e-12)",
        "assert a in (1, 2)",
        "assert all(x > 1 for x in xs)",
        "assert False",
        "x = a == b",
    ],
)
def test_what_can_fail_is_left_alone(source):
    assert list(cannot_fail(ast.parse(source))) == []


def test_every_test_asks_something():
    """Each has an assertion, expects an error, or calls a function that does, in its file or beside it."""
    asking = {
        function.name
        for path in FILES
        for function in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(function, ast.FunctionDef) and _asks(function)
    }
    silent = [
        f"{path.name}: {function.name}"
        for path in FILES
        for function in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(function, ast.FunctionDef) and function.name.startswith("test_")
        if not _asks(function)
        and not asking & {ast.unparse(n.func) for n in ast.walk(function) if isinstance(n, ast.Call)}
    ]
    assert silent == []


def _asks(function: ast.FunctionDef) -> bool:
    called = {ast.unparse(n.func).split(".")[-1] for n in ast.walk(function) if isinstance(n, ast.Call)}
    expects = {"raises", "warns", "deprecated_call", "fail"} | {name for name in called if name.startswith("assert_")}
    return any(isinstance(n, ast.Assert) for n in ast.walk(function)) or bool(called & expects)

"""The mutator: every change that it should make, and no other."""

import ast
import math
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import mutate
import mutation_run
import pytest
from mutants import mutants, mutated
from mutate import TARGETS
from mutation_run import BaselineError, Subject, run_mutants

ROOT = Path(__file__).parents[2]


def changes(source: str) -> list[str]:
    return [mutant.change for mutant in mutants(source)]


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("x = a < b", ["a < b -> a <= b", "a < b -> a >= b"]),
        ("x = a == b", ["a == b -> a != b"]),
        ("x = a in b", ["a in b -> a not in b"]),
        ("x = a + b", ["a + b -> a - b"]),
        ("x = a >> b", ["a >> b -> a << b"]),
        ("x = a and b", ["a and b -> a or b"]),
        ("x = not a", ["not a -> a"]),
        ("if a:\n    b = 1", ["a -> not a", "1 -> 2"]),
        ("x = a if f(b) else c", ["f(b) -> not f(b)"]),
        ("x = max(a, b)", ["max -> min"]),
        ("x = True", ["True -> False"]),
        ("x = 7", ["7 -> 8"]),
        ("f(a)", ["f(a) -> (left out)"]),
        ("x += a", ["x += a -> x -= a", "x += a -> (left out)"]),
        ("x[i] = a", ["x[i] = a -> (left out)"]),
        ("def f():\n    return a", ["return a -> return None"]),
        ("def f():\n    raise E('below 1')", ["raise E('below 1') -> (left out)"]),
        ("def f(a: int | None = None) -> 'x':\n    '''doc 1'''", []),
        ("@njit(cache=True)\ndef f():\n    pass", []),
        ("x = f'{a + 1} is above'", []),
    ],
)
def test_changes(source: str, expected: list[str]) -> None:
    assert changes(source) == expected


@pytest.mark.parametrize("module", TARGETS)
def test_each_mutant_of_the_real_modules_compiles_and_differs(module: str) -> None:
    path = ROOT / (module.replace(".", "/") + ".py")
    source = path.read_text(encoding="utf-8")
    original = ast.dump(ast.parse(source))
    made = mutants(source)
    assert made
    for mutant in made[::7]:
        tree = mutated(source, mutant)
        compile(tree, str(path), "exec")
        assert ast.dump(tree) != original


def test_safety_is_mutated_whole() -> None:
    """A new file of safety/ is in from its first day."""
    files = {path.stem for path in (ROOT / "pkxyz_ctrl" / "safety").glob("*.py")} - {"__init__"}
    assert files == {module.split(".")[-1] for module in TARGETS if ".safety." in module}


def test_function_of_a_mutant_is_the_outermost_with_its_decorators() -> None:
    source = "@cache\ndef f(x=1):\n    def g():\n        return 2\n    return 3\n"
    source += "class A:\n    def h():\n        4\n    b = 5\n"
    found = {mutant.change: mutant.function for mutant in mutants(source)}
    numbers = {change: function for change, function in found.items() if change[0].isdigit()}
    assert numbers == {"1 -> 2": None, "2 -> 3": 1, "3 -> 4": 1, "4 -> 5": 7, "5 -> 6": None}


# What an import runs, or a cache keeps, concerns every test.
SUBJECT = """
from functools import cache
LIMIT = 3
@cache
def table():
    return [1, 2]
def low(x):
    if x > LIMIT:
        return -1
    return table()[0]
def high(x):
    while x < 0:
        x = x + 1
    return x
def unused(x):
    return x
"""
SUBJECT_TESTS = """
from subject import high, low
def test_low():
    assert low(9) == -1
    assert low(3) == 1
def test_table():
    assert low(0) == 1
def test_high():
    assert high(-3) == 0
def test_nothing():
    assert high
"""


@pytest.mark.at_rate
@pytest.mark.parametrize("unmeasured", [False, True])
def test_mutants_of_functions_imports_and_caches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unmeasured: bool
) -> None:
    """The runner, whole: with the collected tests or by a new import, a mutant is killed, survives or never ends."""
    (tmp_path / "subject.py").write_text(SUBJECT)
    (tmp_path / "test_subject.py").write_text(SUBJECT_TESTS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(mutation_run, "ENDLESS_S", 1.0)
    expected = {
        (3, "3 -> 4"): "survived",
        (6, "2 -> 3"): "survived",
        (6, "1 -> 2"): "killed",
        (8, "x > LIMIT -> x >= LIMIT"): "killed",
        (13, "1 -> 2"): "killed",
        (16, "return x -> return None"): "survived",
        (13, "x + 1 -> x - 1"): "timeout",
    }
    if unmeasured:
        del expected[13, "x + 1 -> x - 1"]  # nobody knows how long it may take
    subject = Subject("subject", tmp_path / "subject.py", (str(tmp_path / "test_subject.py"),))
    chosen = [mutant for mutant in mutants(SUBJECT) if (mutant.line, mutant.change) in expected]
    results = run_mutants(subject, chosen, math.inf, 1, unmeasured)
    assert {(mutant.line, mutant.change): result for mutant, result in results} == expected


def test_even_without_any_time_left_some_are_tried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``make mutate SECONDS=45`` spent all of it on measuring the tests, and tried none."""
    (tmp_path / "subject.py").write_text(SUBJECT)
    (tmp_path / "test_subject.py").write_text(SUBJECT_TESTS)
    monkeypatch.syspath_prepend(tmp_path)
    subject = Subject("subject", tmp_path / "subject.py", (str(tmp_path / "test_subject.py"),))
    chosen = [mutant for mutant in mutants(SUBJECT) if mutant.function is not None]
    assert len(list(run_mutants(subject, chosen, -math.inf, 2))) >= 2


def test_a_report_never_tells_of_less_than_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A short run printed "0 of 1430" into the docs."""
    page = tmp_path / "mutation.md"
    page.write_text("Last result: **1430 of 1430 mutants tried, 1387 killed**\n")
    monkeypatch.setattr(mutate, "REPORT", page)
    monkeypatch.setattr(mutate, "STATE", tmp_path / "state.jsonl")
    monkeypatch.setattr(mutate, "run_jobs", lambda jobs, end_s, workers: iter([(jobs[0], "killed")]))
    monkeypatch.setattr("sys.argv", ["mutate.py", "--report", "--module", "pkxyz_ctrl.safety.modes"])
    assert mutate.main() == 0
    assert "1430 of 1430" in page.read_text()
    assert "stays as it is" in capsys.readouterr().out
    page.write_text("no report")
    assert mutate.main() == 0
    assert "mutants tried" in page.read_text()


def test_a_run_goes_on_from_what_is_kept_and_forgets_what_modules_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept, tried = tmp_path / "outcomes.jsonl", []

    def run_two(jobs: list[mutate.Job], end_s: float, workers: int) -> Iterator[tuple[mutate.Job, str]]:
        tried.append(len(jobs))
        yield jobs[0], "killed"
        yield jobs[-1], "survived"

    kept.write_text('["pkxyz_ctrl.safety.modes 0123456789abcdef 3 0", "killed"]\n')  # of another day
    monkeypatch.setattr(mutate, "STATE", kept)
    monkeypatch.setattr(mutate, "TARGETS", {"pkxyz_ctrl.safety.modes": ("safety/test_safety_modes.py",)})
    monkeypatch.setattr(mutate, "run_jobs", run_two)
    monkeypatch.setattr("sys.argv", ["mutate.py"])
    for _ in range(2):
        mutate.main()
    assert tried[1] == tried[0] - 2
    lines = kept.read_text().splitlines()
    assert [line.endswith('"killed"]') for line in lines].count(True) == 2
    assert len(lines) == 4
    assert "0123456789abcdef" not in kept.read_text()


def test_tests_that_fail_without_a_mutant_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "subject.py").write_text(SUBJECT)
    (tmp_path / "test_subject.py").write_text(SUBJECT_TESTS.replace("-1", "-2"))
    monkeypatch.syspath_prepend(tmp_path)
    subject = Subject("subject", tmp_path / "subject.py", (str(tmp_path / "test_subject.py"),))
    with pytest.raises(BaselineError, match="subject"):
        list(run_mutants(subject, mutants(SUBJECT), math.inf, 1))


def test_a_slow_example_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither of the first run, which is traced, nor of a mutant on a busy machine, which would count as killed."""
    slow = """
import time
from hypothesis import given, settings, strategies
from subject import unused
@settings(max_examples=1)
@given(strategies.just(1))
def test_slow(x):
    time.sleep(0.25)
    unused(x)
"""
    (tmp_path / "subject.py").write_text(SUBJECT)
    (tmp_path / "test_subject.py").write_text(SUBJECT_TESTS + slow)
    monkeypatch.syspath_prepend(tmp_path)
    subject = Subject("subject", tmp_path / "subject.py", (str(tmp_path / "test_subject.py"),))
    in_unused = [mutant for mutant in mutants(SUBJECT) if mutant.line == 16]
    hypothesis.settings.load_profile("default")  # as ``mutate.py`` finds it
    try:
        assert [result for _, result in run_mutants(subject, in_unused, math.inf, 1)] == ["survived"]
    finally:
        hypothesis.settings.load_profile("same every time")


def test_a_mutant_is_one_change() -> None:
    source = "def f(a, b):\n    if a < b and b < 3:\n        return a + 1\n    return 0\n"
    texts = [ast.unparse(mutated(source, mutant)) for mutant in mutants(source)]
    lines = ast.unparse(ast.parse(source)).splitlines()
    assert len(set(texts)) == len(texts) == 11
    for text in texts:
        assert sum(a != b for a, b in zip(text.splitlines(), lines, strict=True)) == 1

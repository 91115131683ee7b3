"""The mutator: every change that it should make, and no other."""

import ast
from pathlib import Path

import pytest
from mutants import mutants, mutated
from mutate import TARGETS

ROOT = Path(__file__).parents[1]


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
    assert len(made) > 30
    for mutant in made[::7]:
        tree = mutated(source, mutant)
        compile(tree, str(path), "exec")
        assert ast.dump(tree) != original


def test_a_mutant_is_one_change() -> None:
    source = "def f(a, b):\n    if a < b and b < 3:\n        return a + 1\n    return 0\n"
    texts = [ast.unparse(mutated(source, mutant)) for mutant in mutants(source)]
    lines = ast.unparse(ast.parse(source)).splitlines()
    assert len(set(texts)) == len(texts) == 11
    for text in texts:
        assert sum(a != b for a, b in zip(text.splitlines(), lines, strict=True)) == 1

"""A function fits a screen, sixty lines with its docstring; those that draw the docs, too. What is longer says why."""

import ast

import pytest
from rooms import ROOT, House

SCRIPTS = {
    f"{folder}.{path.stem}": path.read_text(encoding="utf-8")
    for folder in ("docs", "benchmarks", "examples")
    for path in sorted((ROOT / folder).rglob("*.py"))
}
SOURCES = {**House.of(ROOT).sources, **SCRIPTS}
LONGEST = 60
LONGER = {
    "hil.commands.mechanics.design": "thirteen options of a command, each with its help",
    "hil.commands.run.run": "options of a command, each with its help",
    "hil.commands.studies.identify.identify": "options of a command, each with its help",
    "hil.commands.studies.margins.margins": "options of a command, each with its help",
    "pkxyz_ctrl.design.identification.modal_fit.fit_modes": "one fit: start, three rounds of refinement, covariance",
    "pkxyz_ctrl.mechanics.published._flexures": "a table: a line for each number of the paper",
    "pkxyz_ctrl.mechanics.published_device.dimensions": "a table: a line for each number of the paper",
    "pkxyz_ctrl.mechanics.published_device.dynamics": "a table: a line for each number of the paper",
}


def long_functions(module: str, source: str) -> list[str]:
    """Names of the functions of a source that have more than ``LONGEST`` lines."""
    return [
        f"{module}.{node.name}"
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (node.end_lineno or 0) - node.lineno + 1 > LONGEST
    ]


@pytest.mark.parametrize("module", sorted(SOURCES))
def test_functions_fit_a_screen(module):
    assert [name for name in long_functions(module, SOURCES[module]) if name not in LONGER] == []


def test_nobody_is_excused_who_need_not_be():
    found = {name for module, source in SOURCES.items() for name in long_functions(module, source)}
    assert set(LONGER) <= found


def test_a_planted_one_is_found():
    body = "    x = 1\n"
    assert long_functions("m", "def short():\n" + (LONGEST - 1) * body) == []
    assert long_functions("m", "class C:\n  def long(self):\n" + LONGEST * body) == ["m.long"]

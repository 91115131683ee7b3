"""Branches and conditions that the tests have met: ``make coverage``.

Branches are counted by coverage.py. For modified condition/decision coverage the modules are imported with
every decision of more than one condition (``and``, ``or``, a chain of comparisons) noting what each
condition was and how the decision went. A condition is covered if two of these rows differ in it and in the
outcome, and in no other condition that was looked at (masking MC/DC for operators that stop early, DO-178C).
The compiler is off, so the kernels run as Python.
"""

import argparse
import ast
import importlib.abc
import importlib.machinery
import json
import os
import sys
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).parents[2]
MODULES = (
    "pkxyz_ctrl.safety.gate",
    "pkxyz_ctrl.safety.gate_rules",
    "pkxyz_ctrl.safety.modes",
    "pkxyz_ctrl.safety.monitors",
    "pkxyz_ctrl.safety.sdo_rules",
    "pkxyz_ctrl.safety.trips",
    "pkxyz_ctrl.can.codec",
    "pkxyz_ctrl.can.process_pdo",
    "pkxyz_ctrl.can.driver",
    "pkxyz_ctrl.can.driver_rules",
    "pkxyz_ctrl.can.sense_input",
    "pkxyz_ctrl.can.sdo",
    "pkxyz_ctrl.can.start_plan",
    "pkxyz_ctrl.can.start_sequence",
    "pkxyz_ctrl.can.startup",
    "hil.node.drive",
    "hil.node.amplifier",
    "hil.node.rules",
)
TESTS = (
    *(f"tests/safety/test_safety_{part}.py" for part in ("misfit", "modes", "monitors", "pinned")),
    *(f"tests/safety/test_safety_gate{part}.py" for part in ("", "_reasons", "_traffic")),
    "tests/safety/test_output_frames.py",
    "tests/safety/test_process_frames.py",
    "tests/can",
    "tests/node",
    "tests/proof/test_mode_machine.py",
)
REASONS = Path(__file__).with_name("uncovered.json")
"""What is not covered and why, by module, text of the decision and condition."""

Row = tuple[tuple[bool | None, ...], bool]


@dataclass
class Decision:
    """One ``and``, ``or`` or chain; ``rows`` are the ways in which it has gone."""

    module: str
    line: int
    text: str
    conditions: list[str]
    is_choice: bool = False
    """``value or default``: no decision; both are to be met"""
    rows: set[Row] = field(default_factory=set)

    def uncovered(self) -> list[str]:
        """Conditions that no two rows show to matter."""
        if self.is_choice:
            met = {seen[0] for seen, _ in self.rows}
            return [f"{value} of the value" for value in (True, False) if value not in met]
        return [text for place, text in enumerate(self.conditions) if not self._matters(place)]

    def _matters(self, place: int) -> bool:
        return any(
            one[1] and not other[1] and self._differ(one[0], other[0], place)
            for one in self.rows
            for other in self.rows
        )

    @staticmethod
    def _differ(one: tuple[bool | None, ...], other: tuple[bool | None, ...], place: int) -> bool:
        if None in (one[place], other[place]) or one[place] == other[place]:
            return False
        pairs = [pair for at, pair in enumerate(zip(one, other, strict=True)) if at != place]
        return all(a == b or a is None or b is None for a, b in pairs)


class Notes:
    """What the changed modules call."""

    def __init__(self) -> None:
        self.decisions: list[Decision] = []
        self._open: list[tuple[int, dict[int, bool]]] = []

    def begin(self, number: int) -> None:
        self._open.append((number, {}))

    def condition(self, place: int, value: Any) -> Any:
        self._open[-1][1][place] = bool(value)
        return value

    def end(self, number: int, value: Any) -> Any:
        while True:  # what an exception left open is closed here
            opened, seen = self._open.pop()
            if opened == number:
                break
        decision = self.decisions[number]
        decision.rows.add((tuple(seen.get(place) for place in range(len(decision.conditions))), bool(value)))
        return value


class Noting(ast.NodeTransformer):
    """Puts the calls of `Notes` into a module's tree."""

    def __init__(self, module: str, notes: Notes) -> None:
        self._module, self._notes = module, notes

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.AST:
        return self._decision(node)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        return self._decision(node) if len(node.ops) > 1 else self.generic_visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.body = [self.visit(statement) for statement in node.body]  # not its annotations and decorators
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        if node.value is not None:
            node.value = self.visit(node.value)
        return node

    def _decision(self, node: ast.expr) -> ast.AST:
        number = len(self._notes.decisions)
        decision = Decision(self._module, node.lineno, ast.unparse(node), [], _is_choice(node))
        self._notes.decisions.append(decision)
        noted = self._conditions(node, decision)
        begin = _call("begin", ast.Constant(number))
        first = ast.Subscript(ast.Tuple([begin, noted], ast.Load()), ast.Constant(1), ast.Load())
        return ast.copy_location(_call("end", ast.Constant(number), first), node)

    def _conditions(self, node: ast.expr, decision: Decision) -> ast.expr:
        if isinstance(node, ast.BoolOp):
            return ast.BoolOp(node.op, [self._conditions(value, decision) for value in node.values])
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            return ast.UnaryOp(node.op, self._conditions(node.operand, decision))
        if isinstance(node, ast.Compare) and len(node.ops) > 1:
            ends = [node.left, *node.comparators]
            links = [ast.Compare(a, [op], [b]) for a, op, b in zip(ends, node.ops, ends[1:], strict=False)]
            return ast.BoolOp(ast.And(), [self._conditions(link, decision) for link in links])
        place = len(decision.conditions)
        decision.conditions.append(ast.unparse(node))
        return _call("condition", ast.Constant(place), self.visit(node))


def _is_choice(node: ast.expr) -> bool:
    if not (isinstance(node, ast.BoolOp) and isinstance(node.op, ast.Or) and len(node.values) == 2):
        return False
    value, default = node.values
    literal = ast.Constant | ast.Tuple | ast.List | ast.JoinedStr
    if isinstance(default, literal):
        return True
    is_made = isinstance(default, ast.Call) and isinstance(default.func, ast.Name) and default.func.id[0].isupper()
    held = isinstance(value, ast.Attribute) and isinstance(default, ast.Call | ast.Name | ast.Attribute)
    return is_made or held


def _call(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(ast.Attribute(ast.Name("__notes__", ast.Load()), name, ast.Load()), list(arguments), [])


class Importer(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports the chosen modules with their decisions noted."""

    def __init__(self, notes: Notes) -> None:
        self._notes = notes

    def find_spec(self, name: str, path: Any, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        if name not in MODULES:
            return None
        file = path_of(name)
        return importlib.machinery.ModuleSpec(name, self, origin=str(file))

    def exec_module(self, module: ModuleType) -> None:
        file = path_of(module.__name__)
        module.__file__ = str(file)
        tree = Noting(module.__name__, self._notes).visit(ast.parse(file.read_text(encoding="utf-8")))
        module.__dict__["__notes__"] = self._notes
        exec(compile(ast.fix_missing_locations(tree), str(file), "exec"), module.__dict__)


def path_of(module: str) -> Path:
    return ROOT / (module.replace(".", "/") + ".py")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tests", nargs="*", default=list(TESTS))
    parser.add_argument("--figures", type=Path, help="leave the figures in this file")
    arguments = parser.parse_args()
    import coverage
    import pytest

    os.chdir(ROOT)
    notes = Notes()
    meter = coverage.Coverage(
        branch=True, data_file=None, config_file=False, include=[str(path_of(module)) for module in MODULES]
    )
    sys.meta_path.insert(0, Importer(notes))
    meter.start()
    code = pytest.main(["-q", "-p", "no:cacheprovider", *arguments.tests])
    meter.stop()
    if code != 0:
        return int(code)
    return report(meter, notes, arguments.figures)


def report(meter: Any, notes: Notes, file: Path | None) -> int:
    """Prints what is missing; 1 if something is for which there is no reason."""
    reasons: dict[str, str] = json.loads(REASONS.read_text(encoding="utf-8")) if REASONS.exists() else {}
    missing: list[str] = []
    figures: dict[str, Any] = {}
    by_module: dict[str, list[Decision]] = defaultdict(list)
    for decision in notes.decisions:
        by_module[decision.module].append(decision)
    for module in MODULES:
        numbers = meter.analysis2(str(path_of(module)))
        analysis = meter._analyze(str(path_of(module))).numbers
        lost = meter._analyze(str(path_of(module))).missing_branch_arcs()
        lines = path_of(module).read_text(encoding="utf-8").splitlines()
        for start, ends in lost.items():
            missing += [f"{module}: branch: {lines[start - 1].strip()} -> {_shown(lines, end)}" for end in ends]
        missing += [f"{module}: line: {lines[line - 1].strip()}" for line in numbers[3]]
        conditions = 0
        for decision in by_module[module]:
            conditions += len(decision.conditions)
            missing += [f"{module}: condition: {text} of {decision.text}" for text in decision.uncovered()]
        figures[module] = {
            "branches": analysis.n_branches,
            "branches_met": analysis.n_executed_branches,
            "conditions": conditions,
            "conditions_met": conditions - sum(len(d.uncovered()) for d in by_module[module]),
        }
        print(f"{module}: {figures[module]}")
    unexplained = [text for text in dict.fromkeys(missing) if text not in reasons]
    for text in dict.fromkeys(missing):
        print(f"  {text}   {reasons.get(text, '** no reason **')}")
    if file:
        file.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 1 if unexplained else 0


def _shown(lines: list[str], line: int) -> str:
    return "return" if line < 0 else lines[line - 1].strip()


if __name__ == "__main__":
    if os.environ.get("NUMBA_DISABLE_JIT") != "1":
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | {"NUMBA_DISABLE_JIT": "1"})
    sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "rigs")]
    sys.exit(main())

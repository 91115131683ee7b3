"""Mutants of a Python module: one small change each, by its syntax tree.

Changed are comparisons, arithmetic, ``and`` / ``or`` / ``not``, conditions, ``min`` / ``max``, numbers, what is
returned, and statements that are left out. Left alone are docstrings, messages (whatever is raised is raised or not),
annotations and decorators.
"""

import ast
import copy
from collections.abc import Iterator
from dataclasses import dataclass

COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitOr,
}


@dataclass(frozen=True)
class Mutant:
    """``change`` is ``old -> new`` of an expression or statement; ``place`` and ``number`` find it again.

    ``function``: first line, decorators included, of the outermost function around it; None in the module's own code.
    """

    line: int
    change: str
    place: int
    number: int
    function: int | None


def mutants(source: str) -> list[Mutant]:
    """All of them, in the order of the text."""
    tree = ast.parse(source)
    quiet = _left_alone(tree)
    functions = _functions(tree)
    found = []
    for place, node in enumerate(ast.walk(tree)):
        if id(node) not in quiet:
            for number, new in enumerate(_changes(node)):
                change = f"{_shown(node)} -> {_shown(new)}"
                line = node.lineno  # type: ignore[attr-defined]
                found.append(Mutant(line, change, place, number, functions.get(id(node))))
    return sorted(found, key=lambda mutant: (mutant.line, mutant.place, mutant.number))


def mutated(source: str, mutant: Mutant) -> ast.Module:
    """The whole module with this one change."""
    tree = ast.parse(source)
    target = next(node for place, node in enumerate(ast.walk(tree)) if place == mutant.place)
    _replace(tree, target, list(_changes(target))[mutant.number])
    return ast.fix_missing_locations(tree)


def _shown(node: ast.AST) -> str:
    if isinstance(node, ast.Pass):
        return "(left out)"
    return ast.unparse(node.test if isinstance(node, ast.If | ast.IfExp | ast.While) else node)


def _changes(node: ast.AST) -> Iterator[ast.AST]:
    """What ``node`` is replaced by, one after the other."""
    match node:
        case ast.Compare():
            for place, operator in enumerate(node.ops):
                for other in COMPARISONS[type(operator)]:
                    new = copy.deepcopy(node)
                    new.ops[place] = other()
                    yield new
        case ast.BinOp() if type(node.op) in ARITHMETIC:
            new_binary = copy.deepcopy(node)
            new_binary.op = ARITHMETIC[type(node.op)]()
            yield new_binary
        case ast.AugAssign():
            if type(node.op) in ARITHMETIC:
                new_assignment = copy.deepcopy(node)
                new_assignment.op = ARITHMETIC[type(node.op)]()
                yield new_assignment
            yield ast.Pass()
        case ast.BoolOp():
            new_bool = copy.deepcopy(node)
            new_bool.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield new_bool
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert()):
            yield node.operand
        case ast.Name(id="min" | "max" as name, ctx=ast.Load()):
            yield ast.Name("max" if name == "min" else "min", ast.Load())
        case ast.Constant(value=bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(value=int() | float() as value):
            yield ast.Constant(value + 1)
        case ast.Return(value=ast.expr()):
            if not (isinstance(node.value, ast.Constant) and node.value.value is None):
                yield ast.Return(ast.Constant(None))
        case ast.Raise() | ast.Expr(value=ast.Call()) | ast.Continue() | ast.Break():
            yield ast.Pass()
        case ast.Assign(targets=[ast.Subscript() | ast.Attribute()]):
            yield ast.Pass()
        case ast.If() | ast.IfExp() | ast.While() if isinstance(node.test, ast.Name | ast.Attribute | ast.Call):
            new_condition = copy.deepcopy(node)
            new_condition.test = ast.UnaryOp(ast.Not(), new_condition.test)
            yield new_condition


def _functions(tree: ast.Module) -> dict[int, int]:
    """First line of the outermost function by the id of each node in its body; a default value is not in its body."""
    found: dict[int, int] = {}
    for function in ast.walk(tree):  # outer ones come first
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            first = min(node.lineno for node in (function, *function.decorator_list))
            for inner in (inner for statement in function.body for inner in ast.walk(statement)):
                found.setdefault(id(inner), first)
    return found


def _left_alone(tree: ast.Module) -> set[int]:
    """Nodes in parts that say nothing about behaviour."""
    found: set[int] = set()
    for parent in ast.walk(tree):
        quiet: list[ast.AST | None] = []
        match parent:
            case ast.FunctionDef() | ast.AsyncFunctionDef():
                quiet = [*parent.decorator_list, parent.returns]
            case ast.ClassDef():
                quiet = [*parent.decorator_list]
            case ast.arg() | ast.AnnAssign():
                quiet = [parent.annotation]
            case ast.Raise():
                quiet = [parent.exc, parent.cause]
            case ast.JoinedStr():
                quiet = [*parent.values]
        found |= {id(inner) for part in quiet if part is not None for inner in ast.walk(part)}
    return found


def _replace(tree: ast.Module, target: ast.AST, new: ast.AST) -> None:
    for parent in ast.walk(tree):
        for field, value in ast.iter_fields(parent):
            if value is target:
                setattr(parent, field, new)
            elif isinstance(value, list):
                value[:] = [new if item is target else item for item in value]

"""Who imports whom, read from the sources: the arrows of the design run one way, and what is pure has no clock."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("pkxyz_ctrl", "hil", "sim")
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
}

# What a layer may import besides itself, by prefix of a module's name; the first prefix that fits counts.
NUMBERS = ("math", "numpy", "numba")
VALUES = ("enum", "typing", "dataclasses", "struct", "collections", "functools")
ALLOWED: dict[str, tuple[str, ...]] = {
    "pkxyz_ctrl.core": ("pkxyz_ctrl.config.stage", *NUMBERS),
    "pkxyz_ctrl.safety": ("pkxyz_ctrl.can.frame", "numpy", "numba", *VALUES),
    "pkxyz_ctrl.can.dbc": ("pkxyz_ctrl.can", "canopen", "cantools", "pathlib", "re", *VALUES),
    "pkxyz_ctrl.can.wire_doc": ("canopen", "sys", *VALUES),
    "pkxyz_ctrl.can": ("pydantic", *VALUES),
    "pkxyz_ctrl.loop.cycle": ("pkxyz_ctrl.core", "pkxyz_ctrl.safety", "pkxyz_ctrl.loop.row", *NUMBERS, "typing"),
    "pkxyz_ctrl.loop.row": ("numpy",),
    "pkxyz_ctrl.loop.runtime": ("pkxyz_ctrl.loop.controller", "pkxyz_ctrl.can.frame", "numpy", *VALUES),
    "pkxyz_ctrl.loop.controller": (
        *(
            "pkxyz_ctrl.loop.cycle",
            "pkxyz_ctrl.loop.period",
            "pkxyz_ctrl.loop.row",
            "pkxyz_ctrl.config.bus",
            "pkxyz_ctrl.can",
            "pkxyz_ctrl.safety",
        ),
        "pkxyz_ctrl.compiled.direct_call",
        *("numpy", *VALUES),
    ),
    "sim": (*NUMBERS, *VALUES, "scipy", "pydantic", "tomllib", "pathlib"),
}
PURE = ("pkxyz_ctrl.core", "pkxyz_ctrl.safety", "pkxyz_ctrl.loop.cycle", "pkxyz_ctrl.loop.row", "sim.kernels")
SANS_IO = (*PURE, "pkxyz_ctrl.can", "pkxyz_ctrl.loop.controller", "pkxyz_ctrl.loop.runtime", "sim")
CLOCKS_AND_DICE = ("time", "datetime", "random", "secrets", "logging", "os", "socket", "threading", "asyncio", "uuid")


def is_in(module: str, prefix: str) -> bool:
    return module == prefix or module.startswith(prefix + ".")


def is_in_any(module: str, prefixes: tuple[str, ...]) -> bool:
    return any(is_in(module, prefix) for prefix in prefixes)


def imports(module: str, *, at_import_only: bool = False) -> set[str]:
    """Modules that a module names in its imports; a name that is a module of ours counts as that module.

    ``at_import_only``: only what is imported when the module is, so neither inside functions nor for type checkers.
    """
    path = FILES[module]
    found = set()
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in _statements(ast.parse(path.read_text(encoding="utf-8")), at_import_only):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            above = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
            base = ".".join(p for p in (above, node.module) if p)
            named = {f"{base}.{alias.name}" for alias in node.names}
            ours = named & FILES.keys()
            found |= ours | ({base} if named - ours else set())
    return found


def _statements(tree: ast.AST, at_import_only: bool) -> Iterator[ast.AST]:
    for node in ast.iter_child_nodes(tree):
        if at_import_only:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
                continue
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
                continue
        yield node
        yield from _statements(node, at_import_only)


def test_the_reader_of_imports_reads_them_all():
    """On modules whose imports are known: relative ones, names that are modules, those for type checkers."""
    assert {"pkxyz_ctrl.core.allocation", "pkxyz_ctrl.core.estimator", "math", "numba"} <= imports(
        "pkxyz_ctrl.core.tick"
    )
    assert "pkxyz_ctrl.can.frame" in imports("pkxyz_ctrl.can.driver")
    assert "hil.lanes.setup" in imports("hil.runs.scenario")
    assert "hil.lanes.setup" not in imports("hil.runs.scenario", at_import_only=True)
    assert len(FILES) > 80


@pytest.mark.parametrize("module", sorted(FILES))
def test_arrows_run_one_way(module):
    mine = imports(module)
    layer = next((name for name in ALLOWED if is_in(module, name)), None)
    if layer is not None:
        foreign = {m for m in mine if not is_in(m, layer) and not is_in_any(m, ALLOWED[layer])}
        assert not foreign, f"{module} is in {layer} and may not import {sorted(foreign)}"
    if not is_in(module, "hil"):
        assert not {m for m in mine if is_in(m, "hil")}, f"{module} imports the harness"
    if is_in(module, "pkxyz_ctrl"):
        assert not {m for m in mine if is_in(m, "sim")}, f"{module} imports the plant"
    if is_in(module, "pkxyz_ctrl.io"):
        inner = {
            m for m in mine if is_in_any(m, ("pkxyz_ctrl.loop.runtime", "pkxyz_ctrl.loop.cycle", "pkxyz_ctrl.core"))
        }
        assert not inner, f"{module} knows of the loop that it serves: {sorted(inner)}"
    if not is_in_any(module, ("pkxyz_ctrl.io", "hil")):
        assert not {m for m in mine if is_in(m, "can")}, f"{module} imports python-can"
    if module not in ("hil.cli", "hil.__main__"):
        assert "hil.cli" not in mine, f"{module} imports the command line"


@pytest.mark.parametrize("module", [m for m in sorted(FILES) if is_in_any(m, SANS_IO)])
def test_no_clock_no_dice_no_log_where_time_is_handed_in(module):
    assert not {m for m in imports(module) if is_in_any(m, CLOCKS_AND_DICE)}
    for node in ast.walk(ast.parse(FILES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("np.random", "numpy.random"):
            assert node.attr in ("SFC64", "SeedSequence"), f"line {node.lineno}"  # both only spread a seed handed in
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and is_in_any(module, PURE):
            assert node.func.id not in ("open", "print", "input", "eval", "exec"), f"line {node.lineno}"


def test_no_module_imports_itself_by_a_detour():
    edges = {m: sorted(imports(m, at_import_only=True) & FILES.keys() - {m}) for m in FILES}
    finished: set[str] = set()

    def follow(module: str, way: tuple[str, ...]) -> None:
        assert module not in way, " -> ".join((*way[way.index(module) :], module))
        if module not in finished:
            for other in edges[module]:
                follow(other, (*way, module))
            finished.add(module)

    for module in FILES:
        follow(module, ())


def test_what_runs_on_the_target_loads_no_harness_and_no_python_can():
    """The loop with all that it needs, imported in a fresh interpreter."""
    code = (
        "import sys, pkxyz_ctrl.loop.runtime, pkxyz_ctrl.loop.cycle\n"
        "print(sorted({m.partition('.')[0] for m in sys.modules} & {'can', 'canopen', 'cantools', 'hil', 'sim',"
        " 'control', 'filterpy', 'osqp', 'matplotlib', 'pyarrow', 'rich', 'typer', 'ruckig'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == "[]"


def test_files_are_of_one_idea():
    """No file of the product is so long that it must be several, and none is called after what nobody could name."""
    for module, path in FILES.items():
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 400, module
        assert path.stem not in ("utils", "util", "helpers", "common", "misc", "base"), module

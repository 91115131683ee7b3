"""Kernels that are compiled already are loaded without the compiler's library, and none of ours needs that library."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LINEAR_ALGEBRA = {"linalg", "dot", "matmul", "vdot", "inner", "outer", "trace", "kron"}
_RUN = """
import sys
from hil.cli import main
sys.argv = ["pkxyz", "sil", "steps", "--lane", sys.argv[1], "--out", sys.argv[2], "--json"]
try:
    main()
finally:
    print(sorted({"scipy.linalg", "numba.np.arraymath"} & set(sys.modules)), file=sys.stderr)
"""


def run(lane: str, folder: Path) -> str:
    done = subprocess.run([sys.executable, "-c", _RUN, lane, folder], capture_output=True, text=True, check=True)
    return done.stderr.splitlines()[-1]


@pytest.mark.parametrize("lane", ["lockstep", "fast"])
def test_a_warm_run_brings_in_no_library_to_compile_with(lane, tmp_path):
    run(lane, tmp_path / "warm")  # compiles and designs what nobody has needed before
    assert run(lane, tmp_path / "again") == "[]"


_LOADED_IN_RUN = """
import sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from hil.lanes.lane import Lane
from hil.lanes.lockstep import LockstepRig
from hil.runs.run import run_into
from hil.runs.run_folder import RunFolder
from hil.runs.scenario import load_scenario
loads, loaded = Dispatcher.compile, []
def compile(self, types):
    loaded.append(self.py_func.__qualname__)
    return loads(self, types)
Dispatcher.compile = compile
runs = LockstepRig.run
def run(rig, blocks):
    loaded.clear()
    ran = runs(rig, blocks)
    print(*loaded)
    return ran
LockstepRig.run = run
run_into(RunFolder(Path(sys.argv[1])), load_scenario("steps"), Lane.LOCKSTEP)
"""


def test_a_run_finds_its_kernels_loaded(tmp_path):
    """Four were loaded by its first ticks: 80 ms, three times the run itself, and several periods of one at rate."""
    script = [sys.executable, "-c", _LOADED_IN_RUN, tmp_path / "run"]
    assert subprocess.run(script, capture_output=True, text=True, check=True).stdout == "\n"


def compiles(decorator: ast.expr) -> bool:
    return ast.unparse(decorator).startswith(("njit", "kernel"))


def kernels() -> list[tuple[Path, ast.FunctionDef]]:
    found = []
    for package in ("pkxyz_ctrl", "sim", "hil"):
        for path in sorted((ROOT / package).rglob("*.py")):
            source = path.read_text(encoding="utf-8")
            if "@njit" in source or "@kernel" in source:
                found += [
                    (path, node)
                    for node in ast.walk(ast.parse(source))
                    if isinstance(node, ast.FunctionDef) and any(map(compiles, node.decorator_list))
                ]
    return found


def calls_linear_algebra(kernel: ast.FunctionDef) -> bool:
    return any(
        (isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult))
        or (isinstance(node, ast.Attribute) and node.attr in LINEAR_ALGEBRA)
        for node in ast.walk(kernel)
    )


def test_no_kernel_calls_linear_algebra():
    """Its symbols would be missing, which ends the process."""
    assert len(kernels()) > 200
    assert [f"{path.name}: {kernel.name}" for path, kernel in kernels() if calls_linear_algebra(kernel)] == []
    planted = ast.parse("@njit\ndef kernel(a, b):\n    return np.linalg.solve(a, b @ b)\n").body[0]
    assert isinstance(planted, ast.FunctionDef)
    assert calls_linear_algebra(planted)

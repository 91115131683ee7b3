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


def kernels() -> list[tuple[Path, ast.FunctionDef]]:
    found = []
    for package in ("pkxyz_ctrl", "sim", "hil"):
        for path in sorted((ROOT / package).rglob("*.py")):
            source = path.read_text(encoding="utf-8")
            if "njit" in source:
                found += [
                    (path, node)
                    for node in ast.walk(ast.parse(source))
                    if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(d) for d in node.decorator_list)
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

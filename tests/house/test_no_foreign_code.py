"""Files from elsewhere run no code: nothing in the product makes a program of data, but for what is named here."""

import ast

from command_line import ROOT

ALLOWED = {
    ("hil/__init__.py", "import_module"): "names of the public interface, from a table in that file",
    ("hil/screen/lazy_commands.py", "import_module"): "names of commands, from a table in hil/cli.py",
    ("hil/studies/spread/workers.py", "pickle"): "between this program's own processes and the cluster that was named",
    ("hil/pictures/drawing_process.py", "subprocess"): "this program: the process that draws",
    ("hil/pictures/drawing_process.py", "pickle"): "from this program to that process, by a pipe of their own",
    ("hil/studies/latency.py", "subprocess"): "cyclictest: from PATH, or the path that was given on the command line",
    ("hil/bench/startup.py", "subprocess"): "this program, timed",
    ("hil/bench/rigs/instructions.py", "subprocess"): "this program, gone through instruction by instruction",
    ("hil/bench/rigs/running.py", "subprocess"): "this program: what it serves, timed, or what is timed beside it",
    ("hil/emulator/image.py", "subprocess"): "the cross compiler, for sources of this package",
    ("hil/emulator/board.py", "subprocess"): "the emulator, with the firmware that was made of them",
    ("hil/native/program.py", "subprocess"): "the C compiler, for sources of this package",
    ("hil/native/loop_process.py", "subprocess"): "the program that it made of them",
    ("hil/server/beside.py", "subprocess"): "this program: the loop and the plant, in processes of their own",
    ("hil/abreast/parts.py", "compile"): "numba's, of kernels of that file",
    ("pkxyz_ctrl/export/kernels.py", "subprocess"): "this program, where numba leaves what it compiles unoptimised",
}
_CALLS = {"eval", "exec", "compile", "__import__", "import_module", "run_path", "run_module", "system", "popen"}
_MODULES = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "runpy", "subprocess", "yaml", "code"}


def found_in(source: str) -> set[str]:
    """What of the above a source uses."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names} & _MODULES
        elif isinstance(node, ast.ImportFrom):
            found |= {str(node.module)} & _MODULES
        elif isinstance(node, ast.Call):
            name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            owner = ast.unparse(node.func.value) if isinstance(node.func, ast.Attribute) else ""
            if name in _CALLS and not (name == "compile" and owner in ("re", "kernel")):
                found.add(name)
            if name == "load" and owner in ("np", "numpy"):
                found.add("np.load")
            found |= {"allow_pickle" for keyword in node.keywords if keyword.arg == "allow_pickle"}
    return found


def test_the_search_finds_what_it_looks_for():
    assert found_in("import pickle\nx = eval('1')\nnp.load(f, allow_pickle=True)") == {
        "pickle", "eval", "np.load", "allow_pickle"
    }  # fmt: skip
    assert found_in("re.compile('x')\nimport json\njson.load(f)") == set()


def test_nothing_turns_data_into_a_program():
    used = {
        (str(path.relative_to(ROOT)), name)
        for package in ("pkxyz_ctrl", "hil", "sim")
        for path in (ROOT / package).rglob("*.py")
        for name in found_in(path.read_text(encoding="utf-8"))
    }
    assert used == set(ALLOWED)

"""Runs the tests of one module with one change in it, in a forked process: nothing on disk is changed.

The parent has imported every library that the tests need, and none of ours; so a child begins at once, and imports
the mutated module in place of the one that is there. The unchanged module goes first: it shows that its tests pass, how
long each takes and which functions each calls. A mutant then meets the tests that call its function, the fastest first,
until one fails.
"""

import ast
import importlib.abc
import importlib.machinery
import importlib.util
import json
import math
import os
import resource
import signal
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

import hypothesis
import pytest
from mutants import Mutant, mutated

TESTS = Path(__file__).parent
ROOT = TESTS.parent
_OURS = tuple(str(ROOT / folder) + os.sep for folder in ("pkxyz_ctrl", "hil", "sim", "tests"))
_NO_TEST_REACHES_IT = 5  # pytest's exit code when nothing was left to run


@dataclass(frozen=True)
class Baseline:
    """What the unchanged module showed. ``calls``: the functions that a test calls, by their first lines.

    ``calls_of_all``: those that an import calls, and those whose results are kept, concern every test.
    ``cpu_limit_s``: processor time after which a mutant counts as endless; a busy machine kills none.
    """

    seconds: dict[str, float]
    calls: dict[str, frozenset[int]]
    calls_of_all: frozenset[int]
    cpu_limit_s: int

    def concerns_all(self, mutant: Mutant) -> bool:
        return mutant.function is None or mutant.function in self.calls_of_all

    def irrelevant(self, mutant: Mutant) -> frozenset[str]:
        """Tests that never call the function, so cannot tell what was changed in it."""
        if self.concerns_all(mutant):
            return frozenset()
        return frozenset(test for test in self.seconds if mutant.function not in self.calls[test])


class MutatedLoader(importlib.machinery.SourceFileLoader):
    """Loads one module from a changed tree."""

    tree: ast.Module

    def get_code(self, fullname: str) -> CodeType:
        return compile(self.tree, self.path, "exec", dont_inherit=True)


class MutatedFinder(importlib.abc.MetaPathFinder):
    """Hands out the mutant for one module's name; all others are found as ever."""

    def __init__(self, name: str, path: Path, tree: ast.Module) -> None:
        self._name = name
        self._path = path
        self._tree = tree

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != self._name:
            return None
        loader = MutatedLoader(fullname, str(self._path))
        loader.tree = self._tree
        return importlib.util.spec_from_file_location(fullname, self._path, loader=loader)


class Order:
    """pytest plugin: leaves out what is irrelevant; fast tests first, those with a new name (a mutated enum) last."""

    def __init__(self, baseline: Baseline, irrelevant: frozenset[str]) -> None:
        self._seconds = baseline.seconds
        self._irrelevant = irrelevant

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        relevant = [item for item in items if item.nodeid not in self._irrelevant]
        items[:] = sorted(relevant, key=lambda item: self._seconds.get(item.nodeid, math.inf))


class Recorder:
    """pytest plugin: which functions of one file each test calls; the test "" is every one.

    Those are imports, and what is kept from one test to the next: by fixtures, and by ``functools.cache``.
    """

    def __init__(self, path: Path) -> None:
        self._path = str(path)
        self._kept: frozenset[CodeType] = frozenset()
        self._test = ""
        self.calls: dict[str, set[int]] = defaultdict(set)

    def trace(self, frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if code.co_filename == self._path:
            self.calls["" if code in self._kept else self._test].add(code.co_firstlineno)

    def pytest_collection_finish(self) -> None:
        ours = [module for module in sys.modules.values() if getattr(module, "__file__", None) == self._path]
        values = [value for module in ours for value in vars(module).values()]
        self._kept = frozenset(value.__wrapped__.__code__ for value in values if hasattr(value, "cache_clear"))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self._test = item.nodeid
        try:
            return (yield)
        finally:
            self._test = ""

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Iterator[None]:
        test = self._test
        self._test = test if fixturedef.scope == "function" else ""
        try:
            return (yield)
        finally:
            self._test = test


class Stopwatch:
    """pytest plugin: the seconds of each test."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[report.nodeid] += report.duration


def preload(files: Sequence[str]) -> None:
    """Import the libraries that these test files import, and nothing of ours."""

    def look() -> tuple[int, list[str]]:
        code = _pytest(files, ["--collect-only"])
        loaded = [(name, getattr(module, "__file__", None) or "") for name, module in sys.modules.copy().items()]
        return code, [name for name, path in loaded if path and not path.startswith(_OURS)]

    code, names = _told(look)
    if code != 0:
        raise RuntimeError(f"pytest cannot even collect {', '.join(files)}: exit code {code}")
    for name in names:
        if name not in sys.modules:
            importlib.import_module(name)


def measure(path: Path, files: Sequence[str]) -> Baseline | None:
    """Run the tests of the unchanged module, once by the clock and once by the call; None if one fails."""

    def by_the_clock() -> tuple[int, dict[str, float]]:
        watch = Stopwatch()
        return _pytest(files, [], watch), watch.seconds

    def by_the_call() -> tuple[int, dict[str, list[int]]]:
        recorder = Recorder(path)
        sys.settrace(recorder.trace)
        code = _pytest(files, [], recorder)
        sys.settrace(None)
        return code, {test: sorted(lines) for test, lines in recorder.calls.items()}

    code, seconds = _told(by_the_clock)
    if code != 0:
        return None
    _, calls = _told(by_the_call)
    by_test = {test: frozenset(calls.get(test, [])) for test in seconds}
    return Baseline(seconds, by_test, frozenset(calls.get("", [])), math.ceil(10 + 4 * sum(seconds.values())))


def _told(ask: Callable[[], tuple[int, Any]]) -> tuple[int, Any]:
    """What ``ask`` returns in a child: an exit code, and something that JSON can carry."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "answer.json"

        def run() -> int:
            code, value = ask()
            answer.write_text(json.dumps(value))
            return code

        _, status = os.waitpid(fork(run, None), 0)
        return os.waitstatus_to_exitcode(status), json.loads(answer.read_text())


def start(module: str, path: Path, mutant: Mutant, files: Sequence[str], baseline: Baseline) -> int:
    """Fork a child that runs the tests against the mutant; its process id.

    The first file goes alone where every test is concerned: of small and fast tests, it spares importing the others.
    """

    def run() -> int:
        sys.meta_path.insert(0, MutatedFinder(module, path, mutated(path.read_text(encoding="utf-8"), mutant)))
        if len(files) > 1 and baseline.concerns_all(mutant):
            return _pytest(files[:1], ["-x"]) or _pytest(files[1:], ["-x"], Order(baseline, frozenset()))
        return _pytest(files, ["-x"], Order(baseline, baseline.irrelevant(mutant)))

    return fork(run, baseline.cpu_limit_s)


def outcome(status: int) -> str:
    """What a child's wait status says of its mutant: "survived", "killed" or "timeout"."""
    code = os.waitstatus_to_exitcode(status)
    if code in (-signal.SIGXCPU, -signal.SIGKILL):
        return "timeout"
    return "survived" if code in (0, _NO_TEST_REACHES_IT) else "killed"


def fork(run: Callable[[], int], cpu_limit_s: int | None) -> int:
    """A silent child that ends with what ``run`` returns; 98 if it raises, as a mutant that can't be imported does."""
    child = os.fork()
    if child:
        return child
    if cpu_limit_s is not None:
        resource.setrlimit(resource.RLIMIT_CPU, (cpu_limit_s, cpu_limit_s))
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    code = 98
    try:
        code = run()
    finally:
        os._exit(code)


def _pytest(files: Sequence[str], options: Sequence[str], *plugins: object) -> int:
    # No search for the smallest example: that it fails is all that is asked.
    phases = [hypothesis.Phase.explicit, hypothesis.Phase.generate]
    hypothesis.settings.register_profile("mutation", derandomize=True, database=None, deadline=None, phases=phases)
    fixed = ["-q", "--no-header", "--tb=no", "-p", "no:cacheprovider", "-p", "no:xdist", "--rootdir", str(ROOT)]
    # By option, since conftest.py loads a profile of its own before.
    fixed += ["--hypothesis-profile", "mutation", "-W", "ignore"]
    return int(pytest.main([*fixed, *options, *(str(TESTS / name) for name in files)], plugins=list(plugins)))

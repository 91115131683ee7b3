"""Runs the tests of a module with one change in it, each in a forked process: nothing on disk is changed.

The parent has imported every library that the tests need, and none of ours. One child of it collects the tests, runs
them once on the unchanged module to learn how long each takes and which functions it calls, and from then on forks for
each mutant of a function's body: the live function gets the mutated code, and those tests that call it run, the fastest
first, until one fails. What an import evaluates (tables, enums, default values) cannot be changed so late: for these
mutants a child of the parent imports the mutated module in place of the one that is there.
"""

import ast
import functools
import gc
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import inspect
import json
import math
import os
import resource
import signal
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType, FunctionType, ModuleType
from typing import Any

import hypothesis
import pytest
from mutants import Mutant, mutated

TESTS = Path(__file__).parents[1]
ROOT = TESTS.parent
_OURS = tuple(str(ROOT / folder) + os.sep for folder in ("pkxyz_ctrl", "hil", "sim", "tests"))
ENDLESS_S = 10.0  # more than four times what the tests take without a mutant
_NO_TEST_REACHES_IT = 5  # pytest's exit code when nothing was left to run


class BaselineError(Exception):
    """The tests fail without any mutant."""


@dataclass(frozen=True)
class Subject:
    """A module, where it is, and the test files that are about it, the smallest first."""

    module: str
    path: Path
    files: tuple[str, ...]

    def mutated(self, mutant: Mutant) -> ast.Module:
        return mutated(self.path.read_text(encoding="utf-8"), mutant)


@dataclass(frozen=True)
class Baseline:
    """What the unchanged module showed. ``calls``: the functions that a test calls, by their first lines.

    ``calls_of_all``: those that an import calls, and those whose results are kept, concern every test.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    calls: dict[str, frozenset[int]] = field(default_factory=dict)
    calls_of_all: frozenset[int] = frozenset()

    @classmethod
    def of(cls, measured: dict[str, Any]) -> "Baseline":
        seconds, calls = measured["seconds"], {test: frozenset(lines) for test, lines in measured["calls"].items()}
        return cls(seconds, {test: calls.get(test, frozenset()) for test in seconds}, calls.get("", frozenset()))

    def concerns_all(self, mutant: Mutant) -> bool:
        return mutant.function is None or mutant.function in self.calls_of_all or not self.seconds

    def callers(self, mutant: Mutant) -> list[str]:
        """Tests that call the mutant's function, the fastest first."""
        callers = [test for test, calls in self.calls.items() if mutant.function in calls]
        return sorted(callers, key=self.seconds.__getitem__)

    @property
    def cpu_limit_s(self) -> int:
        """Processor time after which a mutant counts as endless; a busy machine kills none."""
        return math.ceil(ENDLESS_S + 4 * sum(self.seconds.values())) if self.seconds else 300


def preload(files: Iterable[str]) -> None:
    """Import the libraries that these test files import, and nothing of ours."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "names"

        def look() -> int:
            code = _pytest(files, ["--collect-only"])
            loaded = [(name, getattr(module, "__file__", None) or "") for name, module in sys.modules.copy().items()]
            answer.write_text("\n".join(name for name, path in loaded if path and not path.startswith(_OURS)))
            return code

        if os.waitstatus_to_exitcode(os.waitpid(_fork(look), 0)[1]) != 0:
            raise BaselineError("the tests cannot even be collected")
        names = answer.read_text().split("\n")
    for name in names:
        if name not in sys.modules:
            importlib.import_module(name)


def run_mutants(
    subject: Subject, waiting: Sequence[Mutant], end_s: float, workers: int, unmeasured: bool = False
) -> Iterator[tuple[Mutant, str]]:
    """Each mutant with its outcome, as they finish; but for the first few, none begins
    after ``end_s`` of the monotonic clock.

    ``unmeasured``: a few mutants only; all tests meet them, in their own order, and nothing
    is run beforehand. Raises BaselineError.
    """
    baseline = Baseline()
    if not unmeasured:
        receiver, sender = os.pipe()
        child = _fork(Collected(subject, waiting, end_s, workers, sender).run)
        os.close(sender)
        with os.fdopen(receiver) as told:
            measured = next(told, None)
            if measured is None:
                raise BaselineError(f"{subject.module}: the tests fail without any mutant")
            baseline = Baseline.of(json.loads(measured))
            for place, result in map(json.loads, told):
                yield waiting[place], result
        os.waitpid(child, 0)
    late = [mutant for mutant in waiting if baseline.concerns_all(mutant)]
    for place, result in _outcomes(late, lambda mutant: _import_mutant(subject, mutant, baseline), end_s, workers):
        yield late[place], result


def _outcomes(
    jobs: Sequence[Mutant], begin: Callable[[Mutant], int], end_s: float, workers: int
) -> Iterator[tuple[int, str]]:
    """Place in ``jobs`` and outcome of each; ``begin`` forks and returns the process id.

    One for each worker is tried even when it is ``end_s`` already: what was measured for them has been paid for.
    """
    waiting = list(reversed(range(len(jobs))))
    running: dict[int, int] = {}
    begun = 0
    while running or (waiting and (begun < workers or time.monotonic() < end_s)):
        while waiting and len(running) < workers and (begun < workers or time.monotonic() < end_s):
            begun += 1
            place = waiting.pop()
            running[begin(jobs[place])] = place
        child, status = os.wait()
        if child in running:
            yield running.pop(child), _outcome(os.waitstatus_to_exitcode(status))


def _outcome(code: int) -> str:
    if code in (-signal.SIGXCPU, -signal.SIGKILL):
        return "timeout"
    return "survived" if code in (0, _NO_TEST_REACHES_IT) else "killed"


class Collected:
    """pytest plugin: instead of running the collected tests once, measures them, and forks for each mutant.

    Tells through the pipe ``sender``, a line of JSON each: what was measured; then place in ``waiting`` and outcome of
    each mutant whose function no import has called.
    """

    def __init__(self, subject: Subject, waiting: Sequence[Mutant], end_s: float, workers: int, sender: int) -> None:
        self._subject = subject
        self._waiting = waiting
        self._end_s = end_s
        self._workers = workers
        self._sender = sender
        self._path = str(subject.path)
        self._test = ""  # while importing: every one
        self._kept: set[CodeType] = set()
        self._calls: dict[str, set[int]] = defaultdict(set)

    def run(self) -> int:
        sys.settrace(self._trace)
        return _pytest(self._subject.files, [], self)

    def _trace(self, frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if code.co_filename == self._path:
            self._calls["" if code in self._kept else self._test].add(code.co_firstlineno)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        sys.settrace(None)
        with tempfile.TemporaryDirectory() as folder:
            answer = Path(folder) / "answer"
            _, status = os.waitpid(_fork(lambda: self._measure(session, answer)), 0)
            if status != 0:
                return True
            measured = json.loads(answer.read_text())
        self._tell(measured)
        baseline = Baseline.of(measured)
        places = [place for place, mutant in enumerate(self._waiting) if not baseline.concerns_all(mutant)]
        items = {item.nodeid: item for item in session.items}
        live = self._live_functions()

        def begin(mutant: Mutant) -> int:
            def run() -> int:
                code = _code_at(compile(self._subject.mutated(mutant), self._path, "exec"), mutant.function)
                for function in live[mutant.function]:
                    function.__code__ = code
                return _first_failure(session, [items[test] for test in baseline.callers(mutant)])

            return _fork(run, baseline.cpu_limit_s)

        jobs = [self._waiting[place] for place in places]
        for place, result in _outcomes(jobs, begin, self._end_s, self._workers):
            self._tell([places[place], result])
        return True

    def _measure(self, session: pytest.Session, answer: Path) -> int:
        """Run all tests; write the seconds of each, and the functions that it calls. 1 if one fails.

        What ``functools.cache`` keeps from one test to the next concerns every test.
        """
        caches = [value for value in gc.get_objects() if type(value) is functools._lru_cache_wrapper]
        functions = [cache.__wrapped__ for cache in caches]
        self._kept = {function.__code__ for function in functions if isinstance(function, FunctionType)}
        seconds = {}
        sys.settrace(self._trace)
        for item in session.items:
            self._test, begin_s = item.nodeid, time.process_time()
            if _first_failure(session, [item]):
                return 1
            seconds[self._test] = time.process_time() - begin_s
        sys.settrace(None)
        calls = {test: sorted(lines) for test, lines in self._calls.items()}
        answer.write_text(json.dumps({"seconds": seconds, "calls": calls}))
        return 0

    def _live_functions(self) -> dict[int | None, list[FunctionType]]:
        """Every function of the module that there is, by its first line: plain, method, wrapped or registered."""
        found: dict[int | None, list[FunctionType]] = defaultdict(list)
        for value in gc.get_objects():
            if type(value) is FunctionType and value.__code__.co_filename == self._path:
                found[value.__code__.co_firstlineno].append(value)
        return found

    def _tell(self, value: Any) -> None:
        os.write(self._sender, json.dumps(value).encode() + b"\n")


def _code_at(code: CodeType, line: int | None) -> CodeType:
    """The function that begins in that line, in the code of a module or of a class."""
    waiting = [code]
    for outer in waiting:
        for inner in outer.co_consts:
            if isinstance(inner, CodeType):
                if inner.co_firstlineno == line and inner.co_flags & inspect.CO_OPTIMIZED:  # no class
                    return inner
                waiting.append(inner)
    raise LookupError(f"no function begins in line {line}")


def _first_failure(session: pytest.Session, items: Sequence[pytest.Item]) -> int:
    for item in items:
        session.config.hook.pytest_runtest_protocol(item=item, nextitem=None)
        if session.testsfailed:
            return 1
    return 0


def _import_mutant(subject: Subject, mutant: Mutant, baseline: Baseline) -> int:
    """Fork a child that imports the mutant, and runs first the first file alone: it may spare importing the others."""

    def run() -> int:
        sys.meta_path.insert(0, MutatedFinder(subject.module, subject.path, subject.mutated(mutant)))
        first, rest = subject.files[:1], subject.files[1:]
        return _pytest(first, ["-x"]) or (_pytest(rest, ["-x"], Order(baseline)) if rest else 0)

    return _fork(run, baseline.cpu_limit_s)


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
    """pytest plugin: fast tests first, those with a new name (a mutated enum) last."""

    def __init__(self, baseline: Baseline) -> None:
        self._seconds = baseline.seconds

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items.sort(key=lambda item: self._seconds.get(item.nodeid, math.inf))


def _fork(run: Callable[[], int], cpu_limit_s: int | None = None) -> int:
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


def _pytest(files: Iterable[str], options: Sequence[str], *plugins: object) -> int:
    # No search for the smallest example: that it fails is all that is asked.
    phases = [hypothesis.Phase.explicit, hypothesis.Phase.generate]
    # No deadline: a busy machine, or the tracing of the first run, would fail an example that is well.
    hypothesis.settings.register_profile("mutation", derandomize=True, database=None, phases=phases, deadline=None)
    fixed = ["-q", "--no-header", "--tb=no", "-p", "no:cacheprovider", "-p", "no:xdist", "--rootdir", str(ROOT)]
    # By option, since conftest.py loads a profile of its own before.
    fixed += ["--hypothesis-profile", "mutation", "-W", "ignore"]
    return int(pytest.main([*fixed, *options, *(str(TESTS / name) for name in files)], plugins=list(plugins)))

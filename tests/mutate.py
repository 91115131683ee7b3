"""Mutation testing of what stands between a mistake and 200 V: ``make mutate``, or ``python tests/mutate.py --help``.

Each mutant is run in a forked process, with the compiler off, against the tests that are about its module. Nothing on
disk is changed: the process imports the mutated module in place of the one that is there. First the unchanged modules
must pass. What was killed is remembered in runs/ as long as the module stays as it is, so that a run can be continued.
Survivors that are equivalent, with the reason, are listed in mutation_survivors.toml.
"""

import argparse
import ast
import hashlib
import importlib.abc
import importlib.machinery
import importlib.util
import json
import os
import random
import re
import resource
import signal
import sys
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, ModuleType

from mutants import Mutant, mutants, mutated

TESTS = Path(__file__).parent
ROOT = TESTS.parent
SURVIVORS = TESTS / "mutation_survivors.toml"
REPORT = ROOT / "docs" / "mutation.md"
STATE = ROOT / "runs" / "mutation.json"
SEED = 1
MUTANT_CPU_S = 90  # of processor time, five times the slowest of these test files; a busy machine kills no mutant

# In the order in which they kill: fast and exact ones first.
TARGETS = {
    "pkxyz_ctrl.safety.gate": ("test_safety_gate.py", "test_safety_gate_sweep.py"),
    "pkxyz_ctrl.safety.sdo_rules": ("test_safety_gate.py", "test_safety_gate_sweep.py"),
    "pkxyz_ctrl.safety.modes": ("test_safety_modes.py",),
    "pkxyz_ctrl.safety.monitors": ("test_safety_monitors.py",),
    "pkxyz_ctrl.safety.trips": ("test_safety_monitors.py", "test_safety_modes.py"),
    "pkxyz_ctrl.core.voltage": ("test_core_voltage.py",),
    "pkxyz_ctrl.can.codec": ("test_can_codec.py",),
}
EXTRA_TESTS = "test_safety_pinned.py"  # numbers that are contracts; fast, and part of every run


@dataclass(frozen=True)
class Job:
    module: str
    mutant: Mutant | None  # None: unchanged

    @property
    def path(self) -> Path:
        return ROOT / (self.module.replace(".", "/") + ".py")


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


def run_tests(job: Job) -> int:
    """In the child: pytest's exit code."""
    import hypothesis
    import pytest

    # No search for the smallest example: that it fails is all that is asked.
    phases = [hypothesis.Phase.explicit, hypothesis.Phase.generate]
    hypothesis.settings.register_profile("mutation", derandomize=True, database=None, deadline=None, phases=phases)
    hypothesis.settings.load_profile("mutation")
    if job.mutant is not None:
        tree = mutated(job.path.read_text(encoding="utf-8"), job.mutant)
        sys.meta_path.insert(0, MutatedFinder(job.module, job.path, tree))
    files = [str(TESTS / name) for name in (EXTRA_TESTS, *TARGETS[job.module]) if (TESTS / name).exists()]
    return int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-p", "no:randomly", *files]))


def start(job: Job) -> int:
    """Fork a child that runs the job; its process id."""
    child = os.fork()
    if child:
        return child
    resource.setrlimit(resource.RLIMIT_CPU, (MUTANT_CPU_S, MUTANT_CPU_S))
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    code = 99
    try:
        code = run_tests(job)
    except BaseException:
        code = 98  # a mutant that cannot even be imported is killed as well
    finally:
        os._exit(code)


def run_jobs(jobs: list[Job], seconds: float, workers: int) -> dict[Job, str]:
    """Outcome of each job that was finished in time: "survived", "killed" or "timeout"."""
    waiting = list(reversed(jobs))
    running: dict[int, Job] = {}
    outcomes: dict[Job, str] = {}
    end_s = time.monotonic() + seconds
    while running or (waiting and time.monotonic() < end_s):
        while waiting and len(running) < workers and time.monotonic() < end_s:
            job = waiting.pop()
            running[start(job)] = job
        child, status = os.waitpid(-1, os.WNOHANG) if running else (0, 0)
        if child in running:
            job = running.pop(child)
            code = os.waitstatus_to_exitcode(status)
            endless = code in (-signal.SIGXCPU, -signal.SIGKILL)
            outcomes[job] = "timeout" if endless else "survived" if code == 0 else "killed"
            _tell(job, outcomes[job], len(outcomes), len(jobs))
        else:
            time.sleep(0.01)
    return outcomes


def _tell(job: Job, outcome: str, done: int, total: int) -> None:
    if outcome != "killed":
        line = job.mutant.line if job.mutant else 0
        change = job.mutant.change if job.mutant else "unchanged"
        print(f"{done}/{total} {outcome}: {job.module}:{line}: {_one_line(change)}", flush=True)


def _one_line(text: str) -> str:
    return re.sub(r"\s+", " ", text)


def load_killed(jobs: list[Job]) -> dict[Job, str]:
    """What earlier runs killed, of modules that have not changed since."""
    if not STATE.exists():
        return {}
    state = json.loads(STATE.read_text(encoding="utf-8"))
    return {job: state[name] for job in jobs if (name := _name(job)) in state}


def save_killed(outcomes: dict[Job, str]) -> None:
    """Add to what is known."""
    known = json.loads(STATE.read_text(encoding="utf-8")) if STATE.exists() else {}
    known |= {_name(job): outcome for job, outcome in outcomes.items() if outcome != "survived"}
    STATE.parent.mkdir(parents=True, exist_ok=True)
    STATE.write_text(json.dumps(known), encoding="utf-8")


def _name(job: Job) -> str:
    assert job.mutant is not None
    digest = hashlib.sha256(job.path.read_bytes()).hexdigest()[:16]
    return f"{job.module} {digest} {job.mutant.place} {job.mutant.number}"


def known_survivors() -> dict[tuple[str, str, str], str]:
    """Reasons by (module, text of the source line, change)."""
    if not SURVIVORS.exists():
        return {}
    entries = tomllib.loads(SURVIVORS.read_text(encoding="utf-8")).get("survivor", [])
    return {(entry["module"], entry["line"], entry["change"]): entry["reason"] for entry in entries}


def key_of(job: Job, source_lines: list[str]) -> tuple[str, str, str]:
    """How a mutant is called in mutation_survivors.toml: by text, since line numbers move."""
    assert job.mutant is not None
    return job.module, source_lines[job.mutant.line - 1].strip(), _one_line(job.mutant.change)


def report(all_jobs: list[Job], outcomes: dict[Job, str], seconds: float) -> tuple[str, int]:
    """The text of docs/mutation.md, and how many survivors have no reason."""
    reasons = known_survivors()
    lines_of = {job.path: job.path.read_text(encoding="utf-8").splitlines() for job in all_jobs}
    rows, survivors, unexplained = [], [], 0
    for module in TARGETS:
        made = [job for job in all_jobs if job.module == module]
        tried = [job for job in made if job in outcomes]
        lived = [job for job in tried if outcomes[job] == "survived"]
        slow = sum(outcomes[job] == "timeout" for job in tried)
        rows.append(f"| `{module}` | {len(made)} | {len(tried)} | {len(tried) - len(lived)} ({slow}) | {len(lived)} |")
        for job in lived:
            assert job.mutant is not None
            reason = reasons.get(key_of(job, lines_of[job.path]))
            unexplained += reason is None
            change = _one_line(job.mutant.change).replace("|", "\\|")
            survivors.append(f"| `{module}`:{job.mutant.line} | `{change}` | {reason or '**none yet**'} |")
    total, tried_total = len(all_jobs), len(outcomes)
    killed = sum(outcome != "survived" for outcome in outcomes.values())
    table = "\n".join(rows)
    listed = "\n".join(survivors) or "| none | | |"
    return (
        f"""# Mutation testing

`make mutate` changes one thing at a time in the code that stands between a mistake and 200 V, and asks whether a test
notices: comparisons, arithmetic, `and` / `or` / `not`, numbers, what is returned, statements left out.
`tests/mutants.py` makes the mutants, `tests/mutate.py` runs them, compiler off, nothing on disk changed. It ends with
exit code 1 if a survivor has no reason in `tests/mutation_survivors.toml`. A run can be continued: what was killed is
remembered as long as the module stays as it is.

State after the last run with `--report` (seed {SEED}, {seconds:.0f} s): **{tried_total} of {total} mutants tried**,
drawn at random and evenly over the modules, **{killed} killed, {tried_total - killed} survived, {unexplained} of them
without a reason**. The others have not been tried.

| module | mutants | tried | killed (by time-out) | survived |
|---|---|---|---|---|
{table}

## Survivors

| where | change | why it may live |
|---|---|---|
{listed}
""",
        unexplained,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=1200.0, help="stop beginning new mutants after so long")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--module", action="append", help="only this module, e.g. pkxyz_ctrl.core.voltage")
    parser.add_argument("--match", default="", help="only mutants whose change contains this text")
    parser.add_argument("--fresh", action="store_true", help="forget what earlier runs killed")
    parser.add_argument("--report", action="store_true", help="write docs/mutation.md")
    arguments = parser.parse_args()
    os.environ["NUMBA_DISABLE_JIT"] = "1"
    sys.path.insert(0, str(TESTS))
    for heavy in ("numba", "hypothesis", "pytest", "numpy", "pydantic", "crccheck.crc", "can", "canopen", "cantools"):
        importlib.import_module(heavy)  # once, before the forks
    modules = arguments.module or list(TARGETS)
    failed = [
        job for job, outcome in run_jobs([Job(m, None) for m in modules], 600, 2).items() if outcome != "survived"
    ]
    if failed:
        print("the tests fail without any mutant:", ", ".join(job.module for job in failed))
        return 2
    jobs = [Job(m, mutant) for m in modules for mutant in mutants(Job(m, None).path.read_text(encoding="utf-8"))]
    jobs = [job for job in jobs if job.mutant is not None and arguments.match in job.mutant.change]
    begin_s = time.monotonic()
    known = {} if arguments.fresh else load_killed(jobs)
    outcomes = known | run_jobs([job for job in drawn(jobs) if job not in known], arguments.seconds, arguments.workers)
    save_killed(outcomes)
    text, unexplained = report(jobs, outcomes, time.monotonic() - begin_s)
    if arguments.report:
        REPORT.write_text(text, encoding="utf-8")
    killed = sum(outcome != "survived" for outcome in outcomes.values())
    print(f"{len(outcomes)} of {len(jobs)} tried, {killed} killed, {unexplained} survivors without a reason")
    return 1 if unexplained else 0


def drawn(jobs: list[Job]) -> list[Job]:
    """Shuffled so that whenever time is over, each module has had the same share of its mutants."""
    rng = random.Random(SEED)
    ranked = []
    for module in dict.fromkeys(job.module for job in jobs):
        own = [job for job in jobs if job.module == module]
        rng.shuffle(own)
        ranked += [((place + 0.5) / len(own), job) for place, job in enumerate(own)]
    return [job for _, job in sorted(ranked, key=lambda pair: pair[0])]


if __name__ == "__main__":
    sys.exit(main())

"""Mutation testing of what stands between a mistake and 200 V: ``make mutate``; options: ``mutate.py --help``.

Every outcome is written to outcomes.jsonl at once, so that a run that was stopped goes on where it was, here or from a
commit: what was killed is known as long as the module stays as it is, what survived as long as its tests do as well.
Survivors that are equivalent, with the reason, are listed in mutation_survivors.toml.
"""

import argparse
import hashlib
import json
import os
import random
import re
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from mutants import Mutant, mutants
from mutation_run import ROOT, TESTS, BaselineError, Subject, preload, run_mutants

SURVIVORS = TESTS / "mutation" / "mutation_survivors.toml"
REPORT = ROOT / "docs" / "lookup" / "mutation.md"
STATE = TESTS / "mutation" / "outcomes.jsonl"
SEED = 1
FEW = 8  # mutants, for which it does not pay to measure the tests beforehand

# The modules, and the tests that are about them. Before each come numbers that are contracts: fast, and soon imported.
PINNED = "safety/test_safety_pinned.py"
_GATE = (
    "safety/test_output_frames.py",
    *(f"safety/test_safety_gate{part}.py" for part in ("_reasons", "", "_traffic", "_sweep")),
)
_START_PARTS = ("start_plan", "start_conditions", "driver_at_work", "sdo", "driver_start", "driver")
_START = tuple(f"can/test_can_{part}.py" for part in _START_PARTS)
_DRIVER = tuple(f"can/test_can_driver{part}.py" for part in ("_conditions", "_at_work", "_start", ""))
_NODE_PARTS = ("pdo", "conditions", "release", "restart", "sync", "nmt", "heartbeat", "emergency")
_NODE = tuple(f"node/test_node_{part}.py" for part in _NODE_PARTS)
TARGETS = {
    "pkxyz_ctrl.safety.gate": _GATE,
    "pkxyz_ctrl.safety.gate_rules": _GATE,
    "pkxyz_ctrl.safety.sdo_rules": _GATE,
    "pkxyz_ctrl.safety.modes": ("safety/test_safety_modes.py",),
    "pkxyz_ctrl.safety.monitors": ("safety/test_safety_monitors.py", "safety/test_safety_misfit.py"),
    "pkxyz_ctrl.safety.thresholds": ("safety/test_safety_monitors.py", "safety/test_safety_misfit.py"),
    "pkxyz_ctrl.safety.trips": ("safety/test_safety_monitors.py", "safety/test_safety_modes.py"),
    "pkxyz_ctrl.core.voltage": ("core/test_core_voltage.py",),
    "pkxyz_ctrl.core.allocation": ("core/test_core_allocation.py",),
    "pkxyz_ctrl.can.process_pdo": ("can/test_can_codec.py",),
    "pkxyz_ctrl.can.codec": ("can/test_can_codec.py",),
    "pkxyz_ctrl.can.sense_input": ("can/test_can_sense.py",),
    "pkxyz_ctrl.can.driver": (*_DRIVER, "can/test_can_start_conditions.py", "can/test_can_sdo.py"),
    "pkxyz_ctrl.can.driver_rules": (*_DRIVER, "can/test_can_start_conditions.py"),
    "pkxyz_ctrl.can.sdo": ("can/test_can_sdo.py", "can/test_can_start_plan.py", "can/test_can_start_conditions.py"),
    "pkxyz_ctrl.can.start_plan": _START,
    "pkxyz_ctrl.can.start_sequence": _START,
    "pkxyz_ctrl.loop.exchange": ("loop/exchange/test_exchange.py", "loop/exchange/test_room.py"),
    "pkxyz_ctrl.loop.controller": ("loop/exchange/test_controller_alone.py",),
    "pkxyz_ctrl.learning.store": ("learning/test_learning_store.py", "learning/test_learning.py"),
    "hil.node.drive": (*_NODE, "node/test_node_rules.py"),
    "hil.node.amplifier": ("node/test_node_outputs.py", *_NODE, "node/test_node_sdo.py"),
    "hil.node.rules": ("node/test_node_rules.py", "node/test_node_rules_at_rest.py"),
    "hil.recording.journal": ("recording/test_recording.py",),
}


@dataclass(frozen=True)
class Job:
    module: str
    mutant: Mutant

    @property
    def path(self) -> Path:
        return path_of(self.module)


def path_of(module: str) -> Path:
    return ROOT / (module.replace(".", "/") + ".py")


def subject_of(module: str) -> Subject:
    return Subject(module, path_of(module), (PINNED, *TARGETS[module]))


def jobs_of(module: str, match: str) -> list[Job]:
    """Mutants of one module whose line or change contains ``match``."""
    source = path_of(module).read_text(encoding="utf-8")
    lines = source.splitlines()
    return [
        Job(module, mutant)
        for mutant in mutants(source)
        if match in mutant.change or match in lines[mutant.line - 1] or match == str(mutant.line)
    ]


def run_jobs(jobs: list[Job], end_s: float, workers: int) -> Iterator[tuple[Job, str]]:
    """Each job with its outcome; until ``end_s`` of the monotonic clock, each module has its share of the time. However
    short that is, some are tried.

    Shuffled, so that if the time is not enough, what was tried stands for the rest.
    """
    if jobs:
        preload(sorted({file for job in jobs for file in subject_of(job.module).files}))
    left = len(jobs)
    for module in dict.fromkeys(job.module for job in jobs):
        own = [job.mutant for job in jobs if job.module == module]
        random.Random(SEED).shuffle(own)
        now_s = time.monotonic()
        if now_s >= end_s and left < len(jobs):
            return  # some were tried; the modules that are left come in the next run
        until_s = now_s + (end_s - now_s) * len(own) / left
        left -= len(own)
        for mutant, result in run_mutants(subject_of(module), own, until_s, workers, len(own) <= FEW):
            yield Job(module, mutant), result


class State:
    """Outcomes of this run and those before, a line of JSON each."""

    def __init__(self, fresh: bool) -> None:
        if fresh:
            STATE.unlink(missing_ok=True)
        lines = STATE.read_text(encoding="utf-8").splitlines() if STATE.exists() else []
        self._known = dict(map(json.loads, lines))

    def known(self, jobs: list[Job]) -> dict[Job, str]:
        """Killed by these or other tests, or survived just these."""
        found = {}
        for job in jobs:
            if (killed := self._known.get(_name(job))) is not None:
                found[job] = killed
            elif (survived := self._known.get(_name_with_tests(job))) is not None:
                found[job] = survived
        return found

    def add(self, job: Job, result: str) -> None:
        name = _name_with_tests(job) if result == "survived" else _name(job)
        self._known[name] = result
        with STATE.open("a", encoding="utf-8") as file:
            file.write(json.dumps([name, result]) + "\n")

    def tidy(self, jobs: list[Job]) -> None:
        """Keep of the file what is known of ``jobs``, in their order: no longer what modules were before."""
        names = [name for job in jobs for name in (_name(job), _name_with_tests(job)) if name in self._known]
        fresh = STATE.with_suffix(".part")
        fresh.write_text("".join(json.dumps([name, self._known[name]]) + "\n" for name in names), encoding="utf-8")
        fresh.replace(STATE)


def _name(job: Job) -> str:
    return f"{job.module} {_digest(job.path)} {job.mutant.place} {job.mutant.number}"


def _name_with_tests(job: Job) -> str:
    helpers = [TESTS / "conftest.py", *(TESTS / "rigs").glob("*.py")]
    return f"{_name(job)} {_digest(*sorted(helpers), *(TESTS / name for name in subject_of(job.module).files))}"


@cache
def _digest(*paths: Path) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def one_line(text: str) -> str:
    return re.sub(r"\s+", " ", text)


def known_survivors() -> dict[tuple[str, str, str], tuple[str, int]]:
    """Reason and how many there may be, by (module, text of the source line, change)."""
    entries = tomllib.loads(SURVIVORS.read_text(encoding="utf-8")).get("survivor", [])
    return {
        (entry["module"], entry["line"], entry["change"]): (entry["reason"], entry.get("times", 1)) for entry in entries
    }


def key_of(job: Job) -> tuple[str, str, str]:
    """How a mutant is called in mutation_survivors.toml: by text, since line numbers move."""
    line = job.path.read_text(encoding="utf-8").splitlines()[job.mutant.line - 1]
    return job.module, line.strip(), one_line(job.mutant.change)


def report(jobs: list[Job], outcomes: dict[Job, str]) -> tuple[str, int]:
    """The text of docs/lookup/mutation.md, and how many survivors have no reason."""
    reasons = known_survivors()
    met: Counter[tuple[str, str, str]] = Counter()
    rows, unexplained = [], []
    for module in TARGETS:
        made = [job for job in jobs if job.module == module]
        tried = [job for job in made if job in outcomes]
        lived = [job for job in tried if outcomes[job] == "survived"]
        slow = sum(outcomes[job] == "timeout" for job in tried)
        untried = f", {len(made) - len(tried)} untried" if len(tried) < len(made) else ""
        late = f", {slow} by time-out" if slow else ""
        rows.append(f"| `{module}` | {len(tried) - len(lived)} of {len(tried)}{late}{untried} |")
        for job in lived:
            key = key_of(job)
            met[key] += 1
            if met[key] > reasons.get(key, ("", 0))[1]:
                change = one_line(job.mutant.change).replace("|", "\\|")
                unexplained.append(f"- `{module}`:{job.mutant.line} `{change}`")
    killed = sum(result != "survived" for result in outcomes.values())
    table = "\n".join(rows)
    listed = "\n".join(["", "Without a reason:", "", *unexplained, ""]) if unexplained else ""
    return (
        f"""# Mutation testing

`make mutate` changes one thing at a time in the code that stands between a mistake and 200 V, and asks whether a test
notices. It ends with exit code 1 if a survivor has no reason in `tests/mutation/mutation_survivors.toml`.

Last result: **{len(outcomes)} of {len(jobs)} mutants tried, {killed} killed, {len(outcomes) - killed} survived,
{len(unexplained)} of them without a reason.**

| module | killed |
|---|---|
{table}
{listed}""",
        len(unexplained),
    )


def tried_by(text: str) -> int:
    """How many mutants a report tells of; 0 if it is none."""
    found = re.search(r"\*\*(\d+) of \d+ mutants tried", text)
    return int(found[1]) if found else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=1200.0, help="stop beginning new mutants after so long")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--module", action="append", help="only this module, e.g. pkxyz_ctrl.core.voltage")
    parser.add_argument(
        "--match",
        default="",
        help="only mutants with this in line or change, or as line number",
    )
    parser.add_argument("--fresh", action="store_true", help="forget what earlier runs found")
    parser.add_argument("--report", action="store_true", help="write docs/lookup/mutation.md")
    arguments = parser.parse_args()
    begin_s = time.monotonic()
    modules = arguments.module or list(TARGETS)
    jobs = [job for module in modules for job in jobs_of(module, arguments.match)]
    state = State(arguments.fresh)
    outcomes = state.known(jobs)
    waiting = [job for job in jobs if job not in outcomes]
    for job, result in run_jobs(waiting, begin_s + arguments.seconds, arguments.workers):
        outcomes[job] = result
        state.add(job, result)
        if result != "killed":
            where = f"{job.module}:{job.mutant.line}"
            print(f"{len(outcomes)}/{len(jobs)} {result}: {where}: {one_line(job.mutant.change)}", flush=True)
    if modules == list(TARGETS) and not arguments.match:
        state.tidy(jobs)
    text, unexplained = report(jobs, outcomes)
    if arguments.report:
        said = REPORT.read_text(encoding="utf-8") if REPORT.exists() else ""
        if len(outcomes) == len(jobs) or len(outcomes) >= tried_by(said):
            REPORT.write_text(text, encoding="utf-8")
        else:
            print(f"{REPORT.name} stays as it is: it tells of {tried_by(said)} mutants, this run of {len(outcomes)}")
    killed = sum(result != "survived" for result in outcomes.values())
    print(
        f"{len(outcomes)} of {len(jobs)} tried, {killed} killed, {unexplained} survivors without a reason, "
        f"{time.monotonic() - begin_s:.0f} s"
    )
    return 1 if unexplained else 0


if __name__ == "__main__":
    # Before numba is imported, and so that sets of strings have one order: the same mutants die in every run.
    fixed = {"NUMBA_DISABLE_JIT": "1", "PYTHONHASHSEED": "0"}
    if any(os.environ.get(name) != value for name, value in fixed.items()):
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | fixed)
    try:
        sys.exit(main())
    except BaselineError as error:
        sys.exit(f"mutate: {error}")

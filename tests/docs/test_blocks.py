"""What README and docs show is executed, by the installed wheel: each page's blocks in order, in a folder of its own.

A block that can't run here says why, and its commands and options are still checked.
"""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from _pytest.mark import ParameterSet
from fenced_blocks import Block, blocks, commands_of, inline_commands
from generated_pages import commands
from installed_wheel import install

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "benchmarks" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
IDS = [page.relative_to(ROOT).as_posix() for page in PAGES]
COMMANDS = dict(commands())
AT_RATE = ("pkxyz plant", "pkxyz serve", "pkxyz operate", "pkxyz demo", "pkxyz latency", "--bus unix", "connect[(]")


def runs(page: Path) -> list[Block]:
    return [b for b in blocks(page) if b.language in ("sh", "python") and b.reason is None]


def marked(page: Path) -> ParameterSet:
    """A page for a test, at rate where one of its commands is."""
    at_rate = re.search("|".join(AT_RATE), "".join(b.text for b in runs(page)))
    name = page.relative_to(ROOT).as_posix()
    return pytest.param(page, id=name, marks=[pytest.mark.at_rate] if at_rate else [])


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a user who has installed the wheel."""
    return install(tmp_path_factory.mktemp("user")) | {"COLUMNS": "120", "OPENBLAS_NUM_THREADS": "1"}


@pytest.mark.slow
def test_what_runs_is_the_wheel(env: dict[str, str], tmp_path: Path) -> None:
    for module in ("hil", "pkxyz_ctrl", "sim"):
        code = f"import {module}; print({module}.__file__)"
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True, check=True
        )
        assert Path(done.stdout.strip()).is_relative_to(env["PYTHONPATH"])
    done = subprocess.run(["pkxyz", "configs"], cwd=tmp_path, env=env, capture_output=True, text=True, check=True)
    assert env["PYTHONPATH"] in done.stdout.replace("\n", "")
    assert str(ROOT) not in done.stdout.replace("\n", "")


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("page", [marked(p) for p in PAGES if runs(p)])
def test_the_blocks_of_a_page_run_in_order(page: Path, env: dict[str, str], tmp_path: Path) -> None:
    for block in runs(page):
        interpreter = [sys.executable, "-"] if block.language == "python" else ["bash", "-euo", "pipefail"]
        done = subprocess.run(
            interpreter,
            input=block.text,
            cwd=tmp_path,
            env=env,
            capture_output=True,
            text=True,
            check=False,
            timeout=1200,  # of kernels that are compiled on a busy machine
        )
        where = f"{page.relative_to(ROOT)}:{block.line}"
        assert done.returncode == 0, f"{where}\n{block.text}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
        assert "Traceback" not in done.stderr, f"{where}\n{done.stderr[-2000:]}"


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_a_comment_beside_a_command_fits_a_window(page: Path) -> None:
    lines = [line for b in blocks(page) for line in b.text.splitlines() if re.search(r"\S\s+# ", line)]
    assert [line for line in lines if len(line) > 100] == []


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_tables_of_configuration_are_toml(page: Path) -> None:
    for block in blocks(page):
        if block.language == "toml" and block.reason is None:
            assert tomllib.loads(block.text), f"{page.relative_to(ROOT)}:{block.line}"


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_no_command_hides_in_a_block_that_is_only_shown(page: Path) -> None:
    for block in blocks(page):
        if block.language not in ("sh", "python", "toml") and block.reason is None:
            first = [line.removeprefix("$ ").split(" ")[0] for line in block.text.splitlines() if line.strip()]
            hidden = {"pkxyz", "make", "pip", "python", "import", "from", "ip"}.intersection(first)
            assert not hidden, f"{page.relative_to(ROOT)}:{block.line}: mark the block sh or python, or say why not"
        assert block.reason is None or len(block.reason.split()) >= 3, f"{page.relative_to(ROOT)}:{block.line}"


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_commands_and_options_exist_also_where_they_are_not_run(page: Path) -> None:
    shown = [c for b in blocks(page) if b.language == "sh" for c in commands_of(b.text)] + inline_commands(page)
    for command in shown:
        words = command.split()[1:]
        if words[0].startswith("-"):
            continue
        name = next((n for n in (words[0], " ".join(words[:2])) if n in COMMANDS), None)
        assert name is not None, f"{page.relative_to(ROOT)}: {command}: no such command"
        options = {o for p in COMMANDS[name].params for o in p.opts} | {"-h", "--help"}
        given = {w.partition("=")[0].strip("[](),.") for w in words if w.lstrip("[(").startswith("-") and len(w) > 1}
        assert not {g for g in given if g[1:2].isalpha() or g[2:3].isalpha()} - options, (
            f"{page.relative_to(ROOT)}: {command}"
        )


def test_blocks_are_found_with_their_reasons(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "a\n\n<!-- not run: needs an adapter -->\n```sh\npkxyz run # x\n```\n\n```python\n1 / 0\n```\n`pkxyz sil`\n"
    )
    first, second = blocks(page)
    assert (first.line, first.language, first.reason) == (4, "sh", "needs an adapter")
    assert (second.text, second.reason) == ("1 / 0\n", None)
    assert commands_of("pkxyz a --b \\\n  c | tee x\n# pkxyz no\n$ pkxyz d") == ["pkxyz a --b    c", "pkxyz d"]
    assert inline_commands(page) == ["pkxyz sil"]

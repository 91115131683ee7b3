"""What README and docs show is executed: each page's blocks in order, in a folder of its own outside of the checkout.

A block that can't run here says why, and its commands and options are still checked.
"""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from fenced_blocks import Block, blocks, commands_of, inline_commands
from generated_pages import commands

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "benchmarks" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
IDS = [page.relative_to(ROOT).as_posix() for page in PAGES]
COMMANDS = dict(commands())


def runs(page: Path) -> list[Block]:
    return [b for b in blocks(page) if b.language in ("sh", "python") and b.reason is None]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An empty folder, with ``pkxyz`` of this checkout in a folder beside it, as if installed."""
    (tmp_path / "bin").mkdir()
    command = tmp_path / "bin" / "pkxyz"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m hil.cli "$@"\n', encoding="utf-8")
    command.chmod(0o755)
    (tmp_path / "work").mkdir()
    return tmp_path / "work"


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if runs(p)], ids=lambda p: p.relative_to(ROOT).as_posix())
def test_the_blocks_of_a_page_run_in_order(page: Path, folder: Path) -> None:
    path = os.pathsep.join((str(folder.parent / "bin"), str(Path(sys.executable).parent), os.environ["PATH"]))
    env = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "COLUMNS": "120", "OPENBLAS_NUM_THREADS": "1"}
    for block in runs(page):
        interpreter = [sys.executable, "-"] if block.language == "python" else ["bash", "-euo", "pipefail"]
        done = subprocess.run(
            interpreter, input=block.text, cwd=folder, env=env, capture_output=True, text=True, check=False, timeout=300
        )
        where = f"{page.relative_to(ROOT)}:{block.line}"
        assert done.returncode == 0, f"{where}\n{block.text}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
        assert "Traceback" not in done.stderr, f"{where}\n{done.stderr[-2000:]}"


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

"""Fenced blocks and inline code of a Markdown page.

Blocks marked ``sh`` and ``python`` run, those marked ``toml`` are read, the others (output, drawings) are shown only.
``<!-- not run: REASON -->`` on the line before a block says why it is not run.
"""

import re
from dataclasses import dataclass
from pathlib import Path

_FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_REASON = re.compile(r"<!-- not run: (.+?) -->\s*$")
_INLINE = re.compile(r"`(pkxyz [^`\n]+)`")


@dataclass(frozen=True)
class Block:
    """One fenced block, with the line on which it begins, counted from 1."""

    line: int
    language: str
    text: str
    reason: str | None
    """why it is not run; None if it is"""


def blocks(page: Path) -> list[Block]:
    """All blocks of a page in order."""
    text = page.read_text(encoding="utf-8")
    found = []
    for match in _FENCE.finditer(text):
        before = text[: match.start()]
        reason = _REASON.search(before)
        found.append(Block(before.count("\n") + 1, match[1], match[2], reason[1] if reason else None))
    return found


def commands_of(text: str) -> list[str]:
    """Commands ``pkxyz ...`` in a shell block, continuation lines joined, comments and what follows a pipe cut off."""
    lines = text.replace("\\\n", " ").splitlines()
    starts = (re.match(r"(?:\$ )?(?:sudo )?(pkxyz [^#|&;>]*)", line.strip()) for line in lines)
    return [match[1].strip() for match in starts if match]


def inline_commands(page: Path) -> list[str]:
    """Commands ``pkxyz ...`` in the running text."""
    return _INLINE.findall(_FENCE.sub("", page.read_text(encoding="utf-8")))

"""The way of somebody new: README, then the tutorial up to a law of their own that runs. Its blocks run in order in
``test_blocks.py``; here it is counted how long reading takes.
"""

from pathlib import Path

from fenced_blocks import blocks, commands_of

ROOT = Path(__file__).parents[2]
WORDS_A_MINUTE = 200
"""Of technical prose, every word of tables and code counted."""
COMMANDS_MIN = 4.0
"""Measured in a fresh environment: 32 s of processor time to install, 63 s for the first run with its kernels, 23 s for
the others; and as much again for looking.
"""

PAGES_WORDS = 22_667
"""Of README and docs at most: two thirds of the 34 000 that they once were."""


def way() -> list[str]:
    """What is read: README to where it leads on, then the tutorial to the end of the first own law."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    tutorial = (ROOT / "docs" / "learn" / "index.md").read_text(encoding="utf-8")
    first, _, _ = readme.partition("## What it reaches")
    until_law, _, _ = tutorial.partition("## 6.")
    assert first != readme
    assert until_law != tutorial
    return [first, until_law]


def test_reading_and_commands_to_an_own_law_take_less_than_ten_minutes() -> None:
    words = sum(len(text.split()) for text in way())
    assert words / WORDS_A_MINUTE + COMMANDS_MIN < 10.0, f"{words} words"


def test_on_that_way_a_law_of_ones_own_runs() -> None:
    tutorial = ROOT / "docs" / "learn" / "index.md"
    read = way()[1].count("\n")
    shown = [c for b in blocks(tutorial) if b.line < read and b.reason is None for c in commands_of(b.text)]
    assert any("--controller integral.toml" in c and c.startswith("pkxyz sil") for c in shown)
    assert shown[0] == "pkxyz sil"


def test_pages_stay_two_thirds_as_long_as_they_were() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in pages) <= PAGES_WORDS

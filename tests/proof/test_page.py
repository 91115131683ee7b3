"""docs/understand/how-it-is-tested.md says what the code and the last exploration say."""

import json
import re
from pathlib import Path

import reference_tables
import test_exploration
import test_mode_machine
import test_smt_gate
from configurations import CONFIGURATIONS
from explore import IN_CI

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "understand" / "how-it-is-tested.md").read_text(encoding="utf-8")
EXPLORED = json.loads(Path(__file__).with_name("explored.json").read_text(encoding="utf-8"))


def rows(start: str) -> dict[str, list[str]]:
    """Cells of the table rows behind a heading, by their first."""
    part = PAGE[PAGE.index(start) :].split("\n## ")[0]
    cells = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in part.splitlines() if line.startswith("| ")
    ]
    return {row[0]: row[1:] for row in cells}


def test_the_table_is_of_what_was_explored_to_the_fixed_point_and_ci_explores_what_is_not_too_long() -> None:
    assert {"well", "one", "two", "three", "outputs", "signature"} <= set(EXPLORED) <= set(reference_tables.EXPLORED)
    assert set(EXPLORED) - set(IN_CI) == {name for name in EXPLORED if CONFIGURATIONS[name].by_hand}
    for name, found in EXPLORED.items():
        assert found["complete"]
        assert found["violation"] == ""
        assert found["ticks_to_0_v"] <= CONFIGURATIONS[name].settle_ticks


def test_numbers_of_claims_and_planted_defects() -> None:
    told = {name.split(":")[0].split(",")[0]: numbers for name, numbers in rows("## Proven").items()}
    assert told["transmit gate"] == [str(len(test_smt_gate.PROPERTIES)), str(len(test_smt_gate.PLANTED))]
    assert told["mode machine with its guards"][1] == str(len(test_mode_machine.PLANTED))
    words = {17: "Seventeen", 18: "Eighteen", 19: "Nineteen"}
    assert f"{words[len(test_exploration.PLANTED)]} planted defects" in PAGE


def test_every_command_of_the_page_is_there() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(re.findall(r"`make ([a-z-]+)", PAGE)) <= targets
    assert set(re.findall(r"EXPLORED=(\w+)", PAGE)) <= set(CONFIGURATIONS)

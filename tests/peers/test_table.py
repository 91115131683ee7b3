"""docs/lookup/wire.md tells of each foreign stack what was tried with it, both ways, and a test holds it."""

import re
from pathlib import Path

TESTS = Path(__file__).parents[1]
PAGE = (TESTS.parent / "docs" / "lookup" / "wire.md").read_text(encoding="utf-8")
HELD_BY = {
    "durand": ["peers/test_durand.py"],
    "CANopenNode with our EDS": ["peers/recorded/canopennode_amplifier.log", "peers/recorded/canopenlinux_master.log"],
    "lely-core with our EDS": [
        "peers/recorded/lely_amplifier.log",
        "peers/recorded/lely_check.log",
        "peers/recorded/lely_master.log",
    ],
    "python-canopen": ["can/test_can_driver_canopen.py", "peers/test_local_node.py", "node/test_node_sdo.py"],
    "can-utils, cantools": ["socketcan/on_vcan_peers.py", "bus/test_bus_tools.py"],
}


def rows_of(page: str) -> dict[str, list[str]]:
    part = page[page.index("## Other makers' stacks") :].split("\n## ")[0]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in part.splitlines() if "|" in line]
    return {row[0]: row[1:] for row in cells[2:]}


def test_no_cell_says_that_nothing_was_tried() -> None:
    rows = rows_of(PAGE)
    assert len(rows) == 5
    assert [name for name, cells in rows.items() if len(cells) != 2 or not all(map(says_something, cells))] == []
    assert not says_something("not tried")
    assert not says_something("")


def says_something(cell: str) -> bool:
    return re.search(r"\w{3}", cell) is not None and re.search(r"not (yet )?tried|unknown|to do", cell) is None


def test_each_row_is_held_by_a_test() -> None:
    assert HELD_BY.keys() == rows_of(PAGE).keys()
    missing = [file for files in HELD_BY.values() for file in files if not (TESTS / file).exists()]
    assert missing == []
    played = (TESTS / "peers" / "test_recorded.py").read_text(encoding="utf-8")
    recorded = [file for files in HELD_BY.values() for file in files if file.endswith(".log")]
    assert [file for file in recorded if Path(file).name not in played] == []

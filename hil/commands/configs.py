"""``pkxyz configs``: what is shipped, and where."""

import itertools
import json
import tomllib
from pathlib import Path

from hil.screen.options import AnswerAsJson
from hil.screen.terminal import faint, plain_table, print_whole
from pkxyz_ctrl.config.files import CONFIG_DIR, names

KINDS = ("scenarios", "stages", "plants", "controllers", "buses", "tolerances", "processes", "searches")
"""Folders of configs/, as ``pkxyz configs`` lists them."""


def configs(as_json: AnswerAsJson = False) -> None:
    """List the shipped configurations, with the folder of each kind: NAME is the file NAME.toml in it."""
    found = {kind: {name: _description(CONFIG_DIR / kind / f"{name}.toml") for name in names(kind)} for kind in KINDS}
    if as_json:
        print(json.dumps(found))
        return
    table = plain_table()
    for kind, entries in found.items():
        table.add_row(kind, faint(f"{CONFIG_DIR / kind}/"))
        for name, words in entries.items():
            table.add_row(f"  {name}", words)
    print_whole(table)


def _description(path: Path) -> str:
    """One line about a configuration: its ``description``, else the first sentence of its opening comment."""
    text = path.read_text(encoding="utf-8")
    described = tomllib.loads(text).get("description")
    if isinstance(described, str):
        return described
    comment = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    words = " ".join(line.lstrip("# ").strip() for line in comment)
    return words.partition(". ")[0].rstrip(".")

"""Tables that are made from the code while the site is built; on a page each stands as ``<!-- built: NAME -->``.

In the repository a page shows only the mark, and says beside it which command or file has the same.
"""

import json
import re
import runpy
from functools import partial
from pathlib import Path
from typing import Any

import canopen
import cluster_plan
import config_tables
import fault_codes
import limit_table
import mode_tables
import wire_tables
from object_tables import object_table, pdo_table

from hil.conformance.run import CHECKS
from hil.faults.catalogue import KINDS, PARTS
from pkxyz_ctrl.instrument.motor_record import FIELDS
from pkxyz_ctrl.instrument.scpi import HEADERS
from pkxyz_ctrl.mechanics.published import entries
from pkxyz_ctrl.mechanics.reproduction import reproduction_table
from pkxyz_ctrl.safety.modes import EVENT_MEANING, TRANSITIONS, Event, Mode
from pkxyz_ctrl.safety.sdo_rules import WRITE_RULES
from pkxyz_ctrl.stage import Stage

ROOT = Path(__file__).parents[2]
EDS = ROOT / "configs" / "comb_amplifier.eds"
EXPLORED = {
    "well": "none",
    "one": "one of any kind, cuts included",
    "two": "two of any kind, cuts included",
    "three": "three of any kind, without cuts",
    "slow drive time-out": "one, with a drive time-out longer than that of heartbeats",
    "whole dialogue": "one, with all SDO steps of the start-up",
    "outputs": "one, with digital outputs",
    "signature": "one, with the node's signature",
    "outputs, two": "two of any kind, without cuts, with digital outputs",
    "outputs and signature": "one, with both",
}
"""The configurations that are explored, and what may go wrong in each."""
_MARK = re.compile(r"<!-- built: (\w+) -->")


def table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table; a pipe within a cell is escaped."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |" for cells in lines)


def transitions() -> str:
    """The next mode of every event in every mode; an empty cell is refused."""
    rows = [
        [event.name, EVENT_MEANING[event]]
        + [TRANSITIONS[mode, event].name if (mode, event) in TRANSITIONS else "" for mode in Mode]
        for event in Event
    ]
    return table(["event", "meaning", *(mode.name for mode in Mode)], rows)


def writes() -> str:
    """The objects that the transmit gate lets an SDO write, with the values that it permits."""
    rows = []
    for rule in WRITE_RULES:
        index = f"0x{rule.first:04X}" + (f" to 0x{rule.last:04X}" if rule.last > rule.first else "")
        subindex = f"{rule.sub_first}" + (f" to {rule.sub_last}" if rule.sub_last > rule.sub_first else "")
        rows.append([index, subindex, str(rule.size), rule.what, rule.permitted])
    return table(["object", "sub-index", "bytes", "what", "permitted values"], rows)


def kinds() -> str:
    """The catalogue of faults with their parameters, defaults and ranges."""
    rows = []
    for family, its in KINDS.items():
        target = f"{family}.{'/'.join(PARTS[family])}" if family in ("sense", "amplifier") else family
        if family == "bus":
            target = f"bus, bus.{'/'.join(PARTS[family])}"
        for name, kind in its.items():
            parameters = ", ".join(
                f"{key} = {p.default:g} ({p.low:g} to {p.high:g}; {p.meaning})" for key, p in kind.parameters.items()
            )
            rows.append([target, name, kind.meaning, parameters])
    return table(["target", "kind", "what it does", "parameters"], rows)


def conformance() -> str:
    """Every check of ``pkxyz check-amplifier``, what it expects and by which document."""
    rows = [[check.group, check.name, check.expected, check.basis] for check in CHECKS]
    return table(["group", "check", "expected", "by"], rows)


def paper() -> str:
    """Every number of the paper with its verdict."""
    rows = []
    for row in reproduction_table(entries(), Stage.load("printed"), Stage.load("reconstructed")):
        figures = ["" if v is None else f"{v:.6g}" for v in (row.printed, row.reconstructed)]
        rows.append([row.where, row.quantity, row.unit, row.published_text, *figures, str(row.verdict), row.why])
    return table(["where", "number", "unit", "published", "printed design", "reconstructed", "verdict", "why"], rows)


def objects() -> str:
    """The object dictionary of the EDS."""
    return object_table(canopen.import_od(str(EDS), 10))


def pdos() -> str:
    """The bytes of both process PDOs."""
    return pdo_table(canopen.import_od(str(EDS), 10))


def kept(path: str) -> str:
    """A table that a script of docs/ has left: what takes longer than building a site."""
    found = json.loads((ROOT / "docs" / path).read_text(encoding="utf-8"))
    return table(found["header"], found["rows"])


def board() -> str:
    """What each law takes on the emulated board, as ``tests/firmware/measure.py`` last found it."""
    made = runpy.run_path(str(ROOT / "docs" / "tables" / "board.py"))
    return table(made["HEADER"], made["rows"](json.loads(made["KEPT"].read_text(encoding="utf-8"))))


def alarms() -> str:
    """What became of sampled devices under every law, as ``tests/studies/alarms/sampled.py`` has kept it."""
    lines = (ROOT / "docs" / "tables" / "alarms.jsonl").read_text(encoding="utf-8").splitlines()
    of_law: dict[str, list[dict[str, Any]]] = {}
    for found in map(json.loads, lines):
        of_law.setdefault(found["law"], []).append(found)
    rows = []
    for law, motions in of_law.items():
        run = [m for m in motions if "refused" not in m]
        devices = [m["devices"] for m in run]
        stopped = sum(len(m["unstable"]) + len(m["beyond"]) for m in run)
        false = sum(len(m["false"]) for m in run)
        each = f"{min(devices)}" if min(devices) == max(devices) else f"{min(devices)} to {max(devices)}"
        counts = len(run), each, sum(devices), stopped, false
        rows.append([f"`{law}`", *map(str, counts)])
    header = [
        "law",
        "motions",
        "devices in each",
        "runs",
        "stopped: not stable, or out of reach",
        "stopped for nothing",
    ]
    return table(header, rows)


def noises() -> str:
    """Each noise of the plant lab alone, as ``docs/figures/plant_noise.py`` last measured it."""
    found = json.loads((ROOT / "docs" / "figures" / "plant_noise.json").read_text(encoding="utf-8"))
    return table(["noise of `lab`, alone", "x", "y", "z", ""], [[words, *cells] for words, cells in found.items()])


def explored() -> str:
    """What the last exploration of all states found, by configuration."""
    found = json.loads((ROOT / "tests" / "proof" / "explored.json").read_text(encoding="utf-8"))
    keys = ("states", "transitions", "ticks_to_0_v", "ticks_apart")
    rows = [
        [name, words, *(str(found[name][key]) for key in keys)] for name, words in EXPLORED.items() if name in found
    ]
    return table(["configuration", "faults", "states", "transitions", "ticks to 0 V", "ticks apart"], rows)


def drawn(script: str, function: str) -> str:
    """A table that a script of docs/figures makes beside its picture."""
    return str(runpy.run_path(str(ROOT / "docs" / "figures" / script))[function]())


def matrix() -> str:
    """What came of each fault under one law, as ``docs/figures/faults.py`` last found it."""
    drawing = runpy.run_path(str(ROOT / "docs" / "figures" / "faults.py"))
    return str(drawing["matrix"](json.loads(drawing["FOUND"].read_text(encoding="utf-8"))))


def rooms() -> str:
    """The rooms of the house and which room may use which; the table is that of the test that holds it."""
    house = runpy.run_path(str(ROOT / "tests" / "house" / "rooms.py"))
    return str(house["page_table"](house["House"].of(ROOT).sources))


def motor_fields() -> str:
    """The fields of a motor record of ``pkxyz ioc``."""
    return table(["field", "is"], [[field, about] for field, about in FIELDS.items()])


def scpi() -> str:
    """What ``pkxyz scpi`` understands."""
    return table(["header", "does"], [[f"`{header.form}`", header.about] for header in HEADERS.values()])


def measured(name: str) -> str:
    """A table of benchmarks/results.json."""
    drawing = runpy.run_path(str(ROOT / "docs" / "figures" / "performance.py"))
    blocks = drawing["generated"](json.loads(drawing["RESULTS"].read_text(encoding="utf-8")))
    return str(blocks[name])


def made() -> str:
    """The pages that are made from the code."""
    return table(
        ["made from the code", "holds"],
        [
            ["[Commands](commands.md)", "every command with its options"],
            ["[Configuration files](configs.md)", "every key with unit and range"],
            ["[Columns of a recording](recording.md)", "every column with its unit"],
            ["[Python](api.md)", "the public interface"],
        ],
    )


def plan() -> str:
    """What many devices take on many machines."""
    return table(["what", "how known", "value"], cluster_plan.rows())


BUILT = {
    "rooms": rooms,
    "made": made,
    "plan": plan,
    **{name: partial(measured, name) for name in ("quality", "beside", "speed", "share", "parts", "floor")},
    "trips": fault_codes.trips_table,
    "stops": fault_codes.stops_table,
    "emergencies": fault_codes.emergencies_table,
    "transitions": transitions,
    "writes": writes,
    "kinds": kinds,
    "conformance": conformance,
    "paper": paper,
    "pdos": pdos,
    "statuses": wire_tables.statuses,
    "events": wire_tables.events,
    "objects": objects,
    "motor_fields": motor_fields,
    "scpi": scpi,
    "mode_diagram": mode_tables.diagram,
    "modes": mode_tables.modes,
    "gate": mode_tables.gate,
    "limits": limit_table.limits,
    "effects": config_tables.effects,
    "segments": config_tables.segments,
    "matrix": matrix,
    "margins": partial(kept, "figures/margins.json"),
    "alarms": alarms,
    "sampled": partial(kept, "tables/montecarlo.json"),
    "noises": noises,
    "explored": explored,
    "board": board,
    "frames": partial(drawn, "bus_timing.py", "frame_table"),
    "budget": partial(drawn, "bus_timing.py", "budget_table"),
    "splitting": partial(drawn, "mechanics.py", "splitting_table"),
}


def with_tables(markdown: str) -> str:
    """A page with its tables. Raises KeyError for a mark that nobody serves."""
    return _MARK.sub(lambda mark: BUILT[mark[1]](), markdown)

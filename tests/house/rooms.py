"""The rooms of the house, and which room may use which. A room is a folder of modules; its subfolders are rooms too.

The table stands in the order in which the house is built: a room uses only rooms above it, so there is no circle. The
site shows it on docs/understand/architecture.md.
"""

import ast
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PACKAGES = ("pkxyz_ctrl", "hil", "sim")

NUMBERS = ("math", "numpy", "numba")
VALUES = ("enum", "typing", "dataclasses", "struct", "collections", "functools")


class Room(NamedTuple):
    """What a room may import besides itself."""

    uses: tuple[str, ...] = ()
    """Rooms; ``pkxyz_ctrl.*`` stands for all of that package."""
    libraries: tuple[str, ...] | None = None
    """All that it may import from elsewhere; None: what it needs, but python-can only in io and in the harness."""


HOUSE: Mapping[str, Room] = MappingProxyType({
    "sim.config": Room((), (*VALUES, "math", "pydantic", "tomllib", "pathlib")),
    "sim.motion": Room(("sim.config",), (*NUMBERS, *VALUES)),
    "sim.structure": Room(("sim.config", "sim.motion"), NUMBERS),
    "sim.surroundings": Room(("sim.config", "sim.motion"), NUMBERS),
    "sim": Room(("sim.config", "sim.motion", "sim.structure", "sim.surroundings"), (*NUMBERS, *VALUES)),
    # what runs on the target
    "pkxyz_ctrl.compiled": Room(),
    "pkxyz_ctrl.can": Room(("pkxyz_ctrl.compiled",), ("pydantic", "operator", "numpy", "numba", *VALUES)),
    "pkxyz_ctrl.safety": Room(("pkxyz_ctrl.compiled", "pkxyz_ctrl.can"), ("numpy", "numba", *VALUES)),
    "pkxyz_ctrl.config": Room(("pkxyz_ctrl.can", "pkxyz_ctrl.safety")),
    "pkxyz_ctrl.core": Room(("pkxyz_ctrl.compiled", "pkxyz_ctrl.config"), NUMBERS),
    "pkxyz_ctrl.io": Room(("pkxyz_ctrl.can", "pkxyz_ctrl.config")),
    "pkxyz_ctrl.loop": Room(
        ("pkxyz_ctrl.can", "pkxyz_ctrl.safety", "pkxyz_ctrl.compiled", "pkxyz_ctrl.config", "pkxyz_ctrl.core")
    ),
    "pkxyz_ctrl.export": Room(
        ("pkxyz_ctrl.compiled", "pkxyz_ctrl.can", "pkxyz_ctrl.safety", "pkxyz_ctrl.core", "pkxyz_ctrl.loop")
    ),
    "pkxyz_ctrl.client": Room(),
    "pkxyz_ctrl.instrument": Room(("pkxyz_ctrl.client",)),
    # the device, and what is designed for it offline
    "pkxyz_ctrl.elements": Room(("pkxyz_ctrl.config",)),
    "pkxyz_ctrl": Room(
        ("pkxyz_ctrl.client", "pkxyz_ctrl.compiled", "pkxyz_ctrl.config", "pkxyz_ctrl.core", "pkxyz_ctrl.elements")
    ),
    "pkxyz_ctrl.fabrication": Room(
        ("pkxyz_ctrl.config", "pkxyz_ctrl.elements"), ("math", "itertools", "pydantic", "numpy", *VALUES)
    ),
    "pkxyz_ctrl.mechanics": Room(("pkxyz_ctrl.config", "pkxyz_ctrl.core", "pkxyz_ctrl.elements", "pkxyz_ctrl")),
    "pkxyz_ctrl.trajectory": Room(("pkxyz_ctrl.config", "pkxyz_ctrl.core", "pkxyz_ctrl")),
    "pkxyz_ctrl.learning": Room(("pkxyz_ctrl.safety", "pkxyz_ctrl.config", "pkxyz_ctrl.trajectory")),
    "pkxyz_ctrl.design.model": Room(("pkxyz_ctrl.config", "pkxyz_ctrl")),
    "pkxyz_ctrl.design.margins": Room(("pkxyz_ctrl.config", "pkxyz_ctrl.design.model")),
    "pkxyz_ctrl.design.identification": Room(("pkxyz_ctrl.config", "pkxyz_ctrl", "pkxyz_ctrl.design.model")),
    "pkxyz_ctrl.design.laws": Room(
        ("pkxyz_ctrl.config", "pkxyz_ctrl", "pkxyz_ctrl.design.model", "pkxyz_ctrl.design.margins")
    ),
    "pkxyz_ctrl.design": Room((
        "pkxyz_ctrl.safety", "pkxyz_ctrl.config", "pkxyz_ctrl.core", "pkxyz_ctrl.loop", "pkxyz_ctrl",
        "pkxyz_ctrl.design.model", "pkxyz_ctrl.design.margins", "pkxyz_ctrl.design.laws",
    )),
    # the harness: what the controller meets
    "hil.bus": Room(("pkxyz_ctrl.can", "pkxyz_ctrl.compiled", "pkxyz_ctrl.io", "pkxyz_ctrl")),
    "hil.node": Room(("pkxyz_ctrl.can", "pkxyz_ctrl.compiled", "pkxyz_ctrl.config", "pkxyz_ctrl")),
    "hil.plant": Room(("sim.motion", "sim.structure", "sim", "pkxyz_ctrl.compiled", "pkxyz_ctrl.loop", "pkxyz_ctrl")),
    "hil.recording": Room(("pkxyz_ctrl.can", "pkxyz_ctrl.loop", "hil.bus")),
    "hil.faults": Room((
        "sim.motion", "sim", "pkxyz_ctrl.compiled", "pkxyz_ctrl.can", "pkxyz_ctrl.safety", "pkxyz_ctrl.config",
        "pkxyz_ctrl.loop", "pkxyz_ctrl", "hil.bus", "hil.node", "hil.plant",
    )),
    # a loop that is closed, once
    "hil.whole_ticks": Room(("pkxyz_ctrl.*", "hil.bus", "hil.node", "hil.plant", "hil.faults")),
    "hil.lanes": Room((
        "sim.config", "sim", "pkxyz_ctrl.*", "hil.bus", "hil.node", "hil.plant", "hil.faults", "hil.whole_ticks",
    )),
    "hil.abreast.widening": Room((), ("re", "llvmlite", "numpy", *VALUES)),
    "hil.abreast": Room((
        "sim.motion", "sim", "pkxyz_ctrl.*", "hil.lanes", "hil.abreast.widening",
    )),
    "hil.emulator": Room(("pkxyz_ctrl.*", "hil.faults", "hil.lanes")),
    "hil.conformance": Room(("sim.config", "sim", "pkxyz_ctrl.*", "hil.bus", "hil.node", "hil.plant", "hil.lanes")),
    "hil.operate": Room(("pkxyz_ctrl.*", "hil.lanes")),
    "hil.native": Room(("pkxyz_ctrl.*", "hil.bus", "hil.recording", "hil.lanes")),
    "hil.operate.running": Room((
        "pkxyz_ctrl.*", "hil.bus", "hil.recording", "hil.lanes", "hil.operate", "hil.native",
    )),
    "hil.runs": Room(("sim.config", "pkxyz_ctrl.*", "hil.recording", "hil.faults", "hil.lanes", "hil.native")),
    "hil.server": Room(("pkxyz_ctrl.*", "hil.bus", "hil.recording", "hil.lanes", "hil.operate", "hil.runs")),
    # many times, for one question
    "hil.studies.spread": Room(("pkxyz_ctrl.*",)),
    "hil.studies.margins": Room(("pkxyz_ctrl.*", "hil.lanes")),
    "hil.studies.identify": Room(("pkxyz_ctrl.*", "hil.lanes", "hil.studies.margins")),
    "hil.studies.wafer": Room((
        "sim.config", "pkxyz_ctrl.*", "hil.lanes", "hil.abreast", "hil.runs", "hil.studies.spread",
        "hil.studies.identify",
    )),
    "hil.studies.tune": Room(("pkxyz_ctrl.*", "hil.lanes", "hil.runs", "hil.studies.spread")),
    "hil.studies.faults": Room(("pkxyz_ctrl.*", "hil.faults", "hil.lanes", "hil.runs", "hil.studies.spread")),
    "hil.studies": Room((
        "sim.config", "pkxyz_ctrl.*", "hil.recording", "hil.faults", "hil.lanes", "hil.runs", "hil.studies.spread",
        "hil.studies.margins", "hil.studies.faults",
    )),
    # what a person meets
    "hil.pictures": Room((
        "pkxyz_ctrl.*", "hil.bus", "hil.recording", "hil.lanes", "hil.runs", "hil.studies.spread",
        "hil.studies.margins", "hil.studies.identify", "hil.studies.tune", "hil.studies.faults", "hil.studies",
    )),
    "hil.pictures.wafer": Room(("pkxyz_ctrl.*", "hil.pictures", "hil.studies.wafer")),
    "hil.screen": Room(("pkxyz_ctrl.*", "hil.lanes", "hil.runs", "hil.studies.margins")),
    "hil.bench.rigs": Room(("sim.motion", "sim", "pkxyz_ctrl.*", "hil.lanes", "hil.runs", "hil.studies.identify")),
    "hil.bench": Room((
        "pkxyz_ctrl.*", "hil.bus", "hil.plant", "hil.recording", "hil.lanes", "hil.abreast", "hil.native", "hil.runs",
        "hil.studies.spread", "hil.studies.margins", "hil.studies.tune", "hil.studies.wafer",
        "hil.studies", "hil.operate", "hil.server", "hil.bench.rigs",
    )),
    "hil.api": Room((
        "pkxyz_ctrl.*", "hil.recording", "hil.lanes", "hil.runs", "hil.studies.spread", "hil.studies.margins",
        "hil.studies.identify", "hil.studies.tune", "hil.studies", "hil.pictures",
    )),
    "hil.commands.studies": Room((
        "pkxyz_ctrl.*", "hil.recording", "hil.lanes", "hil.runs", "hil.studies.spread", "hil.studies.margins",
        "hil.studies.identify", "hil.studies.tune", "hil.studies.faults", "hil.studies.wafer", "hil.studies",
        "hil.pictures", "hil.pictures.wafer", "hil.screen", "hil.api",
    )),
    "hil.commands": Room((
        "pkxyz_ctrl.*", "hil.recording", "hil.faults", "hil.lanes", "hil.native", "hil.emulator", "hil.conformance",
        "hil.runs", "hil.studies", "hil.pictures", "hil.screen", "hil.bench.rigs", "hil.bench", "hil.api",
        "hil.commands.studies",
    )),
    "hil.commands.operation": Room((
        "pkxyz_ctrl.*", "hil.lanes", "hil.conformance", "hil.operate", "hil.native", "hil.operate.running",
        "hil.server", "hil.screen",
    )),
    "hil": Room((
        "pkxyz_ctrl.*", "hil.recording", "hil.lanes", "hil.runs", "hil.studies.margins", "hil.screen", "hil.api",
        "hil.commands.studies", "hil.commands", "hil.commands.operation",
    )),
})  # fmt: skip

# What a part of a room may or may not import beyond its room's libraries, by module.
LIBRARIES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "pkxyz_ctrl.can.dbc": ("canopen", "cantools", "pathlib", "re", "sys", "pydantic", *VALUES),
        "pkxyz_ctrl.loop.cycle": (*NUMBERS, "typing"),
        "pkxyz_ctrl.loop.row": ("numpy",),
        "pkxyz_ctrl.loop.runtime": ("numpy", *VALUES),
        "pkxyz_ctrl.loop.controller": ("numpy", *VALUES),
    }
)


class House:
    """Sources of modules by name, and what they import of each other. ``packages``: names that are folders."""

    def __init__(self, sources: Mapping[str, str], packages: Iterable[str]) -> None:
        self.sources = sources
        self.packages = frozenset(packages)
        self.imports = {module: frozenset(self._imports(module)) for module in sources}

    @classmethod
    def of(cls, root: Path, packages: Iterable[str] = PACKAGES) -> "House":
        """As it stands on the disk."""
        files = [path for package in packages for path in sorted((root / package).rglob("*.py"))]
        name = {path: ".".join(path.relative_to(root).with_suffix("").parts) for path in files}
        folders = {name[path].removesuffix(".__init__") for path in files if path.name == "__init__.py"}
        return cls({name[p].removesuffix(".__init__"): p.read_text(encoding="utf-8") for p in files}, folders)

    def room_of(self, module: str) -> str:
        """The folder that a module lies in."""
        return module if module in self.packages else module.rpartition(".")[0]

    @property
    def ours(self) -> dict[str, frozenset[str]]:
        """Imports among the modules of the house."""
        return {module: names & self.sources.keys() - {module} for module, names in self.imports.items()}

    @property
    def rooms(self) -> dict[str, frozenset[str]]:
        """Which room uses which, as it is."""
        found: dict[str, set[str]] = {self.room_of(module): set() for module in self.sources}
        for module, names in self.ours.items():
            found[self.room_of(module)] |= {self.room_of(name) for name in names} - {self.room_of(module)}
        return {room: frozenset(names) for room, names in found.items()}

    def wrong_arrows(self, table: Mapping[str, Room]) -> list[str]:
        """Imports that the table does not allow, each as a line."""
        return [
            f"{module} imports {name}: {self.room_of(module)} may not use {self.room_of(name)}"
            for module, names in self.ours.items()
            for name in sorted(names)
            if self.room_of(name) != self.room_of(module)
            and not may_use(table, self.room_of(module), self.room_of(name))
        ]

    def _imports(self, module: str) -> Iterator[str]:
        """All that a module names in an import, anywhere in it, for type checkers only, too; and in a string."""
        package = module if module in self.packages else module.rpartition(".")[0]
        for node in ast.walk(ast.parse(self.sources[module])):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                parts = package.split(".")
                above = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
                base = ".".join(part for part in (above, node.module) if part)
                named = {f"{base}.{alias.name}" for alias in node.names}
                yield from named & self.sources.keys()  # a name that is a module counts as that module
                if not named <= self.sources.keys():
                    yield base
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                place = node.value.partition(":")[0]
                yield from {place} & self.sources.keys() if "." in place else ()  # for importlib, or a table of places


def may_use(table: Mapping[str, Room], room: str, other: str) -> bool:
    """Whether the table has that arrow."""
    uses = table[room].uses if room in table else ()
    return other in uses or any(name.endswith(".*") and is_in(other, name[:-2]) for name in uses)


def is_in(module: str, prefix: str) -> bool:
    """Whether a module is what is called ``prefix``, or in it."""
    return module == prefix or module.startswith(prefix + ".")


def is_in_any(module: str, prefixes: Iterable[str]) -> bool:
    """Whether it is in one of them."""
    return any(is_in(module, prefix) for prefix in prefixes)


def circles(graph: Mapping[str, Iterable[str]]) -> list[str]:
    """Ways that lead back to where they began, each as a line; none of them twice."""
    finished: set[str] = set()
    found: list[str] = []

    def follow(node: str, way: tuple[str, ...]) -> None:
        if node in way:
            found.append(" -> ".join((*way[way.index(node) :], node)))
        elif node not in finished:
            for other in sorted(graph.get(node, ())):
                follow(other, (*way, node))
            finished.add(node)

    for node in sorted(graph):
        follow(node, ())
    return found


def page_table(sources: Mapping[str, str]) -> str:
    """The table as Markdown: rooms in the order of the house, the first sentence about each, and what it may use."""
    lines = ["| room | holds | may use |", "| --- | --- | --- |"]
    for name, room in HOUSE.items():
        about = (
            (ast.get_docstring(ast.parse(sources[name])) or "")
            .partition("\n\n")[0]
            .replace("\n", " ")
            .replace("``", "`")
        )
        lines.append(f"| `{name}` | {about} | {', '.join(f'`{other}`' for other in room.uses) or 'nothing'} |")
    return "\n".join(lines)

"""``pkxyz new``: a commented file to start from, which runs as it is written."""

import json
import re
import shutil
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.screen.outputs import writing
from hil.screen.terminal import say
from pkxyz_ctrl.config.files import ConfigError, find, load, read_toml

if TYPE_CHECKING:
    from pydantic import BaseModel


class Kind(StrEnum):
    """What a file can be begun for."""

    SCENARIO = "scenario"
    STAGE = "stage"
    CONTROLLER = "controller"
    BUS = "bus"


_FOLDERS = {Kind.SCENARIO: "scenarios", Kind.STAGE: "stages", Kind.CONTROLLER: "controllers", Kind.BUS: "buses"}
_LIKE = {Kind.SCENARIO: "raster", Kind.STAGE: "reconstructed", Kind.CONTROLLER: "lqg", Kind.BUS: "socketcan_fd"}
_RUNS = {
    Kind.SCENARIO: "pkxyz sil {file}",
    Kind.STAGE: "pkxyz sil --stage {file}",
    Kind.CONTROLLER: "pkxyz sil --controller {file}",
    Kind.BUS: "pkxyz check-amplifier --bus {file}",
}
_TABLE = re.compile(r"\[\[?([\w.]+)\]\]?")
_ENTRY = re.compile(r"(\w+) *=")


def new(
    kind: Annotated[Kind, typer.Argument(help="What the file is about.")],
    file: Annotated[Path, typer.Argument(help="File to write, ending in .toml; an existing one is left alone.")],
    like: Annotated[str | None, typer.Option(help="Shipped file, or one of your own, to begin with.")] = None,
    eds: Annotated[
        Path | None, typer.Option(help="Of a bus: the amplifier's EDS, for identity, PDO numbers and channels.")
    ] = None,
) -> None:
    """Write a commented file that runs as it is, to be changed from there."""
    if file.suffix != ".toml":
        raise ConfigError(f"{file}: the name must end in .toml, so that it is taken for a file")
    if file.exists():
        raise ConfigError(f"{file}: is there already and is left alone; give another name or remove it")
    folder, model = _FOLDERS[kind], _model(kind)
    source = find(folder, like or _LIKE[kind])
    begun = load(folder, source, model)
    command = _RUNS[kind].format(file=file)
    text = commented(source, model, file.stem, command)
    if eds is not None:
        text = _with_settings(text, _from_eds(begun, eds), eds.name)
    with writing(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
        for name in _tables_of(source):
            if not (file.parent / name).exists():
                shutil.copyfile(source.parent / name, file.parent / name)
    say(f"{file}: as {source.stem}, with comments; run it with: {command}")


def _from_eds(begun: "BaseModel", eds: Path) -> dict[str, Any]:
    from hil.conformance.from_eds import settings_from_eds
    from pkxyz_ctrl.config.bus import BusConfig

    if not isinstance(begun, BusConfig) or begun.can is None:
        raise ConfigError("--eds: an EDS is about the amplifier of a bus with [can]")
    return settings_from_eds(eds, begun.can.driver.node_id)


def _with_settings(text: str, settings: dict[str, Any], origin: str) -> str:
    """The text of a bus with other values in [can.driver], where they came from in a comment."""
    lines, table = [], ""
    for line in text.splitlines():
        if header := _TABLE.match(line):
            table = header[1]
        key = _ENTRY.match(line)
        if table == "can.driver" and key is not None and key[1] in settings:
            continue
        lines.append(line)
        if header and table == "can.driver":
            lines += [f"{f'{key} = {_toml(value)}':<35} # {origin}" for key, value in settings.items()]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, int) and not isinstance(value, bool) and value > 9:
        return f"0x{value:08X}"
    return json.dumps(value)


def commented(source: Path, model: "type[BaseModel]", name: str, command: str) -> str:
    """The text of ``source`` under another name; keys without a comment get what the model says of them."""
    lines = [f"# Begun by `pkxyz new` as {source.stem}; run it with: {command}", "#"]
    table, kind = "", None
    for line in source.read_text(encoding="utf-8").splitlines():
        if header := _TABLE.match(line):
            table, kind = header[1], None
        if line.startswith("kind = "):
            kind = line.split('"')[1]
        key = _ENTRY.match(line)
        if key is not None and key[1] == "name" and not table:
            line = f'name = "{name}"'
        if key is not None and "#" not in line and (words := _meaning(model, table, kind, key[1])):
            line = f"{line:<35} # {words}"
        lines.append(line)
    return "\n".join(lines) + "\n"


def _model(kind: Kind) -> "type[BaseModel]":
    if kind is Kind.SCENARIO:
        from hil.runs.scenario import ScenarioConfig

        return ScenarioConfig
    from pkxyz_ctrl.config.bus import BusConfig
    from pkxyz_ctrl.config.controller import ControllerConfig
    from pkxyz_ctrl.config.stage import StageConfig

    models: dict[Kind, type[BaseModel]] = {
        Kind.STAGE: StageConfig,
        Kind.CONTROLLER: ControllerConfig,
        Kind.BUS: BusConfig,
    }
    return models[kind]


def _meaning(model: "type[BaseModel]", table: str, kind: str | None, key: str) -> str:
    """The first sentence of a field's description; empty where the model has none."""
    from pkxyz_ctrl.config.described import meaning
    from pkxyz_ctrl.config.files import models_at

    location = tuple(part for part in (*table.split("."), kind) if part)
    found = [meaning(m, key) for m in models_at(location, model) if key in m.model_fields]
    words = " ".join(found[0].split()) if found else ""
    return words.partition(". ")[0].rstrip(".")


def _tables_of(source: Path) -> list[str]:
    """Files in the folder of a scenario that its reference reads."""
    segments = read_toml(source).get("reference", ())
    return [s["file"] for s in segments if isinstance(s, dict) and (source.parent / str(s.get("file", ""))).is_file()]

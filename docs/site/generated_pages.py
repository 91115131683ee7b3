"""The pages of the site that are made from the code: commands, configuration files, columns, the Python interface.

Each function returns the text of one page; ``pages`` has them all, keyed by their path below docs/.
"""

import inspect
import re
import types
from collections.abc import Iterator
from enum import Enum
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer
from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic import BaseModel
from pydantic.fields import FieldInfo

import hil
from hil import cli
from hil.runs.scenario import ScenarioConfig
from hil.studies.tune.search import SearchConfig
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.described import meaning
from pkxyz_ctrl.config.files import names
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.fabrication.process import Process
from pkxyz_ctrl.loop import row
from sim.config import PlantConfig

MODELS: dict[str, type[BaseModel]] = {
    "scenarios": ScenarioConfig,
    "stages": StageConfig,
    "controllers": ControllerConfig,
    "plants": PlantConfig,
    "buses": BusConfig,
    "tolerances": Tolerances,
    "processes": Process,
    "searches": SearchConfig,
}
"""The model of each folder of configs/."""

API: dict[str, tuple[str, ...]] = {
    "Runs and studies: the package `hil`": tuple(f"{home}.{name}" for name, home in hil._HOME.items()),
    "One device": ("pkxyz_ctrl.stage.Stage", "pkxyz_ctrl.stage.StageDomainError"),
    "A stage in operation": (
        "pkxyz_ctrl.client.plain.connect", "pkxyz_ctrl.client.plain.Stage", "pkxyz_ctrl.client.stage.connect_async",
        "pkxyz_ctrl.client.reply", "pkxyz_ctrl.client.scan.PathPreview", "pkxyz_ctrl.client.scan.ScanFrame",
    ),
    "Trajectories": ("pkxyz_ctrl.trajectory.Trajectory", "pkxyz_ctrl.trajectory.check.check_against"),
    "Configuration files": ("pkxyz_ctrl.config.files.load", "pkxyz_ctrl.config.files.parse"),
    "A law of one's own": ("pkxyz_ctrl.design.laws.chosen_law.with_law",),
    "A recording": ("hil.recording.recording.Recording",),
}  # fmt: skip
"""What a program may rely on, by task."""

_UNITS = {
    "m": "m", "s": "s", "us": "us", "ms": "ms", "v": "V", "n": "N", "f": "F", "hz": "Hz", "kg": "kg", "pa": "Pa",
    "rad": "rad", "a": "A", "nm": "nm", "um": "um",
}  # fmt: skip


def pages() -> dict[str, str]:
    """All generated pages."""
    return {
        "lookup/commands.md": commands_page(),
        "lookup/configs.md": configs_page(),
        "lookup/recording.md": recording_page(),
        "lookup/api.md": api_page(),
    }


# Commands


def commands_page() -> str:
    """One section a command: what it does, how it is called, its arguments and options."""
    parts = [
        "# Commands\n\nFrom each command's own `--help`. Exit codes: 0 done and all checks hold, 1 a check fails, "
        "2 input that can't be used, 130 interrupted."
    ]
    for name, command in commands():
        rows = [_parameter(p) for p in command.params if not getattr(p, "hidden", False) and p.name != "help"]
        usage = " ".join(["pkxyz", name, *(_metavar(p) for p in command.params if not _is_option(p)), "[OPTIONS]"])
        parts.append(f"## pkxyz {name}\n\n{_prose(command.help or '')}\n\n```\n{usage}\n```\n")
        parts.append(_table(("argument or option", "what it is", "default"), rows))
    return "\n\n".join(parts) + "\n"


def commands() -> Iterator[tuple[str, Any]]:
    """Every command by its whole name, those of groups with the group's name in front."""

    def of(group: Any, prefix: str) -> Iterator[tuple[str, Any]]:
        for name, command in group.commands.items():
            if hasattr(command, "commands"):
                yield from of(command, f"{prefix}{name} ")
            else:
                yield f"{prefix}{name}", command

    yield from of(typer.main.get_command(cli.app), "")


def _is_option(parameter: Any) -> bool:
    return parameter.param_type_name == "option"


def _metavar(parameter: Any) -> str:
    name = parameter.metavar or parameter.name.upper()
    return name if parameter.required else f"[{name}]"


def _parameter(parameter: Any) -> tuple[str, str, str]:
    shown = ", ".join(f"`{o}`" for o in parameter.opts) if _is_option(parameter) else f"`{_metavar(parameter)}`"
    kind = parameter.type_descriptor.annotation
    if isinstance(kind, type) and issubclass(kind, Enum):
        shown += " " + " or ".join(f"`{member.value}`" for member in kind)
    elif _is_option(parameter) and not parameter.is_flag:
        shown += f" {_escape(parameter.metavar or getattr(kind, '__name__', 'text'))}"
    default = parameter.default
    words = "" if default is None or default is False or default == () else str(getattr(default, "value", default))
    return shown, _escape(parameter.help or ""), f"`{words}`" if words else ""


# Configuration files


def configs_page() -> str:
    """One section a folder of configs/: what is shipped, and every key with its unit, range, default and meaning."""
    parts = [
        "# Configuration files\n\nEvery file is TOML. Keys carry their unit and are SI; a wrong key, unit or range is "
        "answered by one line that names the file, the key and the remedy. `pkxyz configs` lists what is shipped, "
        "with paths; `pkxyz new scenario`, `stage` and `controller` write a file to start from."
    ]
    for kind, model in MODELS.items():
        shipped = ", ".join(f"`{name}`" for name in names(kind))
        parts.append(f"## {kind}\n\n{_prose(inspect.getdoc(model) or '')}\n\nShipped: {shipped}.")
        parts.append(_table(("key", "unit", "range", "default", "meaning"), list(_fields(model, ""))))
    return "\n\n".join(parts) + "\n"


def _fields(model: type[BaseModel], prefix: str) -> Any:
    for name, field in model.model_fields.items():
        if name == "kind":
            continue  # it is in the key's brackets
        inner = _models(field.annotation)
        key = f"{prefix}{name}"
        if len(inner) == 1:
            listed = "[]" if get_origin(_without_none(field.annotation)) is tuple else ""
            about = meaning(model, name) or (inspect.getdoc(inner[0]) if inner[0].__doc__ else "") or ""
            yield f"**[{key}{listed}]**", "", "", _default(field), _escape(about)
            yield from _fields(inner[0], f"{key}{listed}.")
        elif inner:
            kinds = [_escape(_kind(m)) for m in inner]
            yield (
                f"**[{key}[]]**",
                "",
                "",
                _default(field),
                f"one of {', '.join(kinds)}. {_escape(meaning(model, name))}",
            )
            for m in inner:
                yield from _fields(m, f"{key}[{_kind(m)}].")
        else:
            yield f"`{key}`", _unit(name), _range(field), _default(field), _escape(meaning(model, name))


def _kind(model: type[BaseModel]) -> str:
    kind = model.model_fields.get("kind")
    values = get_args(kind.annotation) if kind is not None else ()
    return "/".join(str(v) for v in values) or model.__name__


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if get_origin(annotation) is dict:
        return []
    return list(dict.fromkeys(m for a in get_args(annotation) for m in _models(a)))


def _without_none(annotation: Any) -> Any:
    left = [a for a in get_args(annotation) if a is not type(None)]
    return left[0] if get_origin(annotation) in (Union, types.UnionType) and len(left) == 1 else annotation


def _unit(name: str) -> str:
    """The unit that a key or a field ends in: ``force_noise_n_per_rthz`` is N/√Hz, ``jerk_m_per_s3`` m/s³."""
    words, _, below = name.partition("_per_")
    above = words.rpartition("_")[2]
    if not below:
        return _UNITS.get(above, "")
    root = "√" if below.startswith("rt") else ""
    power = {"2": "²", "3": "³"}.get(below[-1], "")
    base = below.removeprefix("rt").removeprefix("_").rstrip("23")
    return f"{_UNITS.get(above, above)}/{root}{_UNITS.get(base, base)}{power}"


def _range(field: FieldInfo) -> str:
    return ", ".join(_limits(field.metadata) or _limits_of(field.annotation))


def _limits_of(annotation: Any) -> list[str]:
    """Bounds of a type: its own, or those of what it is made of."""
    if get_origin(annotation) is Annotated:
        own = [
            m for part in annotation.__metadata__ for m in (part.metadata if isinstance(part, FieldInfo) else [part])
        ]
        return _limits(own) or _limits_of(annotation.__origin__)
    if get_origin(annotation) is Literal:
        return [" or ".join(f"`{v}`" for v in get_args(annotation))]
    if annotation is bool:
        return ["true or false"]
    found: list[str] = []
    for inner in get_args(annotation):
        if inner is not Ellipsis:
            found += [text for text in _limits_of(inner) if text not in found]
    count = get_args(annotation) if get_origin(annotation) is tuple else ()
    return ([f"{len(count)} numbers"] if len(count) > 1 and Ellipsis not in count else []) + found


def _limits(metadata: Any) -> list[str]:
    signs = ((Gt, ">", "gt"), (Ge, "≥", "ge"), (Lt, "<", "lt"), (Le, "≤", "le"))
    found = [
        f"{sign} {_number(getattr(m, name))}" for m in metadata for kind, sign, name in signs if isinstance(m, kind)
    ]
    return found + ["not empty" for m in metadata if isinstance(m, MinLen)]


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None or isinstance(value, BaseModel):
        return ""
    return f"`{list(value) if isinstance(value, tuple) else str(value).lower() if isinstance(value, bool) else value}`"


# Columns


_FIELD = re.compile(r'^    \("(\w+)", .*?\),(?:  # (.*))?$', re.MULTILINE)


def field_meanings() -> dict[str, str]:
    """The fields of a row and what they hold, from the comments beside them in ``pkxyz_ctrl/loop/row.py``."""
    return {name: words or "" for name, words in _FIELD.findall(inspect.getsource(row))}


def recording_page() -> str:
    """Every column of a recording, with its unit and meaning."""
    rows = []
    for name, words in field_meanings().items():
        unit = "counts" if name.endswith("_count") else _unit(name)
        rows.append((", ".join(f"`{c}`" for c in row.columns(name)), unit, _dtype(name), _escape(words)))
    return (
        "# Columns of a recording\n\n`recording.parquet` has one row a tick. A field of three has three "
        "columns: `x`, `y`, `z` are axes of "
        "the platform, `1`, `2`, `3` are combs. Positions are relative to rest, z up; strokes are positive inward.\n\n"
        + _table(("columns", "unit", "type", "meaning"), rows)
        + "\n\nThe metadata of the file, under the key `pkxyz`, holds the resolved configuration with its digest.\n"
    )


def _dtype(name: str) -> str:
    base = row.ROW[name].base
    return {"f": "float64", "i": f"int{base.itemsize * 8}"}[base.kind]


# Python


def api_page() -> str:
    """The parts of the Python interface that a program may rely on, from their docstrings."""
    parts = ["# Python\n\nArrays have SI units and the shapes that are given; positions are relative to rest. "
             "`import hil` has the names of the first section, kept stable by semantic versioning."]  # fmt: skip
    for task, members in API.items():
        parts.append(f"## {task}")
        parts += [f"::: {member}\n    options:\n      heading_level: 3" for member in members]
    return "\n\n".join(parts) + "\n"


# Markdown


def _escape(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[")


def _prose(text: str) -> str:
    return " ".join(inspect.cleandoc(text).split("\n\n")[0].split()).replace("``", "`")


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "| " + " | ".join("---" for _ in header) + " |"]
    return "\n".join(lines + ["| " + " | ".join(cells) + " |" for cells in rows]) if rows else ""

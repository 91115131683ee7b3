"""Tables of what the shipped files say: the effects of the plants, and the kinds of a trajectory's segments."""

import inspect
from typing import Any

from pydantic import BaseModel

from pkxyz_ctrl.config.files import CONFIG_DIR
from pkxyz_ctrl.trajectory import AnySegment
from sim.config import PlantConfig

PLANTS = ("nominal", "mild", "harsh", "lab")
_UNTOLD = ("on", "seed_offset")


def effects() -> str:
    """Every section of a plant file, what it does, and what it is in each shipped plant."""
    plants = [PlantConfig.load(CONFIG_DIR / "plants" / f"{name}.toml") for name in PLANTS]
    rows = []
    for name, field in PlantConfig.model_fields.items():
        if name == "name":
            continue
        about = " ".join((field.annotation.__doc__ or "").replace("``", "`").split())  # type: ignore[union-attr]
        rows.append([f"`{name}`", about, *(_said(getattr(plant, name)) for plant in plants)])
    return _table(["section of the plant file", "what it does", *PLANTS], rows)


def segments() -> str:
    """Every kind of segment, what it is and the keys that it needs."""
    rows = []
    for kind in AnySegment.__args__:
        needed = [f"`{name}`" for name, f in kind.model_fields.items() if f.is_required() and name != "kind"]
        rows.append([f"`{kind.model_fields['kind'].annotation.__args__[0]}`", _first(kind), ", ".join(needed)])
    return _table(["`kind`", "what it is", "what it needs"], rows)


def _said(section: BaseModel) -> str:
    """The keys of a section with their values; "off" if it is."""
    plain: dict[str, Any] = section.model_dump(mode="json")
    if not plain["on"]:
        return "off"
    return "; ".join(
        f"{key} {_value(value)}" for key, value in plain.items() if key not in _UNTOLD and value is not None
    )


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return ", ".join(map(_value, value))
    return " ".join(f"{k} {_value(v)}" for k, v in value.items()) if isinstance(value, dict) else str(value)


def _first(kind: type) -> str:
    return " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split()).replace("``", "`")


def _table(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |" for cells in lines)

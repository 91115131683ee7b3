"""Broken configuration files in numbers: every one is read, or refused by a ConfigError of one line for each thing."""

import copy
import random
import tempfile
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from hil.runs.scenario import ScenarioConfig, load_scenario
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import CONFIG_DIR, ConfigError, parse, read_toml
from pkxyz_ctrl.config.stage import StageConfig
from sim.config import Device, PlantConfig

MODELS: dict[str, tuple[type[BaseModel], ...]] = {
    "buses": (BusConfig,),
    "controllers": (ControllerConfig,),
    "plants": (PlantConfig,),
    "stages": (StageConfig, Device),
    "scenarios": (ScenarioConfig,),
}
HOSTILE: tuple[Any, ...] = (
    0, -1, 1, 2**31, 2**63, -(2**63), 1e308, -1e308, 5e-324, float("nan"), float("inf"), -0.0, True, False,
    "", "x", "é\n", "../..", "nominal", "\0", [], [1], [0.0, 0.0, 0.0], [[1]], {}, {"x": 1}, "1.0",
)  # fmt: skip
FILES = [(kind, path) for kind in MODELS for path in sorted((CONFIG_DIR / kind).glob("*.toml"))]
_TEXTS = {path: path.read_text(encoding="utf-8") for _, path in FILES}
_TEXT_BITS = ("=", "[", "]", '"', "\n", "[[", "]]", "{", "}", "#", ",", "nan", "inf", "-", "_", "\0", "\ufeff", "'''")
_WHOLE_SHARE = 0.01  # of the scenarios: loaded with all that they name, trajectory and stage check included


def fuzz_documents(count: int, seed: int) -> str:
    """Try ``count`` documents; how many were taken and refused. Raises whatever is not a ConfigError."""
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(count):
            try:
                outcomes[try_document(random.Random(f"document {seed} {number}"), Path(folder))] += 1
            except Exception as error:
                error.add_note(f"document {number} of seed {seed}")
                raise
    return ", ".join(f"{number} {outcome}" for outcome, number in sorted(outcomes.items()))


def try_document(rng: random.Random, folder: Path) -> str:
    """One document bent from a shipped one: "taken" or "refused". ``folder`` is for files that are read."""
    kind, path = rng.choice(FILES)
    text = _TEXTS[path]
    try:
        if rng.random() < 0.4:
            broken = folder / path.name
            broken.write_bytes(bent_text(rng, text))
            data = read_toml(broken)
        else:
            data = bent_data(rng, tomllib.loads(text))
        for model in MODELS[kind]:
            parse(data, model, "fuzz.toml")
        if kind == "scenarios" and rng.random() < _WHOLE_SHARE and data.get("duration_s", 99) <= 60:
            _whole(data, path, folder)
    except ConfigError as error:
        if not str(error).strip():
            raise AssertionError("refused without a word") from error
        return "refused"
    return "taken"


def _whole(data: dict[str, Any], path: Path, folder: Path) -> None:
    """The scenario with all its parts, from a file, as ``pkxyz sil`` reads it."""
    import tomlkit

    broken = folder / path.name
    broken.write_text(tomlkit.dumps(data), encoding="utf-8")
    load_scenario(broken)


def bent_text(rng: random.Random, text: str) -> bytes:
    """The file with lines lost, doubled or swapped, characters changed, or cut short."""
    for _ in range(rng.randint(1, 3)):
        lines = text.splitlines(keepends=True) or [""]
        at = rng.randrange(len(lines))
        place = rng.randrange(len(text) + 1)
        match rng.randrange(6):
            case 0:
                del lines[at]
                text = "".join(lines)
            case 1:
                text = "".join([*lines[:at], lines[at], *lines[at:]])
            case 2:
                other = rng.randrange(len(lines))
                lines[at], lines[other] = lines[other], lines[at]
                text = "".join(lines)
            case 3:
                text = text[:place] + rng.choice(_TEXT_BITS) + text[place:]
            case 4:
                text = text[:place] + text[place + rng.randint(1, 9) :]
            case 5:
                text = text[:place]
    data = text.encode("utf-8")
    if rng.random() < 0.05:
        place = rng.randrange(len(data) + 1)
        data = data[:place] + rng.randbytes(rng.randint(1, 4)) + data[place:]
    return data


def bent_data(rng: random.Random, data: dict[str, Any]) -> dict[str, Any]:
    """The parsed file with one to three values replaced, removed, added or renamed, anywhere in it."""
    data = copy.deepcopy(data)
    for _ in range(rng.randint(1, 3)):
        holders = list(_holders(data))
        holder = rng.choice(holders)
        keys: list[Any] = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        if not keys:
            continue
        key = rng.choice(keys)
        match rng.randrange(6):
            case 0 | 1:
                holder[key] = copy.deepcopy(rng.choice(HOSTILE))
            case 2:
                del holder[key]
            case 3 if isinstance(holder, dict):
                holder[f"{key}_"] = holder.pop(key)
            case 4 if isinstance(holder[key], int | float) and not isinstance(holder[key], bool):
                holder[key] = holder[key] * rng.choice((-1, 0, 2, 0.5, 1.001, 10, 1000, 1e-6))
            case _ if isinstance(holder, dict):
                holder[rng.choice(("x", "name", "on", "seed", str(key)))] = copy.deepcopy(rng.choice(HOSTILE))
    return data


def _holders(value: Any) -> Any:
    if isinstance(value, dict | list):
        yield value
        for item in value.values() if isinstance(value, dict) else value:
            yield from _holders(item)

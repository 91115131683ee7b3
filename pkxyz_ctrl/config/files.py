"""Configuration as data: strict TOML files, frozen models, errors that name file, key and remedy.

Every number of a model carries its unit in its name and is SI. A file is found by its path or by the name of a shipped
one: ``load("stages", "reconstructed", StageConfig)``.
"""

import difflib
import hashlib
import json
import math
import reprlib
import tomllib
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tomlkit
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from pkxyz_ctrl.config.refused import reason

_PACKAGED = Path(__file__).parents[1] / "configs"
CONFIG_DIR = _PACKAGED if _PACKAGED.is_dir() else Path(__file__).parents[2] / "configs"
"""Where the shipped configuration files live: inside an installed wheel, or beside the packages in a checkout."""


TOML_MAX_BYTES = 1_000_000
"""Of a configuration file: one is read in a second, and 10 000 segments of a reference fit."""


class ConfigError(ValueError):
    """A configuration that cannot be used. The message names the file, the key and what to do."""


class FrozenModel(BaseModel):
    """Base of every configuration model: immutable, no unknown keys, no NaN, no silent conversion."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


Model = TypeVar("Model", bound=BaseModel)


def _one_file(name: str) -> str:
    if any(c in "/\\" or not c.isprintable() for c in name):
        raise ValueError("names files and folders: no slash, backslash or control character")
    return name


Name = Annotated[str, Field(min_length=1, max_length=100), AfterValidator(_one_file)]
"""What something is called, in tables and in the names of the files that are written about it."""


def find(kind: str, name_or_path: str | Path) -> Path:
    """Path of the file meant by a path (anything with a suffix or a separator) or the name of a shipped one.

    ``kind`` is a folder of ``configs/``: stages, controllers, buses, plants or scenarios.
    """
    text = str(name_or_path)
    if text.endswith(".toml") or "/" in text or "\\" in text:
        path = Path(text)
        if not _is_file(path):
            raise ConfigError(f"{path}: no such file; give the path of a TOML file or one of: {_known(kind)}")
        return path
    path = CONFIG_DIR / kind / f"{text}.toml"
    if not _is_file(path):
        near = difflib.get_close_matches(text, names(kind), n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ConfigError(
            f"{kind}: no configuration named {text!r}; {hint}known: {_known(kind)}; or give the path of a TOML file"
        )
    return path


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name too long, a NUL in it
        return False


def names(kind: str) -> list[str]:
    """Names of the shipped configurations of one kind, sorted."""
    return sorted(path.stem for path in (CONFIG_DIR / kind).glob("*.toml"))


def _known(kind: str) -> str:
    return ", ".join(names(kind)) or "none"


def read_bounded(path: str | Path, most_bytes: int) -> bytes:
    """Content of a file of somebody's. Raises ``ConfigError`` for one that isn't there, is no file (a device, a pipe),
    is larger than ``most_bytes`` or can't be read.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path}: cannot be read: is not a file")
        with path.open("rb") as file:
            content = file.read(most_bytes + 1)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except OSError as error:
        raise ConfigError(f"{str(path)!r}: cannot be read: {reason(error)}") from None
    except ValueError as error:  # a NUL in the path
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{str(path)!r}: cannot be read: {error}") from None
    if len(content) > most_bytes:
        raise ConfigError(
            f"{path}: is larger than {most_bytes * 1e-6:g} MB, the most that is read; give a smaller file"
        )
    return content


def read_toml(path: str | Path) -> dict[str, Any]:
    """Parsed content of a TOML file; a ``ConfigError`` that names the file and the line if it can't be read."""
    try:
        return tomllib.loads(read_bounded(path, TOML_MAX_BYTES).decode("utf-8"))
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None
    except RecursionError:
        raise ConfigError(f"{path}: not valid TOML: {_TOO_DEEP}") from None
    except ValueError as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{path}: not valid TOML: a number has too many digits") from None


def load(kind: str, name_or_path: str | Path, model: type[Model]) -> Model:
    """The validated model of one file. Raises ``ConfigError`` with one line for each thing that is wrong."""
    path = find(kind, name_or_path)
    return parse(read_toml(path), model, str(path))


def parse(data: dict[str, Any], model: type[Model], source: str) -> Model:
    """Validate plain data against a model; ``source`` is the file that errors name."""
    try:
        return model.model_validate(_listed_as_tuples(data))
    except RecursionError:
        raise ConfigError(f"{source}: {_TOO_DEEP}") from None
    except ValidationError as error:
        items = error.errors(include_url=False)
        inner = {item["loc"][:n] for item in items for n in range(len(item["loc"]))}
        # A list whose items are wrong also counts as too short; only the items are worth a line.
        lines = [_explain(source, dict(item), model) for item in items if item["loc"] not in inner or not item["loc"]]
        raise ConfigError("\n".join(dict.fromkeys(lines))) from None


_TOO_DEEP = "brackets or dotted keys are nested too deeply"


def _listed_as_tuples(value: Any) -> Any:
    """TOML knows arrays only, the frozen models hold tuples."""
    if isinstance(value, dict):
        return {key: _listed_as_tuples(item) for key, item in value.items()}
    if isinstance(value, list):
        return tuple(_listed_as_tuples(item) for item in value)
    return value


def _explain(source: str, item: dict[str, Any], model: type[BaseModel]) -> str:
    location = [str(part) for part in item["loc"]]
    key = ".".join(location)
    if item["type"] == "extra_forbidden":
        known = [name for m in models_at(item["loc"][:-1], model) for name in m.model_fields]
        return f"{source}: {key}: unknown key; {_remedy_for_unknown(location[-1], known)}"
    if item["type"] == "missing":
        return f"{source}: {key}: missing; add this key{_unit_hint(location[-1])}"
    message = str(item["msg"]).removeprefix("Value error, ")
    shown = item.get("input")
    got = "" if isinstance(shown, dict | BaseModel) else f" (got {_SHORT.repr(shown)})"
    unit = _unit_hint(location[-1]) if location else ""
    return f"{source}: {key or 'file'}: {message[:1].lower() + message[1:]}{got}{unit}"


_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 80

_UNITS = {
    "m": "metres",
    "s": "seconds",
    "us": "integer microseconds",
    "v": "volts",
    "n": "newtons",
    "f": "farads",
    "hz": "hertz",
    "kg": "kilograms",
    "pa": "pascals",
    "rad": "radians",
    "a": "amperes",
}


def _unit_hint(key: str) -> str:
    unit = _UNITS.get(key.rsplit("_", 1)[-1])
    return f", in {unit}" if unit and "_per_" not in key else ""


def _remedy_for_unknown(key: str, fields: list[str]) -> str:
    stem = key.rsplit("_", 1)[0]
    for field in fields:
        if stem and field.rsplit("_", 1)[0] == stem:
            return f"this quantity is given as {field!r}{_unit_hint(field)}"
    near = difflib.get_close_matches(key, fields, n=1)
    return f"did you mean {near[0]!r}?" if near else f"known here: {', '.join(fields)}"


def models_at(location: tuple[int | str, ...], model: type[BaseModel]) -> list[type[BaseModel]]:
    """The models that may stand at a place of a nested model: one, or several where the place doesn't tell which."""
    models = [model]
    for part in location:
        if isinstance(part, int):
            continue
        tagged = [m for m in models if "kind" in m.model_fields and part in _values(m.model_fields["kind"].annotation)]
        stepped = [_models(m.model_fields[part].annotation) for m in models if part in m.model_fields]
        models = tagged or [m for found in stepped for m in found] or models
    return models


def _models(annotation: Any) -> list[type[BaseModel]]:
    """The models inside a type, however it is wrapped: ``tuple[A | B, ...]`` gives A and B."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for argument in getattr(annotation, "__args__", ()) for m in _models(argument)]


def _values(literal: Any) -> tuple[Any, ...]:
    return getattr(literal, "__args__", ())


def plain(model: BaseModel) -> dict[str, Any]:
    """The model as plain data (dictionaries, lists, numbers, strings) without unset optional keys."""
    data: dict[str, Any] = model.model_dump(mode="json", exclude_none=True)
    return data


def digest(data: dict[str, Any]) -> str:
    """16 hexadecimal digits that name a resolved configuration: equal data, equal digest."""
    text = json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def write_toml(data: dict[str, Any], path: str | Path) -> None:
    """Write plain data as a TOML file that ``load`` reads back to the same model."""
    Path(path).write_text(tomlkit.dumps(data), encoding="utf-8")


def require_finite(value: float, what: str) -> float:
    """``value`` as a float, or a ``ConfigError`` that says what was not a finite number."""
    number = float(value)
    if not math.isfinite(number):
        raise ConfigError(f"{what} must be a finite number, got {value!r}")
    return number

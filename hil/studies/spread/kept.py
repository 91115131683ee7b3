"""Results that are kept one by one, so that what was killed goes on where it stood and counts nothing twice."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.config.refused import reason

Key = TypeVar("Key")
Value = TypeVar("Value")


class Kept(Generic[Key, Value]):
    """A file with a line of JSON for each result, after one that says by ``digest`` what study it is.

    ``found``: the results by their keys.
    """

    def __init__(
        self,
        path: Path,
        head: Mapping[str, Any],
        key: Callable[[Value], Key],
        read: Callable[[dict[str, Any]], Value],
        plain: Callable[[Value], Mapping[str, Any]],
    ) -> None:
        """Read what is there. Raises ``ConfigError`` for another study's file; a line cut off at the end is dropped."""
        self._path, self._key, self._plain = path, key, plain
        self.found: dict[Key, Value] = {}
        try:
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
            whole = [line for line in lines if line.endswith("\n")]
            if whole and json.loads(whole[0]).get("digest") != head["digest"]:
                raise ConfigError(
                    f"{path}: holds results of another study (a file of it has changed since); give another --out"
                )
            for line in whole[1:]:
                value = read(json.loads(line))
                self.found[key(value)] = value
            path.write_text("".join(whole) or json.dumps(head) + "\n", encoding="utf-8")
        except (ValueError, TypeError, AttributeError, KeyError) as error:
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"{path}: is not a file of results: {error}; give another --out") from None
        except OSError as error:
            raise ConfigError(f"{path}: {reason(error)}; give another --out") from None

    def add(self, value: Value) -> None:
        """Keep a result, at once. It counts once it is written: who is interrupted is told of no more than is there."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(self._plain(value), allow_nan=False) + "\n")
        self.found[self._key(value)] = value

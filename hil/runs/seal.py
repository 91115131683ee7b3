"""What a run's folder held when the run ended: digests of its files in the summary, and a seal on the summary itself.

Against accidents and for evidence that can be told from its copy; whoever can write files can also seal them anew.
"""

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hil.recording.recording import RecordingError
from pkxyz_ctrl.config.files import ConfigError, read_bounded

_SUMMARY_MAX_BYTES = 50_000_000
_FILES, _SEAL = "files", "seal"


def sealed(summary: dict[str, Any], folder: Path, names: Iterable[str]) -> str:
    """The text of ``summary.json``: with the SHA-256 of each named file that is there,
    and of all this. Raises ``OSError``.
    """
    present = {name: _sha256(folder / name) for name in sorted(names) if (folder / name).is_file()}
    content = summary | {_FILES: present}
    return json.dumps(content | {_SEAL: _seal_of(content)}, indent=2, allow_nan=False) + "\n"


def changed(summary: Path) -> tuple[list[str], list[str]]:
    """Names of the files that are as the run left them, and a line for each that is not, the summary among them.

    Raises ``RecordingError`` for a summary that can't be read, ``FileNotFoundError`` where there is none.
    """
    if not summary.exists():
        raise FileNotFoundError(summary)
    try:
        content = json.loads(read_bounded(summary, _SUMMARY_MAX_BYTES))
        files, seal = content[_FILES], content.pop(_SEAL)
        told = {str(name): str(digest) for name, digest in files.items()}
    except (ConfigError, ValueError, RecursionError) as error:
        raise RecordingError(f"{summary}: cannot be read: {error}") from None
    except (AttributeError, KeyError, TypeError):
        return [], [f"{summary.name} lacks the digests of the run's files: it was changed, or is of an older version"]
    kept, lines = [], []
    if seal != _seal_of(content):
        lines.append(f"{summary.name} is not as the run left it")
    for name, digest in told.items():
        path = summary.parent / Path(name).name  # of this folder, whatever the summary says
        if not path.is_file():
            lines.append(f"{name} is missing")
        elif _sha256(path) != digest:
            lines.append(f"{name} is not as the run left it")
        else:
            kept.append(name)
    return kept, lines


def _seal_of(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

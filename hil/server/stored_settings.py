"""What people set of a stage in operation, kept over its end: each change with who made it, when, and a digest; and a
way back to each of them.

A file of lines of JSON that only grows. Each line holds all settings, so that any of them is whole by itself.
"""

import hashlib
import json
import os
import time
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError

from hil.operate.sample_axes import SampleAxes
from hil.operate.settings import Settings
from pkxyz_ctrl.config.files import ConfigError, FrozenModel

_NEW = Settings()
_POSITIONS_MOST, _TOLD_MOST = 200, 50

PositionName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]{0,39}$")]
Coordinate = Annotated[float, Field(ge=-1e-3, le=1e-3)]
Positions = dict[PositionName, tuple[Coordinate, Coordinate, Coordinate]]
Rate = Annotated[float, Field(ge=1e-12, le=1e6)]


class MoveLimits(FrozenModel):
    """Of moves that name none, for each axis of the stage."""

    velocity_m_per_s: Rate = _NEW.limits[0]
    acceleration_m_per_s2: Rate = _NEW.limits[1]
    jerk_m_per_s3: Rate = _NEW.limits[2]


class SettleWindow(FrozenModel):
    """In position: each axis of the estimate, so many of its standard deviations included, for so long within this."""

    window_m: Annotated[float, Field(ge=0.1e-9, le=10e-6)] = _NEW.window_m
    dwell_s: Annotated[float, Field(ge=0, le=10)] = _NEW.dwell_s
    sigmas: Annotated[float, Field(ge=0, le=10)] = _NEW.sigmas


class StageSettings(FrozenModel):
    """All that is kept."""

    sample: SampleAxes = SampleAxes()
    positions: Annotated[Positions, Field(max_length=_POSITIONS_MOST)] = Field(default_factory=dict)
    """m, in the sample's coordinates"""
    limits: MoveLimits = MoveLimits()
    settle: SettleWindow = SettleWindow()

    @property
    def digest(self) -> str:
        """Of these settings, however they came to be."""
        plain = json.dumps(self.model_dump(), sort_keys=True)
        return hashlib.sha256(plain.encode()).hexdigest()[:12]


class Change(FrozenModel):
    """A line of the file."""

    at: str
    """UTC"""
    who: str
    what: str
    digest: str
    settings: StageSettings

    def told(self) -> dict[str, str]:
        """Without the settings."""
        return {"at": self.at, "who": self.who, "what": self.what, "digest": self.digest}


class SettingsStore:
    """``now``: what is set; ``changes``: how that came about, oldest first. Without a file nothing is kept."""

    def __init__(self, file: Path | None = None) -> None:
        """Raises ``ConfigError`` for a file that is not what was written."""
        self._file = file
        self.changes = [] if file is None else _read(file)
        self.now = self.changes[-1].settings if self.changes else StageSettings()

    def set(self, who: str, what: str, settings: StageSettings) -> None:
        """Take note of a change. Raises ``ConfigError`` where it can't be kept; then nothing has changed."""
        if settings == self.now:
            return
        at = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        change = Change(at=at, who=who, what=what, digest=settings.digest, settings=settings)
        if self._file is not None:
            _append(self._file, change.model_dump_json())
        self.changes.append(change)
        self.now = settings

    def back_to(self, digest: str) -> StageSettings:
        """The settings of a digest, or of its beginning. Raises ``ConfigError``."""
        fresh = StageSettings()
        known = {fresh.digest: fresh} | {change.digest: change.settings for change in self.changes}
        found = [settings for each, settings in known.items() if digest and each.startswith(digest)]
        if len(found) != 1:
            raise ConfigError(f"{digest!r} names {len(found)} settings; there are {', '.join(known)}")
        return found[0]

    def told(self) -> dict[str, Any]:
        """What is set and how that came about, newest first, as plain data."""
        history = [change.told() for change in reversed(self.changes[-_TOLD_MOST:])]
        begun = {"at": "", "who": "", "what": "as shipped", "digest": StageSettings().digest}
        return self.now.model_dump() | {"digest": self.now.digest, "history": [*history, begun]}


def default_folder() -> Path:
    """Where settings are kept unless told otherwise: the user's folder for such things."""
    home = os.environ.get("XDG_CONFIG_HOME")
    return (Path(home) if home else Path.home() / ".config") / "pkxyz"


def _read(file: Path) -> list[Change]:
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: {error}; settings are kept there: mend it, or name another by --settings") from None
    changes = []
    for n, line in enumerate(lines, 1):
        try:
            change = Change.model_validate_json(line)
        except ValidationError as error:
            wrong = error.errors()[0]
            where = ".".join(str(part) for part in wrong["loc"])
            raise ConfigError(
                f"{file}, line {n}: {where}: {wrong['msg']}; delete what follows line {n - 1} to go back"
            ) from None
        if change.digest != change.settings.digest:
            raise ConfigError(
                f"{file}, line {n}: is not what was written (digest {change.digest}, it has {change.settings.digest}): "
                f"delete what follows line {n - 1} to go back"
            )
        changes.append(change)
    return changes


def _append(file: Path, line: str) -> None:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("a", encoding="utf-8") as out:
            out.write(line + "\n")
            out.flush()
            os.fsync(out.fileno())
    except OSError as error:
        raise ConfigError(f"{file}: {error}; nothing was changed") from None

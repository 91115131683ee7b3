"""``pkxyz ask``: one thing asked of a stage that ``pkxyz serve`` operates."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from pkxyz_ctrl.config.files import ConfigError

_PLAIN = (
    "home", "enable", "disable", "pause", "resume", "abort", "stop", "release", "park", "clear", "auto-zero", "save",
)  # fmt: skip
_FREE = ("stop", "release", "status", "save")


def ask(
    what: Annotated[str, typer.Argument(help=f"{', '.join(_PLAIN)}, move, path or status.")],
    arguments: Annotated[
        list[str] | None,
        typer.Argument(
            help="move: x=1e-6 y=... z=... in m. path: a shipped scenario, a .csv table, a .json of segments."
        ),
    ] = None,
    by: Annotated[bool, typer.Option("--by", help="move: by a way from the present target, not to a point.")] = False,
    name: Annotated[str, typer.Option(help="What the stage is called, where there are several.")] = "stage",
    url: Annotated[str | None, typer.Option(help="The address that serve printed, for a stage elsewhere.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Ask a stage in operation, and wait until it is done; exit code 1 if it was refused or did not come to its end."""
    import pkxyz_ctrl
    from pkxyz_ctrl.client.reply import StageError

    if what not in (*_PLAIN, "move", "path", "status"):
        raise ConfigError(f"{what!r} can't be asked; what can: {', '.join(_PLAIN)}, move, path, status")
    given = arguments or []
    try:
        with pkxyz_ctrl.connect(url, name=name, control=what not in _FREE) as stage:
            if what == "status":
                _show(stage.status, as_json)
                return
            if what == "move":
                move = stage.move_by if by else stage.move_to
                command = move(**_coordinates(given))
            elif what == "path":
                command = stage.follow(**_path(given))
            else:
                command = getattr(stage, what.replace("-", "_"))()
    except StageError as error:
        print(f"pkxyz: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    print(
        json.dumps({key: getattr(command, key) for key in ("id", "verb", "state", "words")})
        if as_json
        else command.words
    )


def _coordinates(given: list[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for each in given:
        axis, _, value = each.partition("=")
        try:
            found[axis] = float(value)
        except ValueError:
            raise ConfigError(f"{each!r}: a coordinate is x=1e-6, in m") from None
        if axis not in ("x", "y", "z"):
            raise ConfigError(f"{each!r}: the axes are x, y and z")
    if not found:
        raise ConfigError("move: where to? give x=..., y=..., z=... in m")
    return found


def _path(given: list[str]) -> dict[str, Any]:
    if len(given) != 1:
        raise ConfigError("path: give one, a shipped scenario, a .csv table or a .json of segments")
    file = Path(given[0])
    if file.suffix not in (".csv", ".json"):
        return {"scenario": given[0]}
    try:
        text = file.read_text(encoding="utf-8")
        return {"table_csv": text} if file.suffix == ".csv" else {"segments": json.loads(text)}
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: {error}") from None


def _show(status: Any, as_json: bool) -> None:
    if as_json:
        print(json.dumps({key: getattr(value, "tolist", lambda v=value: v)() for key, value in vars(status).items()}))
        return
    print(status.words)
    for n, axis in enumerate("xyz"):
        setpoint, position = status.setpoint_m[n] * 1e6, status.position_m[n] * 1e6
        print(f"{axis}: set-point {setpoint:10.4f} um, position {position:10.4f} um")
    print(f"headroom {status.headroom_v:.1f} V, {status.missed_ticks} missed ticks, bus load {status.bus_load:.0%}")
    if status.last_fault:
        print(f"last fault: {status.last_fault}")

"""``pkxyz ask``: one thing asked of a stage that ``pkxyz serve`` operates."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from pkxyz_ctrl.config.files import ConfigError

_PLAIN = (
    "home", "enable", "disable", "pause", "resume", "abort", "stop", "release", "park", "clear", "auto-zero", "save",
)  # fmt: skip
_FREE = ("stop", "release", "status", "save", "settings")
_OTHERS = (
    "move", "path", "status", "settings", "frame", "tilt", "name", "forget", "go", "restore", "law", "quiet", "settle",
    "limits",
)  # fmt: skip


def ask(
    what: Annotated[str, typer.Argument(help=", ".join((*_PLAIN, *_OTHERS)) + ".")],
    arguments: Annotated[
        list[str] | None,
        typer.Argument(
            help="move: x=1e-6 y=... z=... in m. path: a shipped scenario, a .csv table, a .json of segments. frame: "
            "rotation_deg, slope_x, slope_y, origin_m=x,y,z, scale=x,y,z. tilt: three points x,y,z in m. name, forget, "
            "go: a position's name. restore: a digest of settings. law: a shipped controller or a .toml. quiet: on, "
            "off. settle: window_m, dwell_s, sigmas. limits: velocity_m_per_s, acceleration_m_per_s2, jerk_m_per_s3."
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

    if what not in (*_PLAIN, *_OTHERS):
        raise ConfigError(f"{what!r} can't be asked; what can: {', '.join((*_PLAIN, *_OTHERS))}")
    given = arguments or []
    try:
        with pkxyz_ctrl.connect(url, name=name, control=what not in _FREE) as stage:
            if what == "status":
                _show(stage.status, as_json)
                return
            if what == "settings":
                _show_settings(stage.settings, as_json)
                return
            if what == "move":
                move = stage.move_by if by else stage.move_to
                command = move(**_coordinates(given))
            elif what == "path":
                command = stage.follow(**_path(given))
            elif what in _OTHERS:
                command = _set(stage, what, given)
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


def _set(stage: Any, what: str, given: list[str]) -> Any:
    """What is not a motion, and goes to a named position."""
    if what in ("frame", "settle", "limits"):
        return {"frame": stage.set_frame, "settle": stage.settle_window, "limits": stage.limits}[what](**_named(given))
    if what == "tilt":
        if len(given) != 3:
            raise ConfigError("tilt: give three points, each x,y,z in m")
        return stage.tilt_plane(*(_numbers(point) for point in given))
    if len(given) != 1:
        raise ConfigError(f"{what}: give one argument; see -h")
    if what == "law":
        return stage.change_law(**_law(given[0]))
    if what == "quiet":
        if given[0] not in ("on", "off"):
            raise ConfigError(f"quiet: {given[0]!r} is neither on nor off")
        return stage.quiet_holds(given[0] == "on")
    verbs = {"name": stage.name_position, "forget": stage.forget_position, "go": stage.move_to_position}
    return (verbs | {"restore": stage.restore_settings})[what](given[0])


def _law(name: str) -> dict[str, str]:
    if not name.endswith(".toml"):
        return {"controller": name}
    try:
        return {"controller": Path(name).stem, "toml": Path(name).read_text(encoding="utf-8")}
    except (OSError, ValueError) as error:
        raise ConfigError(f"{name}: {error}") from None


def _named(given: list[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for each in given:
        key, _, value = each.partition("=")
        numbers = _numbers(value)
        found[key] = numbers if key in ("origin_m", "scale") else numbers[0]
    known = {
        "rotation_deg", "slope_x", "slope_y", "origin_m", "scale", "window_m", "dwell_s", "sigmas", "velocity_m_per_s",
        "acceleration_m_per_s2", "jerk_m_per_s3",
    }  # fmt: skip
    if not found or not found.keys() <= known:
        raise ConfigError(f"{' '.join(given)!r}: give key=value, several with a space between; see -h")
    return found


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"{text!r}: numbers are wanted, such as 1e-6, or 1e-6,0,18e-6") from None


def _show_settings(settings: Any, as_json: bool) -> None:
    if as_json:
        print(json.dumps(dataclasses.asdict(settings)))
        return
    frame = settings.frame
    print(f"settings {settings.digest}")
    print(
        f"frame: origin {frame.origin_m} m, rotation {frame.rotation_deg:g} deg, slopes {frame.slope_x:g} and", end=" "
    )
    print(f"{frame.slope_y:g}, scale {frame.scale}")
    print(f"in position: {settings.window_m:g} m for {settings.dwell_s:g} s, {settings.sigmas:g} sigma included")
    for name, place in settings.positions.items():
        print(f"position {name}: {place} m")
    for change in settings.history:
        print(f"{change.digest}  {change.at or '-':20}  {change.what}{f', {change.who}' if change.who else ''}")


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

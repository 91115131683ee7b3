"""``pkxyz ask``: one thing asked of a stage that ``pkxyz serve`` operates."""

import dataclasses
import json
import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from hil.screen.options import AnswerAsJson, ServedAt, StageCalled
from pkxyz_ctrl.config.files import ConfigError

_PLAIN = (
    "home", "enable", "disable", "pause", "resume", "abort", "stop", "release", "park", "clear", "auto-zero", "save",
)  # fmt: skip
_FREE = ("stop", "release", "status", "save", "settings", "preview")
_OTHERS = (
    "move", "jog", "path", "preview", "status", "settings", "sample", "tilt", "name", "forget", "go", "restore", "law",
    "quiet", "settle", "limits",
)  # fmt: skip


_NEEDED = {
    "sample": (),
    "settle": ("window_m", "dwell_s"),
    "limits": ("velocity_m_per_s", "acceleration_m_per_s2", "jerk_m_per_s3"),
}
_MAY = {"sample": ("rotation_deg", "slope_x", "slope_y", "origin_m", "scale"), "settle": ("sigmas",), "limits": ()}
_POINTS = ("origin_m", "scale")


def ask(
    what: Annotated[str, typer.Argument(help=", ".join((*_PLAIN, *_OTHERS)) + ".")],
    arguments: Annotated[
        list[str] | None,
        typer.Argument(
            help="move: x=1e-6 y=... z=... in m. jog: x=1e-5 seconds=1, in m/s. path, preview: a shipped scenario, a "
            ".csv table, a .json of segments, or its text. sample: rotation_deg, slope_x, slope_y, origin_m=x,y,z, "
            "scale=x,y,z. tilt: three points x,y,z in m. name, forget, go: a position's name. restore: a digest of "
            "settings. law: a shipped controller or a .toml. quiet: on, off. settle: window_m, dwell_s, sigmas. "
            "limits: velocity_m_per_s, acceleration_m_per_s2, jerk_m_per_s3."
        ),
    ] = None,
    by: Annotated[bool, typer.Option("--by", help="move: by a way from the present target, not to a point.")] = False,
    name: StageCalled = "stage",
    url: ServedAt = None,
    as_json: AnswerAsJson = False,
) -> None:
    """Ask a stage in operation, and wait until it is done; exit code 1 if it was refused or did not come to its end."""
    import pkxyz_ctrl
    from pkxyz_ctrl.client.reply import StageError

    if what not in (*_PLAIN, *_OTHERS):
        raise ConfigError(f"{what!r} can't be asked; what can: {', '.join((*_PLAIN, *_OTHERS))}")
    words = arguments or []
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
                command = move(**_coordinates(words))
            elif what == "jog":
                command = stage.jog(**_jog(words))
            elif what == "path":
                command = stage.follow(**_path(words))
            elif what == "preview":
                _show_preview(stage.preview(**_path(words)), as_json)
                return
            elif what in _OTHERS:
                command = _set(stage, what, words)
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


def _coordinates(words: list[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for each in words:
        axis, _, value = each.partition("=")
        found[axis] = _numbers(value, 1)[0]
        if axis not in ("x", "y", "z"):
            raise ConfigError(f"{each!r}: the axes are x, y and z")
    if not found:
        raise ConfigError("move: where to? give x=..., y=..., z=... in m")
    return found


def _jog(words: list[str]) -> dict[str, Any]:
    found = {key: _numbers(value, 1)[0] for key, _, value in (each.partition("=") for each in words)}
    seconds = found.pop("seconds", 0.0)
    axis, velocity = next(iter(found.items()), ("", 0.0))
    if len(found) != 1 or axis not in ("x", "y", "z") or velocity == 0.0 or not seconds > 0.0:
        raise ConfigError("jog: give one of x, y, z its velocity in m/s, and seconds, such as x=1e-5 seconds=1")
    direction = math.copysign(1.0, velocity)
    return {"axis": axis, "direction": direction, "seconds": seconds, "velocity_m_per_s": abs(velocity)}


def _path(words: list[str]) -> dict[str, Any]:
    if len(words) != 1:
        raise ConfigError("give one path: a shipped scenario, a .csv table, a .json of segments or its text")
    if words[0].startswith("["):
        try:
            return {"segments": json.loads(words[0])}
        except ValueError as error:
            raise ConfigError(f"these segments are no JSON: {error}") from None
    file = Path(words[0])
    if file.suffix not in (".csv", ".json"):
        return {"scenario": words[0]}
    try:
        text = file.read_text(encoding="utf-8")
        return {"table_csv": text} if file.suffix == ".csv" else {"segments": json.loads(text)}
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: {error}") from None


def _set(stage: Any, what: str, words: list[str]) -> Any:
    """What is not a motion, and goes to a named position."""
    if what in ("sample", "settle", "limits"):
        verb = {"sample": stage.set_sample, "settle": stage.settle_window, "limits": stage.limits}[what]
        return verb(**_named(what, words))
    if what == "tilt":
        if len(words) != 3:
            raise ConfigError("tilt: give three points, each x,y,z in m")
        return stage.tilt_plane(*(_numbers(point, 3) for point in words))
    if len(words) != 1:
        raise ConfigError(f"{what}: give one argument; see -h")
    if what == "law":
        return stage.change_law(**_law(words[0]))
    if what == "quiet":
        if words[0] not in ("on", "off"):
            raise ConfigError(f"quiet: {words[0]!r} is neither on nor off")
        return stage.quiet_holds(words[0] == "on")
    verbs = {"name": stage.name_position, "forget": stage.forget_position, "go": stage.move_to_position}
    return (verbs | {"restore": stage.restore_settings})[what](words[0])


def _law(name: str) -> dict[str, str]:
    if not name.endswith(".toml"):
        return {"controller": name}
    try:
        return {"controller": Path(name).stem, "toml": Path(name).read_text(encoding="utf-8")}
    except (OSError, ValueError) as error:
        raise ConfigError(f"{name}: {error}") from None


def _named(what: str, words: list[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for each in words:
        key, _, value = each.partition("=")
        numbers = _numbers(value, 3 if key in _POINTS else 1)
        found[key] = numbers if key in _POINTS else numbers[0]
    needed, known = _NEEDED[what], (*_NEEDED[what], *_MAY[what])
    if not found or not found.keys() <= set(known):
        raise ConfigError(f"{what}: {' '.join(words)!r}: give key=value of {', '.join(known)}")
    if missing := [key for key in needed if key not in found]:
        raise ConfigError(f"{what}: give {' and '.join(missing)}, too")
    return found


def _numbers(text: str, count: int) -> tuple[float, ...]:
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = ()
    if len(found) != count or not all(math.isfinite(number) for number in found):
        raise ConfigError(
            f"{text!r}: {'a number is' if count == 1 else 'three numbers are'} wanted, such as "
            f"{'1e-6' if count == 1 else '1e-6,0,18e-6'}"
        )
    return found


def _show_preview(preview: Any, as_json: bool) -> None:
    if as_json:
        print(json.dumps({key: getattr(value, "tolist", lambda v=value: v)() for key, value in vars(preview).items()}))
        return
    low, high = (", ".join(f"{v * 1e6:.4g}" for v in corner) for corner in (preview.low_m, preview.high_m))
    print(f"{preview.name}: {preview.duration_s:.4g} s, from ({low}) to ({high}) um; the combs can follow")


def _show_settings(settings: Any, as_json: bool) -> None:
    if as_json:
        print(json.dumps(dataclasses.asdict(settings)))
        return
    sample = settings.sample
    print(f"settings {settings.digest}")
    print(f"sample: origin {sample.origin_m} m, rotation {sample.rotation_deg:g} deg,", end=" ")
    print(f"slopes {sample.slope_x:g} and {sample.slope_y:g}, scale {sample.scale}")
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
    if status.stood_still_s:
        print(f"time has stood still for {status.stood_still_s:.3g} s, as a simulated stage waits for the computer")
    if status.last_fault:
        print(f"last fault: {status.last_fault}")

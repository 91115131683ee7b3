"""``pkxyz dbc``: the DBC of a bus file, with which any CAN tool shows volts and femtofarads."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.screen.options import BusFile
from pkxyz_ctrl.config.files import CONFIG_DIR, ConfigError
from pkxyz_ctrl.config.refused import reason

if TYPE_CHECKING:
    from pkxyz_ctrl.config.bus import BusConfig

EDS = CONFIG_DIR / "comb_amplifier.eds"


def dbc(
    bus: BusFile = "fd_5k",
    out: Annotated[Path | None, typer.Option(help="File to write; default: print it.")] = None,
) -> None:
    """Write the DBC of a bus: every frame between controller and amplifier, its process data in volts and femtofarads,
    by the scales of the bus file.
    """
    from pkxyz_ctrl.config.bus import BusConfig
    from pkxyz_ctrl.config.files import load

    text = dbc_of(load("buses", bus, BusConfig))
    if out is None:
        typer.echo(text, nl=False)
        return
    _refuse_foreign(out)
    try:
        out.write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        raise ConfigError(f"--out: {out}: {reason(error)}; give another file") from None


def dbc_of(bus: "BusConfig") -> str:
    """The DBC's text. Raises ``ConfigError`` for a bus without frames."""
    from pkxyz_ctrl.can.codec import AnalogScale
    from pkxyz_ctrl.can.dbc import database_from_eds, dbc_text

    if bus.can is None:
        raise ConfigError(f"bus {bus.name!r} has no [can] and carries no frames, so there is nothing to describe")
    analog = bus.analog
    drive = AnalogScale(analog.drive_volt_per_count)
    sense = AnalogScale(analog.sense_farad_per_count, analog.sense_offset_f)
    origin = f"{EDS.name} and bus {bus.name}, node {bus.can.driver.node_id}"
    return dbc_text(database_from_eds(EDS, bus.can.driver, drive, sense, origin))


def _refuse_foreign(path: Path) -> None:
    """Raise ``ConfigError`` for a file that was not written here: a DBC may be the work of weeks."""
    from pkxyz_ctrl.can.dbc import GENERATED

    if not path.exists():
        return
    try:
        begins = path.open(encoding="utf-8", errors="replace").readline()
    except OSError as error:
        raise ConfigError(f"--out: {path}: {reason(error)}; give another file") from None
    if not begins.startswith(f'VERSION "{GENERATED}'):
        raise ConfigError(f"--out: {path}: was not written by `pkxyz dbc`; give another file, or remove it")

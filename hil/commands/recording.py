"""``pkxyz recording``: a run's recording for other programs."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from pkxyz_ctrl.config.files import ConfigError

_FORMATS = ("csv", "mf4", "hdf5", "gsf")


def recording(
    folder: Annotated[Path, typer.Argument(metavar="RUN_FOLDER", help="What a run left, or a fault of `serve`.")],
    to: Annotated[str, typer.Option(help="csv, mf4, hdf5, or gsf: a map of a scan for Gwyddion.")] = "csv",
    out: Annotated[Path | None, typer.Option(help="File to write; beside the recording if not given.")] = None,
    columns: Annotated[
        str | None, typer.Option(help="Separated by commas; error_x_m ... are estimate less set-point.")
    ] = None,
    pixels: Annotated[int, typer.Option(help="gsf: along the longer side.", min=2, max=4096)] = 128,
) -> None:
    """Write a recording as CSV, MDF 4, HDF5, or a scan as a map. A file that exists is replaced only with --out."""
    from hil.recording import export
    from hil.recording.recording import Recording, RecordingError
    from hil.runs.run_folder import RECORDING

    if to not in _FORMATS:
        raise ConfigError(f"--to: {to!r} is none of {', '.join(_FORMATS)}")
    chosen = tuple(c.strip() for c in columns.split(",")) if columns else ()
    file = out or folder / f"recording.{to}"
    if out is None and file.exists():
        raise ConfigError(f"{file}: is there already; name it with --out to replace it")
    try:
        opened = Recording.open(folder / RECORDING)
        if to == "gsf":
            column = chosen[0] if chosen else "error_z_m"
            empty = export.as_gsf(opened, column, file, pixels)
            print(f"{column} over x and y in {file}; {empty:.1%} of its pixels are their neighbours'")
            return
        write = {"csv": export.as_csv, "mf4": export.as_mf4, "hdf5": export.as_hdf5}[to]
        write(opened, chosen or export.USUAL, file)
        print(f"{opened.ticks} ticks in {file}")
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error.name} is missing: pip install 'pkxyz-ctrl[export]'") from None
    except (RecordingError, OSError) as error:
        print(f"pkxyz: {error}", file=sys.stderr)
        raise typer.Exit(2) from None

"""The stage file that an identification leaves: the one it began with, and [calibration] with the provenance of each
number. It runs at once: ``pkxyz sil raster_harsh --stage runs/.../stage.toml``.
"""

from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import Table

from hil.studies.identify.identification import KNOWN, Identification, provenance
from pkxyz_ctrl.config.calibration import Calibration, MeasuredBy
from pkxyz_ctrl.config.files import ConfigError, plain
from pkxyz_ctrl.config.refused import reason

SUFFIX = "_calibrated"

NOTES = {
    "comb_gain": "pull of each comb at its voltage, by the drawing",
    "lift": "force up by pull",
    "sense_gain": "capacitance per stroke of each chain, by the drawing",
    "slider_stiffness": "folded springs of each chain, by the drawing",
    "crank_stiffness": "in-plane hinges of each chain, by the drawing",
    "link_stiffness": "out-of-plane hinges, by the drawing",
    "quality_factor": "of all modes together",
    "sense_delay_s": "what the loop lags beyond whole periods and the drawn amplifier",
}


def calibration_of(found: Identification, run: str) -> Calibration:
    """What was found as a stage file holds it, with its provenance; ``run`` is the name of the run's folder."""
    origin = provenance(found)
    strokes = [float(q) for q in found.response.strokes_m * 1e6]
    said = {key: origin[key] for key in ("digest", "seed", "stage", "plant", "controller", "bus", "lane", "tones")}
    measured_by = MeasuredBy(
        run=run,
        strokes_um=(strokes[0], strokes[1], strokes[2]),
        chi_square=found.calibrated.chi_square,
        sense_scale=found.sense_scale,
        known=KNOWN,
        not_known=found.not_known,
        **said,
    )
    return found.calibrated.calibration.model_copy(update={"measured_by": measured_by})


def write_calibrated_stage(source: Path, found: Identification, run: str, path: Path) -> None:
    """Write the file ``source``, of the stage that was identified, with its calibration. Comments stay."""
    document = tomlkit.parse(source.read_text(encoding="utf-8"))
    name = str(document["name"]).removesuffix(SUFFIX) + SUFFIX
    document["name"] = name
    document.pop("calibration", None)
    data = plain(calibration_of(found, run))
    errors, origin = data.pop("standard_error"), data.pop("measured_by")
    table = tomlkit.table()
    table.add(tomlkit.comment("Measured by `pkxyz identify`; the simulated plant does not read it."))
    for key, value in data.items():
        table.add(key, value)
        table[key].comment(f"{NOTES[key]}; {_source(errors[key], origin)}")
    table.add("standard_error", _table(errors))
    table.add("measured_by", _table(origin))
    document.add(tomlkit.nl())
    document.add("calibration", table)
    try:
        path.write_text(tomlkit.dumps(document), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {reason(error)}; give another folder with --out") from None


def _source(error: float | list[float], origin: dict[str, Any]) -> str:
    """Of one line: standard error, and the run that it comes from."""
    each = error if isinstance(error, list) else [error]
    if not any(each):
        return "taken as drawn"
    return f"+- {', '.join(f'{e:.2g}' for e in each)} ({origin['run']}, {origin['digest']}, seed {origin['seed']})"


def _table(data: dict[str, Any]) -> Table:
    table = tomlkit.table()
    for key, value in data.items():
        table.add(key, value)
    return table

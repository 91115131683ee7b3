"""A recommended device as a stage file, with a comment on where each number of it comes from."""

from pathlib import Path

import tomlkit

from pkxyz_ctrl.config.files import ConfigError, plain
from pkxyz_ctrl.config.refused import reason
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.mechanics.selection import Requirements

HEAD = "Dimensions selected by `pkxyz design` from requirements:"


def require_replaceable(path: Path) -> None:
    """Raise ``ConfigError`` for a file that is there and was not written here: somebody's work."""
    try:
        if path.exists() and not path.read_text(encoding="utf-8").startswith(f"# {HEAD}"):
            raise ConfigError(f"--out: {path}: was not written by `pkxyz design`; give another file, or move it away")
    except (OSError, UnicodeDecodeError):
        raise ConfigError(f"--out: {path}: is no stage file that could be replaced; give another file") from None


def write_stage_file(stage: StageConfig, need: Requirements, path: Path, which: str) -> None:
    """Write ``stage`` so that ``Stage.load(path)`` gives the same device; ``which`` of all that keep the requirements
    it is. Raises ``ConfigError`` if it can't be written.
    """
    data = plain(stage)
    document = tomlkit.document()
    document.add(tomlkit.comment(HEAD))
    document.add(tomlkit.comment(f"{which}."))
    document.add("name", data.pop("name"))
    for section, values in data.items():
        table = tomlkit.table()
        for key, value in values.items():
            table.add(key, value)
            if comment := _provenance(section, key, need):
                table[key].comment(comment)
        document.add(section, table)
    try:
        path.write_text(tomlkit.dumps(document), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {reason(error)}; give another with --out") from None


def _provenance(section: str, key: str, need: Requirements) -> str:
    return {
        ("geometry", "base_radius_m"): "required",
        ("geometry", "crank_length_m"): "L1, selected",
        ("geometry", "link_projection_rest_m"): "delta_0, selected: L2 and alpha_0 follow from it and z_0",
        (
            "geometry",
            "link_height_rest_m",
        ): f"z_0 = handle {need.handle_layer_m * 1e6:g} um + 2 oxide {need.oxide_m * 1e6:g} um + t_3",
        ("flexures", "leaf_height_m"): "device layer 1",
        ("flexures", "crank_hinge_height_m"): "device layer 1",
        ("drive_comb", "finger_height_m"): "device layer 1",
        ("sense_comb", "finger_height_m"): "device layer 1",
        ("dynamics", "mass_kg"): "required; effective mass",
        ("limits", "stroke_max_m"): "required",
        ("limits", "voltage_max_v"): "required",
    }.get((section, key), "as the template" if _is_length(section, key) else "")


def _is_length(section: str, key: str) -> bool:
    return section in ("flexures", "drive_comb", "sense_comb") and key.endswith(("_m", "_pa"))

"""What a bus file has to know of an amplifier, taken from its EDS."""

from pathlib import Path
from typing import Any

from hil.conformance.eds import Variable, read_eds
from pkxyz_ctrl.can.driver_config import ANY
from pkxyz_ctrl.config.files import ConfigError

_USUAL_PDO = 2
_COMBS = 3


def settings_from_eds(path: Path, node_id: int) -> dict[str, Any]:
    """Keys of ``[can.driver]``. What the EDS does not say of the identity becomes "any".

    Raises ConfigError where it has not three outputs and three inputs, or no PDO for them among the first four.
    """
    variables = read_eds(path, node_id)
    by_key = {(variable.index, variable.subindex): variable for variable in variables}
    drive_pdo, drive_channels = _pdo(path, by_key, 0x1400, 0x6411)
    sense_pdo, sense_channels = _pdo(path, by_key, 0x1800, 0x6401)
    return {
        "device_type": _identity(by_key, 0x1000, 0),
        "vendor_id": _identity(by_key, 0x1018, 1),
        "product_code": _identity(by_key, 0x1018, 2),
        "protection": all((index, part) in by_key for index in (0x2000, 0x2001) for part in (1, 2)),
        "drive_pdo": drive_pdo,
        "sense_pdo": sense_pdo,
        "drive_channels": drive_channels,
        "sense_channels": sense_channels,
    }


def _identity(by_key: dict[tuple[int, int], Variable], index: int, subindex: int) -> int | str:
    variable = by_key.get((index, subindex))
    return (variable and _default(variable)) or ANY


def _default(variable: Variable) -> int:
    return int.from_bytes(variable.default or b"", "little")


def _pdo(path: Path, by_key: dict[tuple[int, int], Variable], first: int, values: int) -> tuple[int, list[int]]:
    """Number and channels of the PDO that is mapped to the values already, else of one that may be."""
    channels = [sub for index, sub in sorted(by_key) if index == values and sub and by_key[index, sub].length == 2]
    if len(channels) < _COMBS:
        what = f"0x{values:04X} has {len(channels)} channels of 16 bits"
        raise ConfigError(
            f"{path}: {what}, three combs need {_COMBS}; is this the EDS of an amplifier as CiA 401 has it?"
        )
    there = [number for number in range(1, 5) if (first + number - 1, 1) in by_key]
    there.sort(key=lambda number: (number != _USUAL_PDO, number))
    for number in there:
        mapped = [_default(by_key[key]) for key in sorted(by_key) if key[0] == first + 0x200 + number - 1 and key[1]]
        own = [entry >> 8 & 0xFF for entry in mapped if entry >> 16 == values]
        if len(own) >= _COMBS:
            return number, own[:_COMBS]
    free = [
        number for number in there if (variable := by_key.get((first + 0x200 + number - 1, 0))) and variable.writable
    ]
    if not free:
        raise ConfigError(
            f"{path}: none of the PDOs 0x{first:04X} to 0x{first + 3:04X} is, or can be, mapped to 0x{values:04X}"
        )
    return free[0], channels[:_COMBS]

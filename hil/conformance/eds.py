"""The EDS of the amplifier under test, read by the canopen library: neither our driver's reading nor our node's."""

from dataclasses import dataclass
from pathlib import Path

import canopen

from pkxyz_ctrl.config.files import ConfigError

_BYTES = {0x01: 1, 0x02: 1, 0x03: 2, 0x04: 4, 0x05: 1, 0x06: 2, 0x07: 4, 0x08: 4, 0x11: 8, 0x15: 8, 0x1B: 8}
_SIGNED = (0x02, 0x03, 0x04, 0x15)  # CiA 301, 7.4.7.1
_STRING = 0x09


@dataclass(frozen=True)
class Variable:
    """One variable of the EDS. ``length`` in bytes, None for a string; ``default``: the bytes to be read, if known."""

    index: int
    subindex: int
    name: str
    length: int | None
    signed: bool
    access: str
    default: bytes | None
    low: int | None
    high: int | None

    @property
    def label(self) -> str:
        return f"0x{self.index:04X}:{self.subindex:02X}"

    @property
    def writable(self) -> bool:
        return self.access not in ("ro", "const")

    @property
    def readable(self) -> bool:
        return self.access != "wo"

    @property
    def is_pdo_parameter(self) -> bool:
        return 0x1400 <= self.index <= 0x1BFF

    def bytes_of(self, value: int) -> bytes:
        """Little endian, as many bytes as the type has (at most 4 travel in one request)."""
        length = self.length or 1
        return (value % (1 << 8 * length)).to_bytes(length, "little")

    @property
    def type_range(self) -> tuple[int, int]:
        bits = 8 * (self.length or 1)
        return (-(1 << bits - 1), (1 << bits - 1) - 1) if self.signed else (0, (1 << bits) - 1)


def read_eds(path: Path, node_id: int) -> tuple[Variable, ...]:
    """All variables, sub-index 0 of arrays and records included. Raises ConfigError."""
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; give the amplifier's EDS with --eds")
    try:
        dictionary = canopen.import_od(str(path), node_id)
    except Exception as error:  # canopen raises whatever its parser meets
        raise ConfigError(f"{path}: not an EDS that can be read ({type(error).__name__}: {error})") from None
    found = []
    for item in dictionary.values():
        is_variable = isinstance(item, canopen.objectdictionary.ODVariable)
        found += [_variable(variable) for variable in ([item] if is_variable else item.values())]
    if not found:
        raise ConfigError(f"{path}: no objects in it; is this an EDS?")
    return tuple(found)


def _variable(variable: canopen.objectdictionary.ODVariable) -> Variable:
    length = _BYTES.get(variable.data_type)
    signed = variable.data_type in _SIGNED
    default: bytes | None = None
    if length is not None and isinstance(variable.default, int):
        default = (variable.default % (1 << 8 * length)).to_bytes(length, "little")
    elif variable.data_type == _STRING and isinstance(variable.default, str):
        default = variable.default.encode("ascii", "replace")
    return Variable(
        variable.index,
        variable.subindex,
        variable.name,
        length,
        signed,
        variable.access_type,
        default,
        variable.min,
        variable.max,
    )

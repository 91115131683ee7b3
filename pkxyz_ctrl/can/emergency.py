"""Emergency messages as text (CiA 301, 7.2.7 and table of emergency error codes; CiA 401 adds none that we need)."""

import struct
from typing import NamedTuple

PROTECTION_CRC = 0xFF10  # ours: a drive PDO with a wrong CRC was not applied
PROTECTION_COUNTER = 0xFF11  # ours: a drive PDO with a wrong alive counter was not applied
PROTECTION_LATE = 0xFF13  # ours: a drive PDO that came after its SYNC was not applied
PROTECTION_STEP = 0xFF14  # ours: a drive PDO asked for a step beyond 0x2011, and the combs went to 0 V

_EXACT = {
    0x8110: "CAN overrun, objects lost",
    0x8120: "CAN in error passive mode",
    0x8130: "heartbeat of the controller missed",
    0x8140: "recovered from bus off",
    0x8150: "identifier collision",
    0x8210: "PDO not processed, too short",
    0x8220: "PDO longer than its mapping",
    0x8230: "DAM MPDO not processed, destination not available",
    0x8240: "SYNC with unexpected length or counter",
    0x8250: "no drive PDO was applied in time",
    PROTECTION_CRC: "drive PDO with a wrong CRC",
    PROTECTION_COUNTER: "drive PDO with a wrong alive counter",
    PROTECTION_LATE: "drive PDO after the SYNC that it was meant for",
    PROTECTION_STEP: "drive PDO with a step beyond the limit",
}
_CLASS = {
    0x00: "error reset or no error",
    0x10: "generic error",
    0x20: "current",
    0x21: "current, input side",
    0x22: "current inside the device",
    0x23: "current, output side",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the device",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x80: "monitoring",
    0x81: "monitoring, communication",
    0x82: "monitoring, protocol",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "device specific",
}
# By code, then by class: most particular first.
_REMEDY = (
    (0xFFFF, 0x8130, "it missed our heartbeat, so the computer or the bus stood still: see what held them up"),
    (0xFFFF, 0x8250, "no voltage reached it in time, so the computer or the bus stood still: see what held them up"),
    (0xFF00, 0x8100, "check wiring, termination and bit rates of the bus"),
    (
        0xFF00,
        0x8200,
        "frames were lost, damaged or sent by another: check the bus's wiring and load, and who else sends",
    ),
    (
        0xFFF8,
        0xFF10,
        "frames were lost, damaged or sent by another: check the bus's wiring and load, and who else sends",
    ),
    (0xF000, 0x2000, "over-current means a short or dust in a comb, so do not just try again"),
    (0xF000, 0x3000, "check the amplifier's supply and its high voltage"),
    (0xF000, 0x4000, "let it cool down, and see to its ventilation"),
    (0xF000, 0x5000, "restart the amplifier; if it says so again, it needs repair"),
    (0xF000, 0x6000, "restart the amplifier; if it says so again, it needs repair"),
)
_FRAME = struct.Struct("<HB5s")


class Emergency(NamedTuple):
    """One emergency message: when it came, the code, error register (0x1001), five manufacturer bytes."""

    t_us: int
    code: int
    register: int
    manufacturer: bytes

    @property
    def is_reset(self) -> bool:
        """Whether it says that an error is over (codes 0x00xx)."""
        return self.code < 0x0100

    @property
    def text(self) -> str:
        """For a person, e.g. ``EMCY 0x2310: current, output side (error register 0x03)``."""
        suffix = f", data {self.manufacturer.hex(' ')}" if any(self.manufacturer) else ""
        return f"EMCY 0x{self.code:04X}: {code_text(self.code)} (error register 0x{self.register:02X}{suffix})"

    def told_at(self, t_us: int) -> str:
        """``text`` with how long before ``t_us`` it came, and what to do, unless it says that an error is over."""
        remedy = "" if self.is_reset else f"; {code_remedy(self.code)}"
        return f"{self.text}, {max(0, t_us - self.t_us) / 1000:.1f} ms before{remedy}"


def code_remedy(code: int) -> str:
    """What to do about an emergency error code."""
    found = (remedy for mask, kind, remedy in _REMEDY if code & mask == kind)
    return next(found, "look the code up in the amplifier's manual")


def code_text(code: int) -> str:
    """The meaning of an emergency error code; an unknown one falls back to its class, 0xXX00 and 0xX000."""
    exact = _EXACT.get(code)
    if exact is not None:
        return exact
    high = code >> 8
    if high in _CLASS:
        return _CLASS[high]
    return _CLASS[high & 0xF0] if high >= 0x10 and high & 0xF0 in _CLASS else "unknown error code"


def decode_emergency(data: bytes, t_us: int) -> Emergency | None:
    """The emergency in an EMCY frame's eight bytes; None if the length is not eight."""
    if len(data) != _FRAME.size:
        return None
    return Emergency(t_us, *_FRAME.unpack(data))

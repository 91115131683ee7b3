"""Process PDOs: three 16-bit counts, an alive counter and a CRC-8, as bytes.

Layout, little endian::

    byte   0 1       2 3       4 5       6              7
           counts 1  counts 2  counts 3  alive counter  CRC-8

The CRC is AUTOSAR's CRC8H2F (polynomial 0x2F, initial value and final XOR 0xFF, not reflected) over nine bytes: the
COB-ID, low byte first, as data identity, then bytes 0..6. A drive PDO that is taken for a sense PDO therefore fails.
"""

from dataclasses import dataclass
from operator import index

from pkxyz_ctrl.can.process_pdo import count_of, counter_of, encode, is_right, pdo_record
from pkxyz_ctrl.compiled.direct_call import direct

Counts = tuple[int, int, int]

OUTPUT_NAMES = ("line", "pixel", "frame", "position", "in position")
"""What the bits of the digital outputs are, in RPDO 1, the lowest first."""
COUNTS_MIN = -32768
COUNTS_MAX = 32767
COUNTER_MAX = 255
_WORD = (1 << 64) - 1  # a word has a sign, its bytes have none
DRIVE_COUNTS_MAX = 32767  # 0x6411: 0..32767 is 0..200 V, a negative count is invalid
DRIVE_VOLT_PER_COUNT = 200.0 / DRIVE_COUNTS_MAX


class CountsOutOfRangeError(ValueError):
    """A count does not fit INTEGER16, or an alive counter does not fit UNSIGNED8."""


class ProcessCodec:
    """Encodes and decodes the process PDO with one COB-ID; drive and sense differ in nothing else.

    ``protected``: with alive counter and CRC, 8 bytes; otherwise the three counts alone, 6 bytes, as a plain CiA 401
    module has them. ``cob_id`` is the 11-bit identifier of the frame, ``record`` what the compiled codec reads.
    """

    __slots__ = ("_count_of", "_counter_of", "_encode", "_is_right", "cob_id", "length", "protected", "record")

    def __init__(self, cob_id: int, protected: bool) -> None:
        if not 0 <= cob_id <= 0x7FF:
            raise ValueError(f"COB-ID 0x{cob_id:X} does not fit 11 bits")
        self.cob_id = cob_id
        self.protected = protected
        self.record = pdo_record(cob_id, protected)
        self.length = int(self.record["length"][0])
        self._encode = direct(encode, self.record, 0, 0, 0, 0)
        self._count_of, self._counter_of = direct(count_of, 0, 0), direct(counter_of, 0)
        self._is_right = direct(is_right, self.record, 0)

    def encode(self, counts: Counts, counter: int) -> bytes:
        """The payload. ``counts`` -32768..32767 each, ``counter`` 0..255 (unused if not protected).

        Raises CountsOutOfRangeError; nothing is wrapped or clamped here.
        """
        first, second, third = self.require(counts, counter)
        word = int(self._encode(self.record, first, second, third, counter))
        return (word & _WORD).to_bytes(self.length, "little")

    def require(self, counts: Counts, counter: int = 0) -> Counts:
        """Counts that fit. Raises CountsOutOfRangeError."""
        first, second, third = map(index, counts)  # no fractions
        if not (
            COUNTS_MIN <= first <= COUNTS_MAX
            and COUNTS_MIN <= second <= COUNTS_MAX
            and COUNTS_MIN <= third <= COUNTS_MAX
            and (0 <= counter <= COUNTER_MAX or not self.protected)
        ):
            raise CountsOutOfRangeError(
                f"process PDO 0x{self.cob_id:03X} cannot carry counts {counts!r} with alive counter {counter!r}: "
                f"counts are {COUNTS_MIN}..{COUNTS_MAX}, the counter 0..255"
            )
        return first, second, third

    def decode(self, data: bytes) -> tuple[int, int, int, int, bool]:
        """``(counts 1, counts 2, counts 3, alive counter, CRC right)``; counter 0 and True if not protected.

        ``data`` has ``length`` bytes: the caller has looked at the length already.
        """
        word = int.from_bytes(data, "little", signed=True)
        counter = self._counter_of(word) if self.protected else 0
        count_of = self._count_of
        return count_of(word, 0), count_of(word, 1), count_of(word, 2), counter, self._is_right(self.record, word)


@dataclass(frozen=True, slots=True)
class AnalogScale:
    """``physical = offset + scale * counts``: volts of a drive comb (0x6411), farads of a sense comb (0x6401)."""

    scale: float
    offset: float = 0.0

    def physical(self, counts: int) -> float:
        """The physical value that a count stands for."""
        return self.offset + self.scale * counts

    def counts(self, physical: float) -> int:
        """The nearest count, clamped to INTEGER16. NaN raises ValueError."""
        if physical != physical:
            raise ValueError("not a number has no count")
        return round(min(max((physical - self.offset) / self.scale, COUNTS_MIN), COUNTS_MAX))


DRIVE_SCALE = AnalogScale(DRIVE_VOLT_PER_COUNT)

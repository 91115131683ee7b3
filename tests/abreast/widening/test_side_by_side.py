"""Records side by side: where each number lies, and the way back."""

import numpy as np
import pytest

from hil.abreast.widening.records import one_by_one, side_by_side
from hil.abreast.widening.text import LANES

INNER = np.dtype([("gain", "f8", (2, 3)), ("is_on", "?"), ("count", "i4")], align=True)
RECORD = np.dtype([("mode", "u1"), ("position_m", "f8", (3,)), ("parts", INNER, (2,)), ("ticks", "i8")], align=True)


def some(count, dtype=RECORD):
    raw = np.random.default_rng(1).integers(0, 256, count * dtype.itemsize, dtype=np.uint8)
    return np.frombuffer(raw.tobytes(), dtype)


def test_each_number_lies_beside_that_of_the_next_device():
    records = some(2 * LANES)
    groups = side_by_side(records)
    assert groups.shape == (2, LANES * RECORD.itemsize)
    at = LANES * RECORD.fields["ticks"][1]
    for n, group in enumerate(groups):
        assert group[at : at + 8 * LANES].tobytes() == records["ticks"][n * LANES : (n + 1) * LANES].tobytes()
        assert group.ctypes.data % 64 == 0


def test_the_way_back_has_every_field():
    records = some(3 * LANES)
    back = one_by_one(side_by_side(records), RECORD)
    assert back["parts"]["gain"].tobytes() == records["parts"]["gain"].tobytes()
    assert back["parts"]["count"].tobytes() == records["parts"]["count"].tobytes()
    for name in ("mode", "position_m", "ticks"):
        assert back[name].tobytes() == records[name].tobytes()


def test_fields_that_are_not_aligned_are_refused():
    packed = np.dtype([("mode", "u1"), ("position_m", "f8")])
    with pytest.raises(ValueError, match="8 bytes at 1"):
        side_by_side(some(LANES, packed))

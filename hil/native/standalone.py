"""The file of a run that needs nothing of Python beside it: all of the path, and room for all rows and frames."""

from hil.lanes.setup import Setup
from hil.native.mapped import Mapped
from hil.native.path_feeder import PathFeeder
from hil.native.settings import fill
from hil.native.teller import Teller
from pkxyz_ctrl.config.bus import CanConfig
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.export.shared import BLOCK_ROWS, size_of
from pkxyz_ctrl.loop.row import ROW

_FRAMES_A_TICK, _FRAME_BYTES, _START_BYTES = 6, 14 + 8, 1 << 18
_MOST_BYTES = 1 << 28


def standalone(setup: Setup, can: CanConfig, company_s: float) -> bytes:
    """What ``loop FILE`` goes by. Raises ``ConfigError`` for a run that is too long for one file."""
    blocks = setup.ticks // BLOCK_ROWS + 2
    ring_bytes = _START_BYTES + setup.ticks * (1 + ROW.itemsize + _FRAMES_A_TICK * _FRAME_BYTES)
    size = size_of(blocks, ring_bytes)
    if size > _MOST_BYTES:
        ticks = setup.ticks * _MOST_BYTES // size
        raise ConfigError(f"--ticks: path and rows of {setup.ticks} ticks take {size >> 20} MiB; give {ticks} or less")
    mapped, told = Mapped(blocks, ring_bytes), Teller(setup)
    shared = mapped.shared[0]
    told.lay_out(shared)
    fill(shared["settings"], setup, can, company_s)
    PathFeeder(setup, mapped.blocks)
    content = mapped.content
    mapped.close()
    return content

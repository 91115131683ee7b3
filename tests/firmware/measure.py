"""How long the board's calls take in the closed loop: every law that goes, while it tracks. Sizes beside it.

    python tests/firmware/measure.py [LAW ...]

Keeps what it found in docs/tables/board.json; ``python docs/tables/board.py`` puts it into the pages.
"""

import dataclasses
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from closed_loop import on_board_taken, use_tools
from disassembly import stack_bound
from on_board import SCRATCH

from hil.emulator.image import object_code
from hil.emulator.rig import image_of
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.compiled.kernel_cache import choose_kernel_cache
from pkxyz_ctrl.config.files import ConfigError, names
from pkxyz_ctrl.core.tick import PREDICTIVE
from pkxyz_ctrl.design.model.discrete_law import LawError
from pkxyz_ctrl.export.elf import loaded_bytes
from pkxyz_ctrl.export.entries import ENTRIES
from pkxyz_ctrl.export.stored import stored_in_exchange
from pkxyz_ctrl.safety.modes import Mode

KEPT = Path(__file__).parents[2] / "docs" / "tables" / "board.json"
TICKS = 1000


def measured(law: str) -> dict[str, Any] | None:
    """Of one law: bytes, and instructions (median, most) of cycle and period in the ticks that track; None where it
    does not go, or not on the default bus.
    """
    try:
        setup = load_scenario("raster", controller=law).setup()
        setup = dataclasses.replace(setup, duration_s=TICKS * setup.bus.period_s)
        if setup.law["tick"]["kind"][0] == PREDICTIVE:
            return None
    except (ConfigError, LawError):
        return None
    with tempfile.TemporaryDirectory(dir=SCRATCH) as folder:
        taken = on_board_taken(setup, Path(folder))
    taken = taken[taken["mode"] == Mode.TRACKING]
    held = stored_in_exchange(setup.law)
    return {
        "ticks": len(taken), "settings_bytes": held.settings, "memory_bytes": held.memory,
        **{
            f"{part}_{name}": int(value)
            for part in ("cycle", "period")
            for name, value in zip(("median", "most"), np.percentile(taken[part], [50, 100]), strict=True)
        },
    }  # fmt: skip


def stack_bytes() -> int:
    """The most that a call of the controller takes."""
    with tempfile.TemporaryDirectory(dir=SCRATCH) as folder:
        image = image_of(load_scenario("raster").setup(), Path(folder))
        words = ["arm-none-eabi-objdump", "-d", "--no-show-raw-insn", str(image)]
        listing = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    return max(stack_bound(listing, entry.name)[0] for entry in ENTRIES)


def main(laws: list[str]) -> None:
    """Measure, keep, and say it."""
    kept = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.is_file() else {"laws": {}}
    kept["code_bytes"], kept["stack_bytes"] = loaded_bytes(object_code()), stack_bytes()
    for law in laws:
        found = measured(law)
        print(law, found, flush=True)
        if found is not None:
            kept["laws"] = dict(sorted({**kept["laws"], law: found}.items()))
            KEPT.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    choose_kernel_cache()
    why_not = use_tools()
    if why_not:
        sys.exit(why_not)
    main(sys.argv[1:] or names("controllers"))

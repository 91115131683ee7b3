"""The firmware, compiled and linked: exported object, settings and path, start-up, UART, slcan and the loop."""

import hashlib
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.bus import CanConfig
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.export import folder as exporting
from pkxyz_ctrl.export.calls import CALL
from pkxyz_ctrl.export.folder import Exported, require_exportable, require_room
from pkxyz_ctrl.export.kernels import ExportError, kept, kernels
from pkxyz_ctrl.export.lowering import lower
from pkxyz_ctrl.export.planned import is_planned
from pkxyz_ctrl.export.targets import TARGETS

Records = NDArray[np.void]

TARGET = "cortex-m7"
EMULATOR, COMPILER = "qemu-system-arm", "arm-none-eabi-gcc"
_REMEDY = "apt-get install qemu-system-arm gcc-arm-none-eabi"
_EXPORT = Path(exporting.__file__).parent
_FIRMWARE = _EXPORT / "firmware"
_MADE_OF = tuple(_EXPORT / f"{name}.py" for name in ("entries", "emit", "planned", "lowering", "runtime", "targets"))
_FLAGS = ("-std=c11", "-O2", "-Wall", "-Wextra", "-fno-strict-aliasing", "-ffp-contract=off")


def program(name: str) -> str:
    """Its path. Raises ``ConfigError`` where it is not on PATH, with what brings it."""
    found = shutil.which(name)
    if found is None:
        raise ConfigError(f"{name} is not on PATH, and the board is emulated with it; {_REMEDY}")
    return found


def require_programs() -> None:
    """Raises ``ConfigError`` where one is missing."""
    for name in (EMULATOR, COMPILER):
        program(name)


def object_code(*, is_planned: bool = False) -> bytes:
    """The controller for the board, made or kept; that of a law that plans is another."""
    name = f"{TARGET}_planned.o" if is_planned else f"{TARGET}.o"
    return kept(name, _MADE_OF, lambda: lower(kernels(is_planned=is_planned), TARGETS[TARGET]).code)


def built(config: Records, reference: Records, outputs: Records, can: CanConfig, controller: str, place: Path) -> Path:
    """An image in ``place``, made there unless one of the same content is. ``config`` (1,) of ``EXCHANGE``,
    ``reference`` (n,) of ``REFERENCE``, ``outputs`` (1,) of ``OUTPUTS``; ``controller``: its name, for people.
    Raises ``ConfigError``.
    """
    exported = Exported(config, reference, np.zeros(0, CALL), "", controller, "")
    try:
        require_exportable(exported.law, TARGET)
        require_room(reference, "give a shorter scenario (duration_s)")
        code = object_code(is_planned=is_planned(exported.law))
    except ExportError as error:
        raise ConfigError(str(error)) from None
    texts = exporting.sources(exported) | {"bus.h": _bus_h(can)}
    texts["outputs.c"] = exporting.constant("pkxyz_outputs_words", outputs)
    digest = hashlib.sha256(code)
    for name, text in sorted(texts.items()):
        digest.update(f"{name}\n{text}".encode())
    for file in _firmware_files():
        digest.update(file.read_bytes())
    image = place / f"{digest.hexdigest()[:16]}.elf"
    if not image.is_file():
        _link(texts, code, place / f"{image.stem}-{os.getpid()}", image)
    return image


def _firmware_files() -> list[Path]:
    port = [exporting.PORT / name for name in (TARGETS[TARGET].port, "mps2.ld")]
    return [*port, *(path for path in sorted(_FIRMWARE.iterdir()) if path.suffix in (".c", ".h"))]


def _link(texts: dict[str, str], code: bytes, sources: Path, image: Path) -> None:
    sources.mkdir(parents=True)
    for name, text in texts.items():
        (sources / name).write_text(text, encoding="utf-8")
    (sources / "pkxyz.o").write_bytes(code)
    for path in _firmware_files():
        shutil.copy(path, sources)
    target, c_files = TARGETS[TARGET], sorted(path.name for path in sources.glob("*.c"))
    words = [program(COMPILER), *_FLAGS, *target.flags.split(), "-o", image.name, *c_files, "pkxyz.o"]
    done = subprocess.run([*words, *target.link.split()], cwd=sources, check=False, capture_output=True, text=True)
    if done.returncode != 0:
        raise ConfigError(f"{COMPILER} could not link the firmware: {' '.join(done.stderr.split())[-400:]}")
    (sources / image.name).replace(image)
    shutil.rmtree(sources)


def _bus_h(can: CanConfig) -> str:
    return (
        "/* Times after the start of a period, in us, as the bus file has them. */\n"
        f"#define BUS_SENSE_DEADLINE_US {can.sense_deadline_us} /* no longer is a sample waited for */\n"
        f"#define BUS_COMPUTE_US {can.compute_us} /* what computing is taken to cost */\n"
        f"#define BUS_HEARTBEAT_DEADLINE_US {can.heartbeat_deadline_us} /* no later does ours fit in */\n"
        f"#define BUS_COUNTS_FRAMES {int(can.driver.protection)} /* PDOs carry an alive counter */\n"
    )

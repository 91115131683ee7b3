"""What may be exported for: the processors, and what each is given or lacks."""

import platform
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

import llvmlite.binding as llvm


class Target(NamedTuple):
    """One processor.

    ``triple`` None: this machine's. ``features``: of LLVM. ``is_wide``: registers of 64 bits. ``is_hosted``: with
    an operating system and its C library. ``has_double``: doubles in hardware. ``compiler``, ``flags``,
    ``link``: what the Makefile calls, with what; ``port``: the file that stands in for the board's own.
    ``tick_most_us``: what the longest tick takes, where that is long, by ``make test-firmware`` and one instruction
    a cycle: 33 760 and 1 700 for frames and gate at 480 MHz on a Cortex-M7, 619 640 at 168 MHz on a Cortex-M4
    before it had 45 additions more, of some 100 instructions each there.
    ``round_most_us``: what a round of the predictive law's solver takes besides, over ten periods with all limits held;
    what its plan takes is less than another one. Of the 5034 us that 30 rounds may take, 2749 were seen.
    ``has_loop``: the program that runs it at rate goes with it.
    """

    triple: str | None
    cpu: str
    features: str
    about: str
    is_wide: bool
    is_hosted: bool
    has_double: bool
    compiler: str
    flags: str
    port: str
    link: str
    tick_most_us: int = 0
    round_most_us: int = 0
    has_loop: bool = False

    @property
    def llvm_triple(self) -> str:
        """The triple that LLVM is given."""
        return llvm.get_default_triple() if self.triple is None else self.triple

    @property
    def machine(self) -> llvm.TargetMachine:
        """LLVM's own of it."""
        llvm.initialize_all_targets()
        llvm.initialize_all_asmprinters()
        return llvm.Target.from_triple(self.llvm_triple).create_target_machine(
            cpu=self.cpu, features=self.features, opt=2, reloc="pic" if self.is_hosted else "static", codemodel="small"
        )


_CORTEX = "-mthumb -mfloat-abi=hard"
_ON_MPS2 = "port_cortex_m.c", "-nostdlib -ffreestanding -T mps2.ld -Wl,-z,noexecstack -lgcc"
_ON_YOURS = "port_bare.c", "-nostdlib -ffreestanding -lgcc"
_HERE = None, "x86-64" if platform.machine() == "x86_64" else "generic", ""
TARGETS: Final[Mapping[str, Target]] = MappingProxyType({
    "host": Target(*_HERE, "this machine, with its C library", True, True, True, "cc", "", "port_host.c", ""),
    "linux": Target(
        *_HERE, "this machine, with the loop at rate around it", True, True, True, "cc", "", "port_host.c", "",
        has_loop=True,
    ),
    # In four parts: of three, LLVM would call helpers of another binary interface.
    "cortex-m7": Target(
        "thumbv7em-none-unknown-eabihf", "cortex-m7", "", "bare metal, doubles in hardware",
        False, False, True, "arm-none-eabi-gcc", f"-mcpu=cortex-m7 -mfpu=fpv5-d16 {_CORTEX}", *_ON_MPS2, 74, 160,
    ),
    "cortex-m4": Target(
        "thumbv7em-none-unknown-eabihf", "cortex-m4", "", "bare metal, doubles by the compiler's own library",
        False, False, False, "arm-none-eabi-gcc", f"-mcpu=cortex-m4 -mfpu=fpv4-sp-d16 {_CORTEX}", *_ON_MPS2, 3750, 8100,
    ),
    "aarch64": Target(
        "aarch64-none-unknown-elf", "generic", "", "bare metal, 64 bits",
        True, False, True, "aarch64-none-elf-gcc", "", *_ON_YOURS,
    ),
    "riscv32": Target(
        "riscv32-unknown-none-elf", "generic-rv32", "+m,+a,+f,+d,+c", "bare metal, RV32GC: doubles in hardware",
        False, False, True, "riscv32-unknown-elf-gcc", "-march=rv32gc -mabi=ilp32d", *_ON_YOURS,
    ),
})  # fmt: skip

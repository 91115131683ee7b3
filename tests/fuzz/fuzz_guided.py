"""The fuzzing of fuzz.py, guided by coverage: ``python tests/fuzz/fuzz_guided.py node guided -max_total_time=60``.

atheris records which branches of our code an input takes and bends those inputs further that took a new one. An input
is read as the random numbers of a session, so that every input is a session of frames and the generators stay in charge
of what a frame looks like. ``blind`` takes the input as a seed instead: the same sessions, the same instruments, but
unguided. What guidance is worth is the difference ("cov" in the last line printed); in short runs it found one
branch in twenty more in the node, and no defect.
Needs ``pip install atheris`` (Linux); options that begin with "-" go to libFuzzer.
"""

import os
import random
import sys
import tempfile
from pathlib import Path

os.environ["NUMBA_DISABLE_JIT"] = "1"
sys.path.insert(0, str(Path(__file__).parent))

try:
    import atheris
except ImportError:
    sys.exit("fuzz_guided needs atheris: pip install atheris (Linux, CPython 3.11 or later)")

with atheris.instrument_imports(include=["pkxyz_ctrl", "hil"], enable_loader_override=False):
    from fuzz import TARGETS
    from fuzz_documents import try_document

FRAMES = 60  # of a session: long enough for a start-up dialogue


class RandomFrom(random.Random):
    """Random numbers that are the bytes of ``data``, and go on pseudo-randomly where they end."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self._data = data
        self._place = 0

    def getrandbits(self, bits: int, /) -> int:
        if self._place >= len(self._data):
            return super().getrandbits(bits)
        size = -(-bits // 8)
        taken = self._data[self._place : self._place + size]
        self._place += size
        return int.from_bytes(taken.ljust(size, b"\0"), "little") >> 8 * size - bits

    def random(self) -> float:
        return self.getrandbits(16) / (1 << 16)


def main() -> None:
    target, how = sys.argv[1], sys.argv[2]
    if target not in (*TARGETS, "documents") or how not in ("guided", "blind"):
        sys.exit(f"usage: fuzz_guided.py {'|'.join((*TARGETS, 'documents'))} guided|blind [libFuzzer options]")
    rng_of = RandomFrom if how == "guided" else random.Random

    def one(data: bytes) -> None:
        rng = rng_of(data)
        if target == "documents":
            with tempfile.TemporaryDirectory() as folder:
                try_document(rng, Path(folder))
        else:
            TARGETS[target][0](rng, FRAMES)

    atheris.Setup([sys.argv[0], *sys.argv[3:]], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()

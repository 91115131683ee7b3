"""What a listing of machine code says: instructions that round once where two operations would round twice, and how
deep the stack gets.
"""

import re
from functools import cache

_FUSED = re.compile(
    r"\b(v?fn?m(add|sub|la|ls|a|s)\w*(\.\w+)*|vfmadd\w+|vfmsub\w+|vfnm\w+|fmadd\w*|fmsub\w*|fnmadd\w*|fnmsub\w*)\b"
)
_NOT_FUSED = re.compile(r"fmax|fmin|fmov|fmul|fms[rt]|fmrs|fmr[xs]")
_FUNCTION = re.compile(r"^[0-9a-f]+ <([^>]+)>:$")
_CALL = re.compile(r"\t(?:bl|b|b\.n|b\.w|blx)\t?\s*[0-9a-f]+ <([^>+]+)>")
_REGISTER_CALL = re.compile(r"\tblx\t?\s*r\d+|\tbx\t?\s*r(?!14)\d+")


def fused_instructions(listing: str) -> list[str]:
    """Lines with a multiplication and an addition in one rounding, on x86, ARM, AArch64 or RISC-V."""
    return [
        line.strip()
        for line in listing.splitlines()
        if (match := _FUSED.search(line))
        and not _NOT_FUSED.match(match[0])
        and not line.lstrip().startswith((".", "#"))
    ]


def stack_bound(listing: str, entry: str) -> tuple[int, list[str]]:
    """Bytes of stack that ``entry`` takes at most in Thumb code, by what every function pushes and reserves, and the
    way to the deepest place. Raises ValueError for a call that is not to a name, and for a circle.
    """
    bodies = _functions(listing)

    @cache
    def deepest(name: str) -> tuple[int, tuple[str, ...]]:
        if name in open_calls:
            raise ValueError(f"{name} calls itself")
        body = bodies[name]
        if any(_REGISTER_CALL.search(line) for line in body):
            raise ValueError(f"{name} calls by a register")
        open_calls.add(name)
        called = {match[1] for line in body if (match := _CALL.search(line))} & bodies.keys() - {name}
        below = max((deepest(other) for other in sorted(called)), default=(0, ()))
        open_calls.discard(name)
        return _frame(body) + below[0], (name, *below[1])

    open_calls: set[str] = set()
    size, way = deepest(entry)
    return size, list(way)


def _functions(listing: str) -> dict[str, list[str]]:
    bodies: dict[str, list[str]] = {}
    current: list[str] = []
    for line in listing.splitlines():
        if match := _FUNCTION.match(line):
            current = bodies.setdefault(match[1], [])
        else:
            current.append(line)
    return bodies


_PUSHED = re.compile(r"\t(?:stmdb\tsp!, |push\t)\{([^}]*)\}")
_PUSHED_FLOATS = re.compile(r"\tvpush\t\{([^}]*)\}")
_RESERVED = re.compile(r"\tsubw?\tsp, (?:sp, )?#(\d+)|\tstrd?(?:\.w)?\t.*\[sp, #-(\d+)\]!")


def _frame(body: list[str]) -> int:
    """Bytes pushed and reserved anywhere in a function."""
    size = 0
    for line in body:
        if match := _PUSHED.search(line):
            size += 4 * _registers(match[1])
        elif match := _PUSHED_FLOATS.search(line):
            size += (8 if "d" in match[1] else 4) * _registers(match[1])
        elif match := _RESERVED.search(line):
            size += int(match[1] or match[2])
    return size


def _registers(text: str) -> int:
    count = 0
    for part in text.split(","):
        first, _, last = part.strip().partition("-")
        number = {"sl": 10, "fp": 11, "ip": 12, "sp": 13, "lr": 14, "pc": 15}
        low = number.get(first) or int(first[1:])
        high = (number.get(last) or int(last[1:])) if last else low
        count += high - low + 1
    return count

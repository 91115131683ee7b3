"""Each instruction, once for all lanes where it varies."""

import re

from hil.abreast.widening.block import BlockText, align
from hil.abreast.widening.ir import ARITHMETIC, CASTS, Instruction, IrError
from hil.abreast.widening.text import LANES, LIKELY, MASK, vector

_IN_VECTORS = frozenset(
    [
        "llvm.fabs.f64",
        "llvm.floor.f64",
        "llvm.ceil.f64",
        "llvm.sqrt.f64",
        "llvm.copysign.f64",
        "llvm.smax.i64",
        "llvm.smin.i64",
        "llvm.smax.i32",
        "llvm.smin.i32",
        "llvm.fshl.i64",
    ]
)
"""Exact, so that a vector of them has the bits of each. What rounds as a library likes is called lane by lane."""
_SAME = {"sqrt": "llvm.sqrt.f64"}


def _varies(block: BlockText, instruction: Instruction) -> bool:
    return instruction.result in block.shape.varying.values


def _made(block: BlockText, instruction: Instruction, line: str) -> None:
    assert instruction.result is not None
    block.define(instruction.result, block.text.make(line))


def _arithmetic(block: BlockText, i: Instruction) -> None:
    varies = _varies(block, i)
    of = i.types[0] if i.types else i.type
    values = [block.wide(v, of) if varies else block.one(v) for v in i.operands]
    if varies and i.operation in ("sdiv", "udiv", "srem", "urem"):  # a lane that is off must not divide by its 0
        ones = f"splat ({of} 1)"
        values[1] = block.text.make(f"select {MASK} {block.mask}, {vector(of)} {values[1]}, {vector(of)} {ones}")
    kind = vector(of) if varies else of
    to = f" to {vector(i.type) if varies else i.type}" if i.types else ""
    _made(block, i, f"{i.operation}{i.flags} {kind} {', '.join(values)}{to}")


def _select(block: BlockText, i: Instruction) -> None:
    varies, by_lane = _varies(block, i), block.is_varying(i.operands[0])
    condition = block.wide(i.operands[0], "i1") if by_lane else block.one(i.operands[0])
    kind = vector(i.type) if varies else i.type
    yes, no = (block.wide(v, i.type) if varies else block.one(v) for v in i.operands[1:])
    _made(block, i, f"select {MASK if by_lane else 'i1'} {condition}, {kind} {yes}, {kind} {no}")


def _element(block: BlockText, i: Instruction) -> None:
    """A lane's memory is interleaved with that of the others, so its distances are as many times as long."""
    base, index = i.operands
    text, of = block.text, i.types[0]
    size = i.size * (LANES if block.shape.varying.space_of(base) == "lanes" else 1)
    many_bases, many_indices = block.is_varying(base), block.is_varying(index)
    pointer = block.wide(base, "ptr") if many_bases else block.one(base)
    count = block.wide(index, of) if many_indices else block.one(index)
    kinds = vector("ptr") if many_bases else "ptr", vector(of) if many_indices else of
    _made(block, i, f"getelementptr [{size} x i8], {kinds[0]} {pointer}, {kinds[1]} {count}")
    if not (many_bases or many_indices):
        return
    first, same = block.shade(base) if many_bases else (pointer, "true")
    if many_indices:
        count, agreed = text.agreed(block.mask, of, count)
        same = text.make(f"and i1 {same}, {agreed}")
    assert i.result is not None
    block.keep_shade(i.result, (text.make(f"getelementptr [{size} x i8], ptr {first}, {of} {count}"), same))


def _load(block: BlockText, i: Instruction) -> None:
    (pointer,), text, many = i.operands, block.text, vector(i.type)
    shared = block.shape.varying.space_of(pointer) == "shared"
    if not block.is_varying(pointer):
        kind = i.type if shared else many
        _made(block, i, f"load {kind}, ptr {block.one(pointer)}{align(i.type)}")
        return
    first, same = block.shade(pointer)
    one, each, on = text.new(), text.new(), text.new()
    pointers = block.wide(pointer, "ptr")
    text.fork(same, one, each, LIKELY)
    text.label(one)
    if shared:
        of_all = text.splat(i.type, text.make(f"load {i.type}, ptr {first}{align(i.type)}"))
    else:
        of_all = text.make(f"load {many}, ptr {first}{align(i.type)}")
    text.jump(on)
    text.label(each)
    types = (f"{vector('ptr')}{align(i.type)[1:]}", MASK, many)
    values = (pointers if shared else _laned(block, pointers, i.type), block.mask, "zeroinitializer")
    gathered = text.call(many, f"llvm.masked.gather.v{LANES}{_short(i.type)}.v{LANES}p0", types, values)
    text.jump(on)
    text.label(on)
    _made(block, i, f"phi {many} [ {of_all}, {one} ], [ {gathered}, {each} ]")


def _store(block: BlockText, i: Instruction) -> None:
    value, pointer = i.operands
    if block.shape.varying.space_of(pointer) == "shared":
        raise IrError("a kernel that runs for many devices writes to what they share")
    text, many, wide = block.text, vector(i.type), block.wide(value, i.type)
    if not block.is_varying(pointer):
        text.blend(block.mask, i.type, wide, block.one(pointer), align(i.type))
        return
    first, same = block.shade(pointer)
    one, each, on = text.new(), text.new(), text.new()
    pointers = block.wide(pointer, "ptr")
    text.fork(same, one, each, LIKELY)
    text.label(one)
    text.blend(block.mask, i.type, wide, first, align(i.type))
    text.jump(on)
    text.label(each)
    function, types = f"llvm.masked.scatter.v{LANES}{_short(i.type)}.v{LANES}p0", (many, vector("ptr"), MASK)
    text.declare("void", function, types)
    laned = _laned(block, pointers, i.type)
    handed = f"{many} {wide}, {vector('ptr')}{align(i.type)[1:]} {laned}, {MASK} {block.mask}"
    text.put(f"call void @{function}({handed})")
    text.jump(on)
    text.label(on)


def _zero(block: BlockText, i: Instruction) -> None:
    """Eight bytes each: what is set to 0 at once are numbers of that size."""
    start = block.one(i.operands[0])
    for at in range(0, i.size, 8):
        place = block.text.make(f"getelementptr i8, ptr {start}, i64 {at * LANES}")
        block.text.blend(block.mask, "double", "zeroinitializer", place, align("double"))


def _call(block: BlockText, i: Instruction) -> None:
    text = block.text
    assert i.result is not None
    if not _varies(block, i):
        values = [block.one(v) for v in i.operands]
        block.define(i.result, text.call(i.type, i.callee, i.types, values))
        return
    values = [block.wide(v, t) for v, t in zip(i.operands, i.types, strict=True)]
    callee = _SAME.get(i.callee, i.callee)
    if callee in _IN_VECTORS:
        wider = re.sub(r"\.(f64|i\d+)$", rf".v{LANES}\1", callee)
        block.define(i.result, text.call(vector(i.type), wider, [vector(t) for t in i.types], values))
        return
    found = "poison"
    for lane in range(LANES):
        own = [text.make(f"extractelement {vector(t)} {v}, i64 {lane}") for v, t in zip(values, i.types, strict=True)]
        one = text.call(i.type, i.callee, i.types, own)
        found = text.make(f"insertelement {vector(i.type)} {found}, {i.type} {one}, i64 {lane}")
    block.define(i.result, found)


def _laned(block: BlockText, pointers: str, kind: str) -> str:
    """Pointers of lanes to a field, as pointers each to its lane's own."""
    size = int(align(kind).split()[-1])
    offsets = ", ".join(f"i64 {lane * size}" for lane in range(LANES))
    return block.text.make(f"getelementptr i8, {vector('ptr')} {pointers}, <{LANES} x i64> <{offsets}>")


def _short(kind: str) -> str:
    return "f64" if kind == "double" else kind


_WRITERS = {
    "store": _store, "zero": _zero, "load": _load, "getelementptr": _element, "call": _call, "select": _select,
    **dict.fromkeys([*ARITHMETIC, *CASTS, "icmp", "fcmp", "fneg", "freeze"], _arithmetic),
}  # fmt: skip


def write(block: BlockText, instruction: Instruction) -> None:
    """Write an instruction to a block."""
    _WRITERS[instruction.operation](block, instruction)

"""LLVM's text of a function, read: what LLVM leaves of numba's kernels once all is inlined, and no more than that."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

SIZE = {"double": 8, "i64": 8, "i32": 4, "i16": 2, "i8": 1, "i1": 1, "ptr": 8}
"""Bytes of each type."""
ARITHMETIC = frozenset([
    "fadd", "fsub", "fmul", "fdiv", "frem", "add", "sub", "mul", "sdiv", "udiv", "srem", "urem", "and", "or", "xor",
    "shl", "lshr", "ashr",
])  # fmt: skip
CASTS = frozenset(["zext", "sext", "trunc", "sitofp", "uitofp", "fptosi", "fptoui"])

_NAME = r'%(?:"[^"]*"|[-\w.$]+)'
_TYPE = r"(?:double|i\d+|ptr)"
_VALUE = rf'(?:{_NAME}|@(?:"[^"]*"|[-\w.$]+)|getelementptr [^()]*\([^()]*\)|[-+\w.]+)'
_FLAGS = r"((?: [a-z]+)*)"
_META = re.compile(r"(, ![\w.]+ ![\w.]+|, ![\w.]+ !\{\})+$")


class IrError(ValueError):
    """What is read has something that is not known here; the message has the line."""


@dataclass(eq=False)
class Instruction:
    """``result`` is None for what gives no value; ``flags`` stand between the operation and its type."""

    result: str | None
    operation: str
    type: str
    operands: list[str]
    flags: str = ""
    types: tuple[str, ...] = ()
    """of a call's operands; (before,) of a cast"""
    callee: str = ""
    labels: tuple[str, ...] = ()
    """of a phi where each operand comes from; of a branch where it goes, a switch's default first"""
    cases: tuple[str, ...] = ()
    """of a switch, those of ``labels[1:]``"""
    size: int = 0
    """of a getelementptr: bytes for each count of its index, ``types[0]``; of ``zero``: bytes"""
    block: str = ""


@dataclass(eq=False)
class Block:
    """``phis`` and ``instructions`` in their order, and how it ends."""

    name: str
    phis: list[Instruction] = field(default_factory=list)
    instructions: list[Instruction] = field(default_factory=list)
    end: Instruction = field(default_factory=lambda: Instruction(None, "unreachable", "", []))

    @property
    def followers(self) -> tuple[str, ...]:
        """Blocks that may come next, each once."""
        return tuple(dict.fromkeys(self.end.labels))

    @property
    def each(self) -> Iterator[Instruction]:
        """Phis and instructions."""
        yield from self.phis
        yield from self.instructions


class Function(NamedTuple):
    """``arguments``: (type, name) of each."""

    name: str
    arguments: list[tuple[str, str]]
    blocks: dict[str, Block]


def functions(module: str) -> Iterator[Function]:
    """Those that are defined in a module's text. Raises ``IrError``."""
    for found in re.finditer(r"^define [^\n]*\{\n.*?^\}$", module, re.MULTILINE | re.DOTALL):
        yield _function(found[0].splitlines())


def _function(lines: list[str]) -> Function:
    head = re.match(r"define [^@]*i32 @([\w.]+)\((.*)\)[^{]*\{", lines[0])
    if head is None:
        raise IrError(lines[0])
    arguments = [(words[0], words[-1]) for words in (text.split() for text in head[2].split(","))]
    blocks: dict[str, Block] = {}
    rest = iter(lines[1:])
    for line in rest:
        label = re.match(r'("[^"]*"|[-\w.$]+):', line)
        if label or not blocks:
            block = Block(label[1] if label else "entry")
            blocks[block.name] = block
        if label or not line.strip() or line.startswith(("}", ";")):
            continue
        text = _META.sub("", line.strip())
        while text.startswith("switch") and not text.endswith("]"):
            text += " " + next(rest).strip()
        _put(block, _instruction(text))
    return Function(head[1], arguments, blocks)


def _put(block: Block, instruction: Instruction) -> None:
    instruction.block = block.name
    if instruction.operation == "phi":
        block.phis.append(instruction)
    elif instruction.operation in ("br", "switch", "ret", "unreachable"):
        block.end = instruction
    else:
        block.instructions.append(instruction)


def _instruction(text: str) -> Instruction:
    named = re.match(rf"({_NAME}) = (.*)$", text)
    result, words = (named[1], named[2]) if named else (None, text)
    for read in (_ending, _arithmetic, _choice, _memory, _call):
        found = read(words)
        if found is not None:
            found.result = result
            return found
    raise IrError(text)


def _ending(text: str) -> Instruction | None:
    if found := re.match(rf"br label %({_NAME[1:]})$", text):
        return Instruction(None, "br", "", [], labels=(found[1],))
    if found := re.match(rf"br i1 ({_VALUE}), label ({_NAME}), label ({_NAME})$", text):
        return Instruction(None, "br", "i1", [found[1]], labels=(found[2][1:], found[3][1:]))
    if found := re.match(rf"switch (i\d+) ({_VALUE}), label ({_NAME}) \[(.*)\]$", text):
        cases = re.findall(rf"{found[1]} (-?\w+), label ({_NAME})", found[4])
        labels = (found[3][1:], *(label[1:] for _, label in cases))
        return Instruction(None, "switch", found[1], [found[2]], labels=labels, cases=tuple(case for case, _ in cases))
    if found := re.match(rf"ret (\w+) ({_VALUE})$", text):
        return Instruction(None, "ret", found[1], [found[2]])
    return Instruction(None, "unreachable", "", []) if text == "unreachable" else None


def _arithmetic(text: str) -> Instruction | None:
    if (found := re.match(rf"(\w+){_FLAGS} ({_TYPE}) ({_VALUE}), ({_VALUE})$", text)) and found[1] in ARITHMETIC:
        return Instruction(None, found[1], found[3], [found[4], found[5]], found[2])
    if found := re.match(rf"(icmp|fcmp){_FLAGS} ([a-z]+) ({_TYPE}) ({_VALUE}), ({_VALUE})$", text):
        return Instruction(None, found[1], found[4], [found[5], found[6]], f"{found[2]} {found[3]}")
    if (found := re.match(rf"(\w+){_FLAGS} ({_TYPE}) ({_VALUE}) to ({_TYPE})$", text)) and found[1] in CASTS:
        return Instruction(None, found[1], found[5], [found[4]], found[2], types=(found[3],))
    if found := re.match(rf"(fneg|freeze){_FLAGS} ({_TYPE}) ({_VALUE})$", text):
        return Instruction(None, found[1], found[3], [found[4]], found[2])
    return None


def _choice(text: str) -> Instruction | None:
    if found := re.match(rf"phi (?:[a-z]+ )*?({_TYPE}) (\[.*)$", text):
        come = re.findall(rf"\[ ({_VALUE}), ({_NAME}) \]", found[2])
        return Instruction(None, "phi", found[1], [v for v, _ in come], labels=tuple(label[1:] for _, label in come))
    if found := re.match(rf"select i1 ({_VALUE}), ({_TYPE}) ({_VALUE}), {_TYPE} ({_VALUE})$", text):
        return Instruction(None, "select", found[2], [found[1], found[3], found[4]])
    return None


def _memory(text: str) -> Instruction | None:
    if found := re.match(rf"load ({_TYPE}), ptr ({_VALUE}), align \d+$", text):
        return Instruction(None, "load", found[1], [found[2]])
    if found := re.match(rf"store ({_TYPE}) ({_VALUE}), ptr ({_VALUE}), align \d+$", text):
        return Instruction(None, "store", found[1], [found[2], found[3]])
    element = rf"getelementptr{_FLAGS} ({_TYPE}|\[\d+ x i8\]), ptr ({_VALUE}), (i\d+) ({_VALUE})$"
    if found := re.match(element, text):
        size = SIZE.get(found[2]) or int(found[2][1:].split()[0])
        return Instruction(None, "getelementptr", "ptr", [found[3], found[5]], types=(found[4],), size=size)
    zero = rf"(?:tail )?call void @llvm\.memset\.p0\.i64\(ptr [^%]*({_NAME}), i8 0, i64 (\d+), i1 false\)"
    if found := re.match(zero, text):
        return Instruction(None, "zero", "", [found[1]], size=int(found[2]))
    return None


def _call(text: str) -> Instruction | None:
    found = re.match(rf"(?:tail )?call ({_TYPE}) @([\w.]+)\((.*)\)(?: #\d+)?$", text)
    if found is None:
        return None
    handed = [words.split() for words in re.sub(r"range\([^)]*\) ", "", found[3]).split(", ")]
    types, operands = tuple(words[0] for words in handed), [words[-1] for words in handed]
    return Instruction(None, "call", found[1], operands, types=types, callee=found[2])

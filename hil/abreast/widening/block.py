"""One block of a function as it is written: what its values are called there, and where they are kept."""

from hil.abreast.widening.ir import SIZE
from hil.abreast.widening.shape import Shape
from hil.abreast.widening.text import Text, quoted

Shade = tuple[str, str]
"""The first lane's pointer, and whether it is that of all."""


class BlockText:
    """``mask``: lanes that are on."""

    def __init__(self, text: Text, shape: Shape, name: str, mask: str) -> None:
        self.text, self.shape, self.name, self.mask = text, shape, name, mask
        self.known: dict[str, str] = {}
        self._wide: dict[str, str] = {}
        self._shades: dict[str, Shade] = {}

    def is_varying(self, operand: str) -> bool:
        """Whether it is a value of each lane here."""
        return self.shape.varying.is_varying(operand, self.name)

    def one(self, operand: str) -> str:
        """A value that is one for all lanes."""
        if operand not in self.shape.varying.made:
            return operand
        if operand not in self.known:
            place = self._place("of ", operand)
            self.known[operand] = self.text.make(f"load {self.shape.kind[operand]}, ptr {place}")
        return self.known[operand]

    def wide(self, operand: str, kind: str) -> str:
        """A value of each lane."""
        if operand not in self.shape.kind:
            if operand in ("zeroinitializer", "poison", "undef"):
                return operand
            if operand.startswith(("@", "getelementptr")):
                return self.text.splat(kind, operand)
            return f"splat ({kind} {operand})"
        if operand not in self._wide:
            self._wide[operand] = self._made_wide(operand, kind)
        return self._wide[operand]

    def define(self, result: str, name: str) -> None:
        """What a value is called here, and to where it is needed."""
        varies = result in self.shape.varying.values
        (self._wide if varies else self.known)[result] = name
        kind = self.shape.type_of(result)
        if self.shape.uses(result, near=True):
            self.text.put(f"store {kind} {name}, ptr {quoted('of ', result)}")
        away = self.shape.uses(result, near=False)
        if not away:
            return
        loops = self.shape.regions.around(self.name)
        leaves = any(used not in self.shape.flow.loops[header] for header in loops for used in away)
        if varies and leaves:
            self.text.blend(self.mask, self.shape.kind[result], name, quoted("far of ", result))
        else:
            self.text.put(f"store {kind} {name}, ptr {quoted('far of ', result)}")
        if self.shape.is_left_apart(result):
            scalar = self.shape.kind[result]
            many = self.text.splat(scalar, name)
            self.text.blend(self.mask, scalar, many, quoted("far apart ", result))

    def shade(self, pointer: str) -> Shade:
        """Of a pointer that varies."""
        if pointer not in self._shades:
            apart = self.shape.varying.is_apart(pointer, self.name)
            if not self.shape.has_shade(pointer) or apart:
                self._shades[pointer] = self.text.agreed(self.mask, "ptr", self.wide(pointer, "ptr"))
            else:
                first = self.text.make(f"load ptr, ptr {self._place('first ', pointer)}")
                self._shades[pointer] = first, self.text.make(f"load i1, ptr {self._place('same ', pointer)}")
        return self._shades[pointer]

    def keep_shade(self, pointer: str, shade: Shade) -> None:
        """For whoever loads or stores there."""
        self._shades[pointer] = shade
        for near, prefix in ((True, ""), (False, "far ")):
            if self.shape.uses(pointer, near=near):
                self.text.put(f"store ptr {shade[0]}, ptr {quoted(prefix + 'first ', pointer)}")
                self.text.put(f"store i1 {shade[1]}, ptr {quoted(prefix + 'same ', pointer)}")

    def forget(self) -> "BlockText":
        """A copy for one of several ways to go on: what is loaded on one is not known on another."""
        copy = BlockText(self.text, self.shape, self.name, self.mask)
        copy.known, copy._wide, copy._shades = dict(self.known), dict(self._wide), dict(self._shades)
        return copy

    def _place(self, prefix: str, value: str) -> str:
        return quoted(prefix if self.shape.is_near(value, self.name) else "far " + prefix, value)

    def _made_wide(self, operand: str, kind: str) -> str:
        if not self.is_varying(operand):
            return self.text.splat(kind, self.one(operand))
        if operand in self.shape.varying.values:
            return self.text.load(self.mask, kind, self._place("of ", operand))
        return self.text.load(self.mask, kind, quoted("far apart ", operand))


def align(kind: str) -> str:
    """Of what lies in a lane's memory."""
    return f", align {SIZE[kind]}"

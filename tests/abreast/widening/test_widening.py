"""Kernels widened: whatever way each lane takes through a program, it leaves the bits of the program run for it alone.

Programs are drawn: a record of doubles and whole numbers, a table that all share, branches, switches and loops that
lanes pass together or not, and returns out of any of them.
"""

import ctypes
from functools import cache

import llvmlite.binding as llvm
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.abreast.machine import can_be_had
from hil.abreast.widening.ir import IrError
from hil.abreast.widening.records import one_by_one, side_by_side
from hil.abreast.widening.text import LANES
from hil.abreast.widening.widened import widened

pytestmark = pytest.mark.skipif(not can_be_had(), reason="needs the vectors of AVX-512")

RECORD = np.dtype(
    [("x", "f8", (4,)), ("y", "f8", (4,)), ("n", "i8", (3,)), ("flag", "u1"), ("small", "i4")], align=True
)
TABLE = np.dtype([("t", "f8", (8,))])
_OFFSET = {"x": 0, "y": 32, "n": 64}


class Written:
    """A program as LLVM's text; its variables are in memory, of which LLVM makes values that flow."""

    def __init__(self, program):
        self.lines, self.counters, self.count = [], [], 0
        for kind, name, many in (("double", "x", 4), ("i64", "n", 3)):
            for i in range(many):
                self.put(f"%{name}{i} = alloca {kind}")
                self.put(f"store {kind} {self.make(f'load {kind}, ptr {self.place(name, i)}')}, ptr %{name}{i}")
        self.block(program)
        self.leave(0)

    def put(self, line):
        self.lines.append("  " + line)

    def make(self, line):
        self.count += 1
        self.put(f"%v{self.count} = {line}")
        return f"%v{self.count}"

    def label(self):
        self.count += 1
        return f"l{self.count}"

    def begin(self, label):
        self.put(f"br label %{label}")
        self.lines.append(f"{label}:")

    def place(self, name, i):
        return self.make(f"getelementptr i8, ptr %own, i64 {_OFFSET[name] + 8 * i}")

    def element(self, base, offset, index):
        start = self.make(f"getelementptr i8, ptr {base}, i64 {offset}")
        return self.make(f"getelementptr double, ptr {start}, i64 {index}")

    def value(self, name, i):
        return self.make(f"load {'double' if name == 'x' else 'i64'}, ptr %{name}{i}")

    def keep(self, i, value):
        """A double, unless it has grown beyond bounds or is none."""
        size = self.make(f"call double @llvm.fabs.f64(double {value})")
        fits = self.make(f"fcmp olt double {size}, 1.0e6")
        self.put(f"store double {self.make(f'select i1 {fits}, double {value}, double 0.75')}, ptr %x{i}")

    def leave(self, status):
        for kind, name, many in (("double", "x", 4), ("i64", "n", 3)):
            for i in range(many):
                self.put(f"store {kind} {self.value(name, i)}, ptr {self.place(name, i)}")
        self.put(f"ret i32 {status}")

    def block(self, statements):
        for kind, *what in statements:
            getattr(self, kind)(*what)

    def compute(self, operation, i, j, k):
        self.keep(i, self.make(f"{operation} double {self.value('x', j)}, {self.value('x', k)}"))

    def library(self, function, i, j):
        size = self.make(f"call double @llvm.fabs.f64(double {self.value('x', j)})")
        self.keep(i, self.make(f"call double @{function}(double {size})"))

    def whole(self, operation, i, j, number):
        found = self.make(f"{operation} i64 {self.value('n', j)}, {number}")
        self.put(f"store i64 {self.make(f'and i64 {found}, 7')}, ptr %n{i}")

    def divide(self, i, j):
        by = self.value("n", j)
        label, on = self.label(), self.label()
        self.put(f"br i1 {self.make(f'icmp eq i64 {by}, 0')}, label %{on}, label %{label}")
        self.lines.append(f"{label}:")
        found = self.make(f"udiv i64 {self.value('n', i)}, {by}")
        self.put(f"store i64 {found}, ptr %n{i}")
        self.begin(on)

    def put_at(self, i, j):
        index = self.make(f"and i64 {self.value('n', i)}, 3")
        self.put(f"store double {self.value('x', j)}, ptr {self.element('%own', 32, index)}")

    def get_at(self, i, j):
        index = self.make(f"and i64 {self.value('n', j)}, 3")
        self.keep(i, self.make(f"load double, ptr {self.element('%own', 32, index)}"))

    def look_up(self, i, j):
        self.keep(i, self.make(f"load double, ptr {self.element('%table', 0, self.value('n', j))}"))

    def fork(self, i, j, of, yes, no):
        one, other, on = self.label(), self.label(), self.label()
        if of == "x":
            condition = self.make(f"fcmp olt double {self.value('x', i)}, {self.value('x', j)}")
        else:
            condition = self.make(f"icmp ult i64 {self.value('n', i)}, {self.value('n', j)}")
        self.put(f"br i1 {condition}, label %{one}, label %{other}")
        self.lines.append(f"{one}:")
        self.block(yes)
        self.put(f"br label %{on}")
        self.lines.append(f"{other}:")
        self.block(no)
        self.begin(on)

    def cases(self, i, ways):
        labels, on = [self.label() for _ in ways], self.label()
        index = self.make(f"and i64 {self.value('n', i)}, 3")
        known = " ".join(f"i64 {n}, label %{label}" for n, label in enumerate(labels))
        self.put(f"switch i64 {index}, label %{on} [ {known} ]")
        for label, way in zip(labels, ways, strict=True):
            self.lines.append(f"{label}:")
            self.block(way)
            self.put(f"br label %{on}")
        self.lines.append(f"{on}:")

    def loop(self, i, each, out, told):
        """As often as a number says, or three times; ``out``: also left where that number is above 5; ``told``: the
        number that is then how often it was.
        """
        head, body, on, again = (self.label() for _ in range(4))
        counter = f"%times{len(self.counters)}"
        self.counters.append(f"  {counter} = alloca i64\n")
        times = "3" if i is None else self.make(f"and i64 {self.value('n', i)}, 3")
        self.put(f"store i64 0, ptr {counter}")
        self.begin(head)
        now = self.make(f"load i64, ptr {counter}")
        self.put(f"br i1 {self.make(f'icmp ult i64 {now}, {times}')}, label %{body}, label %{on}")
        self.lines.append(f"{body}:")
        self.put(f"store i64 {self.make(f'add i64 {now}, 1')}, ptr {counter}")
        self.block(each)
        if out is None:
            self.put(f"br label %{head}")
        else:
            above = self.make(f"icmp ugt i64 {self.value('n', out)}, 5")
            self.put(f"br i1 {above}, label %{on}, label %{again}")
            self.lines.append(f"{again}:")
            self.put(f"br label %{head}")
        self.lines.append(f"{on}:")
        self.put(f"store i64 {self.make(f'load i64, ptr {counter}')}, ptr %n{told}")

    def repeat(self, i, each):
        """Once, and up to two times more while a number is even; what it makes is used behind it as it is."""
        body, on, counter = self.label(), self.label(), f"%times{len(self.counters)}"
        self.counters.append(f"  {counter} = alloca i64\n")
        self.put(f"store i64 0, ptr {counter}")
        self.begin(body)
        self.block(each)
        now = self.make(f"add i64 {self.make(f'load i64, ptr {counter}')}, 1")
        self.put(f"store i64 {now}, ptr {counter}")
        few = self.make(f"icmp ult i64 {now}, 3")
        odd = self.make(f"and i64 {self.value('n', i)}, 1")
        even = self.make(f"icmp eq i64 {odd}, 0")
        self.put(f"br i1 {self.make(f'and i1 {few}, {even}')}, label %{body}, label %{on}")
        self.lines.append(f"{on}:")

    def leave_if(self, i, number, status):
        gone, on = self.label(), self.label()
        found = self.make(f"icmp eq i64 {self.value('n', i)}, {number}")
        self.put(f"br i1 {found}, label %{gone}, label %{on}")
        self.lines.append(f"{gone}:")
        self.leave(status)
        self.lines.append(f"{on}:")

    @property
    def text(self):
        body = "\n".join(self.lines)
        declared = "\n".join(f"declare double @{name}(double)" for name in ("llvm.fabs.f64", "sqrt", "sin"))
        return f"define i32 @program(ptr %own, ptr %table) {{\nentry:\n{''.join(self.counters)}{body}\n}}\n{declared}\n"


X, N = st.integers(0, 3), st.integers(0, 2)
PLAIN = st.one_of(
    st.tuples(st.just("compute"), st.sampled_from(["fadd", "fsub", "fmul", "fdiv"]), X, X, X),
    st.tuples(st.just("library"), st.sampled_from(["sqrt", "sin"]), X, X),
    st.tuples(st.just("whole"), st.sampled_from(["add", "sub", "mul", "xor"]), N, N, st.integers(1, 6)),
    st.tuples(st.just("divide"), N, N),
    st.tuples(st.just("put_at"), N, X),
    st.tuples(st.just("get_at"), X, N),
    st.tuples(st.just("look_up"), X, N),
    st.tuples(st.just("leave_if"), N, st.integers(0, 7), st.integers(0, 3)),
)


def deeper(statement):
    some = st.lists(statement, max_size=3)
    return st.one_of(
        st.tuples(st.just("fork"), N, N, st.sampled_from("xn"), some, some),
        st.tuples(st.just("cases"), N, st.lists(some, min_size=1, max_size=3)),
        st.tuples(st.just("repeat"), N, some),
        st.tuples(st.just("loop"), st.one_of(st.none(), N), some, st.one_of(st.none(), N), N),
    )


PROGRAMS = st.lists(st.recursive(PLAIN, deeper, max_leaves=12), min_size=1, max_size=8)


def simplified(text):
    """As what is widened comes: values in place of variables."""
    module = llvm.parse_assembly(text)
    passes = llvm.create_new_module_pass_manager()
    for add in (
        "sroa",
        "instruction_combine",
        "simplify_cfg",
        "new_gvn",
        "loop_rotate",
        "instruction_combine",
        "simplify_cfg",
    ):
        getattr(passes, f"add_{add}_pass")()
    passes.run(module, llvm.create_pass_builder(target(), llvm.create_pipeline_tuning_options(speed_level=2)))
    return str(module)


@cache
def target():
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    cpu, features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    return llvm.Target.from_default_triple().create_target_machine(cpu=cpu, features=features, opt=1)


def made(text):
    module = llvm.parse_assembly(text)
    engine = llvm.create_mcjit_compiler(
        llvm.parse_assembly(""), llvm.Target.from_default_triple().create_target_machine()
    )
    engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(target().emit_object(module)))
    engine.finalize_object()
    return engine, engine.get_function_address("program")


def records(seed, alike):
    """A record for each lane of two groups; the first ``alike`` of a group are the same."""
    rng, found = np.random.default_rng(seed), np.zeros(2 * LANES, RECORD)
    found["x"], found["y"] = rng.normal(size=(2, 2 * LANES, 4))
    found["n"] = rng.integers(0, 8, size=(2 * LANES, 3))
    found["flag"], found["small"] = rng.integers(0, 2, 2 * LANES), rng.integers(-9, 9, 2 * LANES)
    for group in (found[:LANES], found[LANES:]):
        group[:alike] = group[0]
    return found


def one_after_another(program, own, table):
    _kept, address = program
    run = ctypes.CFUNCTYPE(ctypes.c_int32, *[ctypes.c_void_p] * 2)(address)
    return [run(own[n : n + 1].ctypes.data, table.ctypes.data) for n in range(len(own))]


@settings(max_examples=150)
@given(PROGRAMS, st.integers(0, 1000), st.sampled_from([1, 2, LANES // 2, LANES]))
def test_each_lane_has_the_bits_of_the_program_run_for_it_alone(program, seed, alike):
    text = simplified(Written(program).text)
    wide, frame = widened(text, {"table"})
    own, table = records(seed, alike), np.random.default_rng(seed + 1).normal(size=8)
    groups = side_by_side(own)
    _kept, address = made(wide)
    room = np.zeros(frame + 64, np.uint8)
    run = ctypes.CFUNCTYPE(ctypes.c_int32, *[ctypes.c_void_p] * 3)(address)
    frame_at = room.ctypes.data - room.ctypes.data % -64
    together = [run(group.ctypes.data, table.ctypes.data, frame_at) for group in groups]
    status = one_after_another(made(text), own, table)
    assert one_by_one(groups, RECORD).tobytes() == cleared(own).tobytes()
    for n, each in enumerate(together):
        assert each == np.bitwise_or.reduce(status[n * LANES : (n + 1) * LANES])


def cleared(own):
    """With zeros between fields."""
    return one_by_one(side_by_side(own), RECORD)


def test_what_all_share_is_not_written_to():
    text = (
        "define i32 @program(ptr %own, ptr %table) {\nentry:\n  store double 1.0, ptr %table, align 8\n  ret i32 0\n}\n"
    )
    with pytest.raises(IrError, match="share"):
        widened(text, {"table"})


def test_what_is_not_known_is_told_with_its_line():
    text = "define i32 @program(ptr %own) {\nentry:\n  fence seq_cst\n  ret i32 0\n}\n"
    with pytest.raises(IrError, match="fence seq_cst"):
        widened(text, ())


def test_a_loop_with_two_entries_is_refused():
    text = (
        "define i32 @program(ptr %own) {\nentry:\n  %v = load i64, ptr %own, align 8\n  %c = icmp eq i64 %v, 0\n"
        "  br i1 %c, label %a, label %b\na:\n  br label %b\nb:\n  %w = load i64, ptr %own, align 8\n"
        "  %d = icmp eq i64 %w, 0\n  br i1 %d, label %a, label %end\nend:\n  ret i32 0\n}\n"
    )
    with pytest.raises(IrError, match="two entries"):
        widened(text, ())

"""What a processor lacks, as LLVM IR: so that the object needs no library of mathematics and no helpers.

Each gives the correctly rounded result, so it has the bits of the instruction that it stands in for.
"""

from typing import Final

FLOOR: Final = """
define internal double @pkxyz.floor(double %x) nounwind {
  %size = call double @llvm.fabs.f64(double %x)
  %unit = call double @llvm.copysign.f64(double 4503599627370496.0, double %x)
  %up = fadd double %x, %unit
  %nearest = fsub double %up, %unit
  %above = fcmp ogt double %nearest, %x
  %below = fsub double %nearest, 1.0
  %floor = select i1 %above, double %below, double %nearest
  %has_fraction = fcmp olt double %size, 4503599627370496.0
  %result = select i1 %has_fraction, double %floor, double %x
  ret double %result
}
declare double @llvm.copysign.f64(double, double)
"""
"""From 2^52 on a double has no fraction; below, adding 2^52 rounds it away."""

CONVERSIONS: Final = """
define internal double @pkxyz.from_i64(i64 %x) noinline nounwind {
  %top = ashr i64 %x, 32
  %high = trunc i64 %top to i32
  %low = trunc i64 %x to i32
  %high_f = sitofp i32 %high to double
  %low_f = uitofp i32 %low to double
  %scaled = fmul double %high_f, 4294967296.0
  %sum = fadd double %scaled, %low_f
  ret double %sum
}
define internal double @pkxyz.from_u64(i64 %x) noinline nounwind {
  %top = lshr i64 %x, 32
  %high = trunc i64 %top to i32
  %low = trunc i64 %x to i32
  %high_f = uitofp i32 %high to double
  %low_f = uitofp i32 %low to double
  %scaled = fmul double %high_f, 4294967296.0
  %sum = fadd double %scaled, %low_f
  ret double %sum
}
define internal i64 @pkxyz.to_i64(double %x) noinline nounwind {
  %size = call double @llvm.fabs.f64(double %x)
  %scaled = fmul double %size, 0x3DF0000000000000
  %high = fptoui double %scaled to i32
  %high_f = uitofp i32 %high to double
  %back = fmul double %high_f, 4294967296.0
  %rest = fsub double %size, %back
  %low = fptoui double %rest to i32
  %high_w = zext i32 %high to i64
  %low_w = zext i32 %low to i64
  %top = shl i64 %high_w, 32
  %whole = or i64 %top, %low_w
  %negated = sub i64 0, %whole
  %is_negative = fcmp olt double %x, 0.0
  %result = select i1 %is_negative, i64 %negated, i64 %whole
  ret i64 %result
}
"""
"""Between 64-bit integers and doubles where the processor has them for 32 bits only: both halves are exact, so their
sum is rounded once."""

DIVISIONS: Final = """
define internal i64 @pkxyz.udiv(i64 %a, i64 %b) noinline nounwind optsize {
entry:
  br label %digit
digit:
  %left = phi i32 [ 64, %entry ], [ %left_next, %digit ]
  %rest = phi i64 [ 0, %entry ], [ %rest_next, %digit ]
  %open = phi i64 [ %a, %entry ], [ %open_next, %digit ]
  %found = phi i64 [ 0, %entry ], [ %found_next, %digit ]
  %carried = icmp slt i64 %rest, 0
  %doubled = shl i64 %rest, 1
  %top = lshr i64 %open, 63
  %with_top = or i64 %doubled, %top
  %reached = icmp uge i64 %with_top, %b
  %fits = or i1 %carried, %reached
  %less = sub i64 %with_top, %b
  %rest_next = select i1 %fits, i64 %less, i64 %with_top
  %one = zext i1 %fits to i64
  %longer = shl i64 %found, 1
  %found_next = or i64 %longer, %one
  %open_next = shl i64 %open, 1
  %left_next = sub i32 %left, 1
  %more = icmp ne i32 %left_next, 0
  br i1 %more, label %digit, label %done
done:
  ret i64 %found_next
}
define internal i64 @pkxyz.urem(i64 %a, i64 %b) nounwind optsize {
  %whole = call i64 @pkxyz.udiv(i64 %a, i64 %b)
  %taken = mul i64 %whole, %b
  %rest = sub i64 %a, %taken
  ret i64 %rest
}
define internal i64 @pkxyz.sdiv(i64 %a, i64 %b) noinline nounwind optsize {
  %minus_a = sub i64 0, %a
  %minus_b = sub i64 0, %b
  %a_below = icmp slt i64 %a, 0
  %b_below = icmp slt i64 %b, 0
  %a_size = select i1 %a_below, i64 %minus_a, i64 %a
  %b_size = select i1 %b_below, i64 %minus_b, i64 %b
  %size = call i64 @pkxyz.udiv(i64 %a_size, i64 %b_size)
  %negated = sub i64 0, %size
  %differ = xor i1 %a_below, %b_below
  %whole = select i1 %differ, i64 %negated, i64 %size
  ret i64 %whole
}
define internal i64 @pkxyz.srem(i64 %a, i64 %b) nounwind optsize {
  %whole = call i64 @pkxyz.sdiv(i64 %a, i64 %b)
  %taken = mul i64 %whole, %b
  %rest = sub i64 %a, %taken
  ret i64 %rest
}
"""
"""Of 64-bit integers, bit by bit, where the processor divides 32 bits only: a heartbeat late by periods takes one."""

SQUARE_ROOT: Final = """
define internal double @pkxyz.sqrt(double %x) noinline nounwind {
entry:
  %positive = fcmp ogt double %x, 0.0
  %finite = fcmp olt double %x, 0x7FF0000000000000
  %ordinary = and i1 %positive, %finite
  br i1 %ordinary, label %scale, label %special
special:
  %negative = fcmp olt double %x, 0.0
  %same = select i1 %negative, double 0x7FF8000000000000, double %x
  ret double %same
scale:
  %tiny = fcmp olt double %x, 0x0010000000000000
  %larger = fmul double %x, 0x4350000000000000
  %normal = select i1 %tiny, double %larger, double %x
  %bias = select i1 %tiny, i64 54, i64 0
  %bits = bitcast double %normal to i64
  %field = lshr i64 %bits, 52
  %unbiased = sub i64 %field, 1023
  %exponent = sub i64 %unbiased, %bias
  %fraction = and i64 %bits, 4503599627370495
  %mantissa = or i64 %fraction, 4503599627370496
  %odd = and i64 %exponent, 1
  %even = shl i64 %mantissa, %odd
  %first = shl i64 %even, 1
  br label %digit
digit:
  %rest = phi i64 [ %first, %scale ], [ %rest_next, %digit ]
  %found = phi i64 [ 0, %scale ], [ %found_next, %digit ]
  %doubled = phi i64 [ 0, %scale ], [ %doubled_next, %digit ]
  %one = phi i64 [ 9007199254740992, %scale ], [ %one_next, %digit ]
  %trial = add i64 %doubled, %one
  %fits = icmp ule i64 %trial, %rest
  %taken = select i1 %fits, i64 %trial, i64 0
  %left = sub i64 %rest, %taken
  %rest_next = shl i64 %left, 1
  %with_one = add i64 %trial, %one
  %doubled_next = select i1 %fits, i64 %with_one, i64 %doubled
  %digit_one = select i1 %fits, i64 %one, i64 0
  %found_next = add i64 %found, %digit_one
  %one_next = lshr i64 %one, 1
  %more = icmp ne i64 %one_next, 0
  br i1 %more, label %digit, label %round
round:
  %inexact = icmp ne i64 %rest_next, 0
  %last = and i64 %found_next, 1
  %up = select i1 %inexact, i64 %last, i64 0
  %rounded = add i64 %found_next, %up
  %root = lshr i64 %rounded, 1
  %half = ashr i64 %exponent, 1
  %field_root = add i64 %half, 1022
  %at_place = shl i64 %field_root, 52
  %result_bits = add i64 %root, %at_place
  %result = bitcast i64 %result_bits to double
  ret double %result
}
"""
"""Digit by digit in integers, with one digit more than a double holds to round by: for a processor without the
instruction."""

MEMORY: Final = """
define internal void @pkxyz.fill(ptr %to, SIZE %n, i8 %byte) noinline nounwind "no-builtins" {
entry:
  %some = icmp ne SIZE %n, 0
  br i1 %some, label %each, label %done
each:
  %i = phi SIZE [ 0, %entry ], [ %next, %each ]
  %at = getelementptr i8, ptr %to, SIZE %i
  store i8 %byte, ptr %at
  %next = add SIZE %i, 1
  %more = icmp ult SIZE %next, %n
  br i1 %more, label %each, label %done
done:
  ret void
}
define internal void @pkxyz.clear_words(ptr %to, SIZE %n) noinline nounwind "no-builtins" {
entry:
  %whole = and SIZE %n, -4
  %some = icmp ne SIZE %whole, 0
  br i1 %some, label %each, label %rest
each:
  %i = phi SIZE [ 0, %entry ], [ %next, %each ]
  %at = getelementptr i8, ptr %to, SIZE %i
  store i32 0, ptr %at, align 4
  %next = add SIZE %i, 4
  %more = icmp ult SIZE %next, %whole
  br i1 %more, label %each, label %rest
rest:
  %tail = getelementptr i8, ptr %to, SIZE %whole
  %left = and SIZE %n, 3
  call void @pkxyz.fill(ptr %tail, SIZE %left, i8 0)
  ret void
}
define internal void @pkxyz.move(ptr %to, ptr %from, SIZE %n) noinline nounwind "no-builtins" {
entry:
  %some = icmp ne SIZE %n, 0
  br i1 %some, label %choose, label %done
choose:
  %to_at = ptrtoint ptr %to to SIZE
  %from_at = ptrtoint ptr %from to SIZE
  %upwards = icmp ule SIZE %to_at, %from_at
  br i1 %upwards, label %up, label %down
up:
  %i = phi SIZE [ 0, %choose ], [ %i_next, %up ]
  %source = getelementptr i8, ptr %from, SIZE %i
  %sink = getelementptr i8, ptr %to, SIZE %i
  %byte = load i8, ptr %source
  store i8 %byte, ptr %sink
  %i_next = add SIZE %i, 1
  %i_more = icmp ult SIZE %i_next, %n
  br i1 %i_more, label %up, label %done
down:
  %k = phi SIZE [ %n, %choose ], [ %k_next, %down ]
  %k_next = sub SIZE %k, 1
  %source_down = getelementptr i8, ptr %from, SIZE %k_next
  %sink_down = getelementptr i8, ptr %to, SIZE %k_next
  %byte_down = load i8, ptr %source_down
  store i8 %byte_down, ptr %sink_down
  %k_more = icmp ne SIZE %k_next, 0
  br i1 %k_more, label %down, label %done
done:
  ret void
}
"""
_FILL = "define weak {type} @{name}(ptr %to, {order}) nounwind {{\n  {work}\n  {end}\n}}\n"


def memory_functions(names: set[str], size: str) -> str:
    """Those of the C library and of ARM's run-time interface that code generators call, weak: a library's own win.

    ``size``: LLVM's type of a size. Names that are none of them are left out.
    """
    made = [made for name in sorted(names) if (made := _memory_function(name, size))]
    return MEMORY.replace("SIZE", size) + "".join(made) if made else ""


def _memory_function(name: str, size: str) -> str:
    stem = name.removeprefix("__aeabi_").rstrip("48")
    result, end = ("ptr", "ret ptr %to") if stem == name else ("void", "ret void")
    if stem in ("memcpy", "memmove"):
        order = f"ptr %from, {size} %n"
        work = f"call void @pkxyz.move(ptr %to, ptr %from, {size} %n)"
    elif stem == "memclr" and name != stem:
        order = f"{size} %n"
        words = name.endswith(("4", "8"))
        work = (
            f"call void @pkxyz.clear_words(ptr %to, {size} %n)"
            if words
            else f"call void @pkxyz.fill(ptr %to, {size} %n, i8 0)"
        )
    elif stem == "memset":
        order = f"i32 %value, {size} %n" if stem == name else f"{size} %n, i32 %value"
        work = f"%byte = trunc i32 %value to i8\n  call void @pkxyz.fill(ptr %to, {size} %n, i8 %byte)"
    else:
        return ""
    return _FILL.format(type=result, name=name, order=order, work=work, end=end)

"""The search, compiled: every state that can be reached, by number, the nearest first, and what is true of them all."""

from typing import Final, NamedTuple

import numpy as np
from kept import kernel, kernel_with_memory
from numpy.typing import NDArray
from product import FULL, HELD_MOST, IN_FLIGHT, LATE, LOSE, MEND, SKIP, Array, Rows
from ticks import options, settle, take

RUNNING, STARTING, ENDED = 1, 2, 4
BY_FAULT: Final = np.uint32(1 << 31)
"""Added to the state at the end of a transition that is a fault."""

# places of a cursor
NUMBER, OPTION, STATES, TRANSITIONS, FLIGHTS = range(5)


class Store(NamedTuple):
    """Each state in two words; what is in flight in it by number."""

    states: Array  # (n, 2)
    slots: NDArray[np.int32]  # hash table of states; -1 is free
    flights: Array  # (n, IN_FLIGHT)
    flight_slots: NDArray[np.int32]
    origin: NDArray[np.int32]  # state from which each was reached first ...
    option: NDArray[np.int32]  # ... and by what
    marks: NDArray[np.uint8]
    begins: Array  # (n + 1,) first transition of each
    tails: NDArray[np.uint32]  # where each leads to


@kernel
def _copy(words: Array, to: Array, count: int) -> None:
    for place in range(count):
        to[place] = words[place]


@kernel
def _mixed(words: Array, count: int) -> int:
    found = np.uint64(0)
    for place in range(count):
        found = (found ^ np.uint64(words[place])) * np.uint64(0x9E3779B97F4A7C15)
        found ^= found >> np.uint64(29)
    return np.int64(found >> np.uint64(2))


@kernel
def find(table: Array, slots: NDArray[np.int32], words: Array) -> int:
    """The slot where words stand, or are to stand, as many as a row of the table has."""
    mask, count = len(slots) - 1, table.shape[1]
    at = _mixed(words, count) & mask
    while slots[at] >= 0:
        row, is_same = slots[at], True
        for place in range(count):
            if table[row, place] != words[place]:
                is_same = False
                break
        if is_same:
            break
        at = at + 1 & mask
    return at


@kernel
def fill(table: Array, slots: NDArray[np.int32], count: int) -> None:
    """A larger hash table for the same words."""
    for row in range(count):
        slots[find(table, slots, table[row])] = row


@kernel
def _sort_held(w: np.void) -> None:
    """Their order says nothing."""
    held, left = w["held"], w["left"]
    for last in range(1, HELD_MOST):
        place = last
        while place > 0 and held[place] != 0 and _before(held, left, place):
            held[place], held[place - 1] = held[place - 1], held[place]
            left[place], left[place - 1] = left[place - 1], left[place]
            place -= 1


@kernel
def _before(held: NDArray[np.uint16], left: NDArray[np.uint8], place: int) -> bool:
    if held[place] != held[place - 1]:
        return bool(held[place] < held[place - 1])
    return bool(left[place] < left[place - 1])


@kernel
def add(w: np.void, words: Array, r: Rows, s: Store, cursor: Array, origin: int, option: int, count: int) -> int:
    """The number of this state, a new one if it is new; FULL if there is no room."""
    if cursor[STATES] == len(s.states) or cursor[FLIGHTS] == len(s.flights):
        return FULL
    _sort_held(w)
    at = find(s.flights, s.flight_slots, words)
    if s.flight_slots[at] < 0:
        _copy(words, s.flights[cursor[FLIGHTS]], IN_FLIGHT)
        s.flight_slots[at] = cursor[FLIGHTS]
        cursor[FLIGHTS] += 1
    key = s.states[cursor[STATES]]
    key[0] = np.int64(w["controller"]) | np.int64(w["node"]) << 22 | np.int64(s.flight_slots[at]) << 42
    key[1] = np.int64(w["age_us"]) | np.int64(w["phase"]) << 15 | np.int64(w["faults_left"]) << 19
    key[1] |= np.int64(w["skipped"]) << 22 | np.int64(w["since_decision"]) << 25 | np.int64(w["quiet"]) << 29
    key[1] |= np.int64(w["apart"]) << 31 | np.int64(w["believed"]) << 35 | np.int64(w["cut"]) << 42
    key[1] |= np.int64(w["landing"]) << 45 | np.int64(w["high"]) << 49 | np.int64(w["unsigned"]) << 53
    at = find(s.states, s.slots, key)
    if s.slots[at] >= 0:
        return int(s.slots[at])
    number = cursor[STATES]
    s.slots[at] = number
    s.origin[number], s.option[number] = origin, option
    controller = r.controllers[w["controller"]]
    mark = STARTING if controller["is_starting"] != 0 else 0
    if controller["mode"] == r.rules[0]["mode_enabled"]:
        mark |= RUNNING
    s.marks[number] = mark | (ENDED if count == 0 else 0)
    cursor[STATES] += 1
    return int(number)


@kernel
def put(w: np.void, words: Array, s: Store, number: int) -> None:
    """Make the world this state."""
    key = s.states[number]
    _copy(s.flights[key[0] >> 42], words, IN_FLIGHT)
    for place in range(IN_FLIGHT, len(words)):
        words[place] = 0
    w["controller"], w["node"] = key[0] & 0x3FFFFF, key[0] >> 22 & 0xFFFFF
    w["age_us"], w["phase"], w["faults_left"] = key[1] & 0x7FFF, key[1] >> 15 & 15, key[1] >> 19 & 7
    w["skipped"], w["since_decision"], w["quiet"] = key[1] >> 22 & 7, key[1] >> 25 & 15, key[1] >> 29 & 3
    w["apart"], w["believed"], w["cut"] = key[1] >> 31 & 15, key[1] >> 35 & 127, key[1] >> 42 & 7
    w["landing"], w["high"], w["unsigned"] = key[1] >> 45 & 15, key[1] >> 49 & 15, key[1] >> 53 & 31


@kernel
def is_fault(option: int) -> bool:
    kind = option >> 8
    return LATE <= kind <= LOSE or SKIP <= kind < MEND


@kernel
def expand(
    world: NDArray[np.void], words: Array, kept: Array, may: NDArray[np.int32], then: NDArray[np.int32],
    r: Rows, s: Store, cursor: Array,
) -> int:  # fmt: skip
    """Go on from where the cursor is. 0: every state has been left in every way. Else why not: MISSING, VIOLATED, FULL.

    ``world`` (1,) and its ``words``; ``kept`` as many words, ``may`` and ``then`` room for options.
    """
    w = world[0]
    while cursor[NUMBER] < cursor[STATES]:
        number = cursor[NUMBER]
        put(w, words, s, number)
        count = options(w, r, may)
        _copy(words, kept, len(words))
        s.begins[number + 1] = cursor[TRANSITIONS] + count - cursor[OPTION]
        if s.begins[number + 1] > len(s.tails):
            return FULL
        while cursor[OPTION] < count:
            option = may[cursor[OPTION]]
            _copy(kept, words, len(words))
            told = take(w, r, option)
            if told >= 0:
                told = settle(w, r, then)
            if told < 0:
                return int(told)
            tail = add(w, words, r, s, cursor, number, option, told)
            if tail < 0:
                return int(tail)
            s.tails[cursor[TRANSITIONS]] = np.uint32(tail) | (BY_FAULT if is_fault(option) else np.uint32(0))
            cursor[TRANSITIONS] += 1
            cursor[OPTION] += 1
        cursor[OPTION] = 0
        cursor[NUMBER] += 1
    return 0


# -- what is not true of a state but of all ways from it ---------------------------------------------------------


@kernel_with_memory
def first_without_a_way_back(s: Store, count: int) -> int:
    """A state from which nothing leads to a closed loop, or to the end, without another fault; -1: there is none."""
    begins = np.zeros(count + 2, np.int64)  # of the transitions turned round
    for tail in s.tails[: s.begins[count]]:
        if tail & BY_FAULT == 0:
            begins[tail + 2] += 1
    for number in range(count):
        begins[number + 2] += begins[number + 1]
    heads = np.empty(begins[count + 1], np.uint32)
    for number in range(count):
        for tail in s.tails[s.begins[number] : s.begins[number + 1]]:
            if tail & BY_FAULT == 0:
                heads[begins[tail + 1]] = number
                begins[tail + 1] += 1
    waiting, known, left = np.empty(count, np.int32), np.zeros(count, np.uint8), 0
    for number in range(count):
        if s.marks[number] & (RUNNING | ENDED):
            waiting[left], known[number] = number, 1
            left += 1
    done = 0
    while done < left:
        number = waiting[done]
        done += 1
        for head in heads[begins[number] : begins[number + 1]]:
            if known[head] == 0:
                waiting[left], known[head] = head, 1
                left += 1
    for number in range(count):
        if known[number] == 0:
            return number
    return -1


@kernel_with_memory
def first_start_without_end(s: Store, count: int) -> int:
    """A state on a circle of states that are all of the start-up, or behind one; -1: there is none."""
    into = np.zeros(count, np.int32)
    for number in range(count):
        if s.marks[number] & STARTING:
            for tail in s.tails[s.begins[number] : s.begins[number + 1]]:
                into[tail & ~BY_FAULT] += 1
    waiting, left, done = np.empty(count, np.int32), 0, 0
    for number in range(count):
        if s.marks[number] & STARTING and into[number] == 0:
            waiting[left] = number
            left += 1
    while done < left:
        number = waiting[done]
        done += 1
        for tail in s.tails[s.begins[number] : s.begins[number + 1]]:
            to = tail & ~BY_FAULT
            into[to] -= 1
            if into[to] == 0 and s.marks[to] & STARTING:
                waiting[left] = to
                left += 1
    for number in range(count):
        if s.marks[number] & STARTING and into[number] > 0:
            return number
    return -1

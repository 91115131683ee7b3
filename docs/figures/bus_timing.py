"""Writes docs/figures/bus_timing.png, one cycle on the simulated wire, and the generated tables of bus.md.

    python docs/figures/bus_timing.py

The figure shows a cycle that the wire really ran; its numbers and those of the tables, which the site takes from here,
come from ``hil.bus.frame_time``.
"""

from math import floor
from pathlib import Path
from typing import NamedTuple

from hil.bus.clock import Lockstep
from hil.bus.frame_time import INTERFRAME_BITS, frame_bit_counts, frame_duration_ns, frame_range_us
from hil.bus.wire import Wire
from hil.pictures.style import BLUE, FAINT, GREEN, TINY_PT, VERMILION, dress, save, sheet
from pkxyz_ctrl.can.frame import Frame

PICTURE = Path(__file__).with_suffix(".png")
NOMINAL, FAST = 1_000_000, 5_000_000
PERIOD_US, TURNAROUND_US, COMPUTE_US = 200, 2, 8  # configs/buses/fd_5k.toml
SYNC, SENSE, DRIVE = 0x080, 0x28A, 0x30A
FRAMES = (("SYNC", SYNC, 1), ("sense PDO", SENSE, 8), ("drive PDO", DRIVE, 8))
ACK_TO_END_US = 9e6 / NOMINAL


class Passage(NamedTuple):
    """One frame on the wire, in us from the start of the cycle."""

    label: str
    start_us: float
    fast_from_us: float
    fast_to_us: float
    end_us: float


def frame_table() -> str:
    """Shortest and longest duration of each process frame over all its data, interframe space included."""
    lines = [
        "| frame | identifier | bytes | FD 1/5 Mbit/s | classic 1 Mbit/s |",
        "| --- | --- | --- | --- | --- |",
    ]
    totals = [0.0] * 4
    for name, can_id, length in FRAMES:
        ranges = [
            *frame_range_us(can_id, length, NOMINAL, FAST, is_fd=True),
            *frame_range_us(can_id, length, NOMINAL),
        ]
        totals = [total + part for total, part in zip(totals, ranges, strict=True)]
        lines.append(
            "| {} | 0x{:03X} | {} | {:.1f}..{:.1f} us | {:.0f}..{:.0f} us |".format(name, can_id, length, *ranges)
        )
    lines.append("| together | | | {:.1f}..{:.1f} us | {:.0f}..{:.0f} us |".format(*totals))
    return "\n".join(lines)


def budget_table() -> str:
    """The FD cycle by its instants: all frames at their shortest, and all at their longest."""
    rows: list[list[float]] = []
    for which in (0, 1):
        sync, sense, drive = (frame_range_us(can_id, n, NOMINAL, FAST, is_fd=True)[which] for _, can_id, n in FRAMES)
        interframe = INTERFRAME_BITS * 1e6 / NOMINAL
        sampled = -(-(sync - interframe) // 1)  # what an endpoint sees happens at the next whole microsecond
        sense_seen = -(-(max(sync, sampled + TURNAROUND_US) + sense - interframe) // 1)
        drive_seen = -(-(sense_seen + COMPUTE_US + drive - interframe) // 1)
        latest = PERIOD_US - drive
        rows.append([sampled, sense_seen, sense_seen + COMPUTE_US, drive_seen, latest - sense_seen])
    names = (
        "SYNC received: combs driven, sense sampled",
        "sense PDO received",
        f"drive PDO queued, {COMPUTE_US} us later",
        "drive PDO received",
        "the tick may take, from sense PDO received to drive PDO queued",
    )
    lines = ["| instant after the start of SYNC | all frames shortest | all frames longest |", "| --- | --- | --- |"]
    for name, shortest, longest in zip(names, *rows, strict=True):
        lines.append(f"| {name} | {shortest:.4g} us | {longest:.4g} us |")
    return "\n".join(lines)


def one_cycle() -> tuple[list[Passage], float]:
    """Run a cycle and the next SYNC on a wire with controller and amplifier; bus load of the cycle, 0..1."""
    clock = Lockstep()
    wire = Wire(clock, NOMINAL, FAST)
    passages: list[Passage] = []
    names = {can_id: name for name, can_id, _ in FRAMES}

    def watch(frame: Frame, t_us: int) -> None:
        nominal, fast = frame_bit_counts(frame)
        duration_us = frame_duration_ns(frame, NOMINAL, FAST) / 1000
        fast_us = fast * 1e6 / FAST
        # t_us is rounded up; the frame started at a whole microsecond or as the one before left the wire
        latest_us = t_us + INTERFRAME_BITS * 1e6 / NOMINAL - duration_us
        free_us = passages[-1].end_us if passages else -1.0
        start_us = free_us if latest_us - 1 < free_us < latest_us + 1e-6 else float(floor(latest_us + 1e-6))
        end_us = start_us + duration_us
        fast_from_us = start_us + nominal * 1e6 / NOMINAL - ACK_TO_END_US - INTERFRAME_BITS * 1e6 / NOMINAL
        passages.append(Passage(names[frame.can_id], start_us, fast_from_us, fast_from_us + fast_us, end_us))

    def reply(frame: Frame, t_us: int) -> None:
        if frame.can_id == SYNC:
            sense = Frame(SENSE, bytes.fromhex("e803d0fe2c0117a5"), True, True)
            clock.call_at(t_us + TURNAROUND_US, lambda: amplifier.send(sense))

    def act(frame: Frame, t_us: int) -> None:
        drive = Frame(DRIVE, bytes.fromhex("1c527b4a904f1633"), True, True)
        clock.call_at(t_us + COMPUTE_US, lambda: controller.send(drive))

    controller, amplifier = wire.attach("controller", act), wire.attach("amplifier", reply)
    wire.attach("watch", watch, listen_only=True)
    for k in (1, 2):
        clock.call_at((k - 1) * PERIOD_US, lambda k=k: controller.send(Frame(SYNC, bytes([k]), True, True)))
    clock.run_until(PERIOD_US)
    load = wire.bus_load()
    clock.run_until(PERIOD_US + 45)
    return passages, load


def draw(passages: list[Passage], load: float) -> None:
    colours = {"SYNC": BLUE, "sense PDO": GREEN, "drive PDO": VERMILION}
    figure = sheet(9.0, 2.8)
    axes = figure.subplots()
    for p in passages:
        colour = colours[p.label]
        axes.broken_barh([(p.start_us, p.end_us - p.start_us)], (0, 1), color=colour, alpha=0.45, lw=0)
        axes.broken_barh([(p.fast_from_us, p.fast_to_us - p.fast_from_us)], (0, 1), color=colour, lw=0)
        axes.text((p.start_us + p.end_us) / 2, 1.08, p.label, ha="center", color=colour)
    sync, sense, drive = passages[:3]
    instants = (
        (sync.end_us - 3, "combs driven,\nsense sampled"),
        (sense.end_us - 3, "sense PDO\nreceived"),
        (drive.start_us, "drive PDO\nqueued"),
        (drive.end_us - 3, "drive PDO\nreceived"),
    )
    for k, (t_us, text) in enumerate(instants):
        axes.annotate(
            text,
            (t_us, 0),
            (t_us, -0.45 - 0.75 * (k % 2)),
            ha="left" if t_us == drive.start_us else "center",
            va="top",
            arrowprops={"arrowstyle": "->"},
            fontsize=TINY_PT,
        )
    axes.axvline(PERIOD_US, color=FAINT, ls=":", lw=1)
    axes.set(xlim=(-4, 243), ylim=(-2.1, 1.5), yticks=[])
    title = f"One cycle of fd_5k: light 1 Mbit/s, dark 5 Mbit/s; bus load {100 * load:.0f} %"
    dress(axes, "time after the start of SYNC (µs)", title=title, grid="")
    axes.spines["left"].set_visible(False)
    save(figure, PICTURE)


if __name__ == "__main__":
    draw(*one_cycle())

"""What the single parts of a tick on the bus cost, each alone."""

from functools import partial

import numpy as np

from hil.bench.rigs.closed_loop import scan
from hil.bench.rigs.figure import Figure, calls, once, times_of
from hil.bench.rigs.played import Played, PlayedPort, TimedPort, recorded_frames
from hil.bus.clock import Lockstep
from hil.bus.frame_time import frame_duration_ns
from hil.bus.wire import Wire
from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.driver import AmplifierDriver
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.safety.gate import TransmitGate
from pkxyz_ctrl.safety.modes import Mode

REPEATS = 9
TICKS = 2000


def codec() -> list[Figure]:
    """Counts to the bytes of a process PDO with counter and CRC, and back; and the length of that frame on the wire."""
    setup = scan().setup
    assert setup.bus.can is not None
    can = setup.bus.can
    drive = ProcessCodec(cob_id.DRIVE_BASE + can.driver.node_id, True)
    data = drive.encode((21_000, 20_500, 21_300), 17)
    rates = can.nominal_bitrate_bit_per_s, can.data_bitrate_bit_per_s or can.nominal_bitrate_bit_per_s
    names = {
        "encode": drive.encode, "decode": drive.decode, "counts": (21_000, 20_500, 21_300), "data": data,
        "duration": frame_duration_ns, "frame": Frame(drive.cob_id, data, True, True), "rates": rates,
    }  # fmt: skip
    statements = {"encode": "encode(counts, 17)", "decode": "decode(data)", "duration": "duration(frame, *rates)"}
    words = {"encode": "a drive PDO", "decode": "with its checks", "duration": "length of a frame, stuff bits included"}
    taken = calls(statements, names, 20_000, REPEATS)
    return [Figure(f"codec.{k}", t.per(1)[0], "us", None, None, t.per(1)[1], words[k]) for k, t in taken.items()]


def gate() -> list[Figure]:
    """The gate's two verdicts of a tick: SYNC and a drive PDO that changes every tick."""
    setup = scan().setup
    encode = ProcessCodec(cob_id.DRIVE_BASE + setup.gate.node_id, True).encode
    fd = setup.gate.fd
    sync = [Frame(cob_id.SYNC, bytes((k % 240 + 1,)), fd, fd) for k in range(TICKS)]
    drive_id = cob_id.DRIVE_BASE + setup.gate.node_id
    drive = [Frame(drive_id, encode((k, k + 1, k + 2) if k else (0, 0, 0), k % 256), fd, fd) for k in range(TICKS)]
    mode, period_us = int(Mode.TRACKING), setup.bus.period_us

    def run(judge: TransmitGate) -> None:
        check, t_us = judge.check, 0
        for s, d in zip(sync, drive, strict=True):
            check(s, mode, t_us)
            check(d, mode, t_us + 100)
            t_us += period_us

    seconds = []
    for _ in range(REPEATS):
        judge = TransmitGate(setup.gate)
        seconds.append(once(partial(run, judge)))
        if judge.latched:
            raise RuntimeError(f"the gate blocked what it should have let pass: {judge.latched}")
    best, median = times_of(seconds).per(TICKS)
    return [Figure("gate.tick", best, "us", None, None, median, "two frames judged, byte by byte")]


def driver() -> list[Figure]:
    """The driver's share of a tick: SYNC, sense PDO taken in, drive PDO made, heartbeat looked at."""
    setup = scan().setup
    came, _ = recorded_frames(setup)
    sense_id = cob_id.SENSE_BASE + setup.gate.node_id
    sense = [(frame, t_us) for frame, t_us in came if frame.can_id == sense_id][:TICKS]

    def run(amplifier: AmplifierDriver) -> None:
        sync, receive, take, drive = amplifier.sync, amplifier.receive, amplifier.sense.take, amplifier.drive
        heartbeat_due = amplifier.heartbeat_due
        for frame, t_us in sense:
            sync(t_us)
            receive(frame, t_us)
            take()
            drive((21_000, 20_500, 21_300), t_us)
            heartbeat_due(t_us)

    seconds = [once(partial(run, Played(setup, PlayedPort(came)).controller.driver)) for _ in range(REPEATS)]
    best, median = times_of(seconds).per(len(sense))
    return [Figure("driver.tick", best, "us", None, None, median, "SYNC, sense PDO in, drive PDO out")]


def controller() -> list[Figure]:
    """The controller's answer on the bus: from the sense frame in hand to the drive frame handed over.

    Driver, tick, modes and gate. The bus file charges a fixed time for it, which decides what else fits into a period.
    """
    setup = scan().setup
    assert setup.bus.can is not None
    came, _ = recorded_frames(setup)
    node_id = setup.gate.node_id
    runs = []
    for _ in range(REPEATS):
        port = TimedPort(came, cob_id.SENSE_BASE + node_id, cob_id.DRIVE_BASE + node_id)
        Played(setup, port).run()
        runs.append(np.array(port.taken_ns) * 1e-3)
    medians = [float(np.median(taken)) for taken in runs]
    p99 = min(float(np.quantile(taken, 0.99)) for taken in runs)
    return [
        Figure("controller.answer", min(medians), "us", float(setup.bus.can.compute_us), "at most",
               float(np.median(medians)),
               f"median of {len(runs[0])} ticks, p99 {p99:.1f} us; target: compute_us of the bus file"),
    ]  # fmt: skip


def wire() -> list[Figure]:
    """A frame of 8 bytes through the simulated bus, from queue to receiver: arbitration, duration, confirmation."""
    can = scan().setup.bus.can
    assert can is not None
    encode = ProcessCodec(0x30A, True).encode
    frames = [Frame(0x30A, encode((k, 2 * k, 3 * k), k % 256), True, True) for k in range(TICKS)]

    def run() -> None:
        clock = Lockstep()
        medium = Wire(clock, can.nominal_bitrate_bit_per_s, can.data_bitrate_bit_per_s)
        sender = medium.attach("sender")
        receiver = medium.attach("receiver", queue_limit=TICKS)
        for k, frame in enumerate(frames):
            sender.send(frame)
            clock.run_until(100 * (k + 1))
            receiver.receive_nowait()

    best, median = times_of([once(run) for _ in range(REPEATS)]).per(TICKS)
    return [Figure("wire.frame", best, "us", None, None, median, "sent, arbitrated, timed to the bit, received")]

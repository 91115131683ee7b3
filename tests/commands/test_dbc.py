"""``pkxyz dbc``: what cantools reads from a run's frame log by the DBC of its bus is what the recording says.

The recording is written by the controller, in counts and in SI; the log by whoever listens on the wire. cantools and
crccheck know nothing of either.
"""

from pathlib import Path

import can
import cantools
import numpy as np
import pytest
from command_line import ROOT, pkxyz
from crccheck.crc import Crc8Base

from hil.recording.recording import Recording
from pkxyz_ctrl.config.files import CONFIG_DIR

SHIPPED = ROOT / "configs" / "comb_amplifier.dbc"
OTHER_SCALES = (
    ("6.103701895199438e-3", "6.0e-3"),
    ("68.0e-18", "70.5e-18"),
    ("4.14e-12", "4.2e-12"),
    ("node_id = 10", "node_id = 44"),
)
PLAIN = (("protection = true", "protection = false"),)


class Crc8H2F(Crc8Base):
    _poly, _initvalue, _xor_output, _reflect_input, _reflect_output = 0x2F, 0xFF, 0xFF, False, False


def bus_file(folder, changes):
    text = (CONFIG_DIR / "buses" / "fd_5k.toml").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module", params=[(), OTHER_SCALES, PLAIN], ids=["shipped", "other scales", "plain CiA 401"])
def run(request, tmp_path_factory):
    """Database, frames of all ticks by message name, raw frames and recording of the default scenario."""
    folder = tmp_path_factory.mktemp("dbc")
    bus = bus_file(folder, request.param)
    assert pkxyz("sil", "raster", "--bus", bus, "--out", "run", cwd=folder).returncode == 0
    path = SHIPPED
    if request.param:
        path = folder / "mine.dbc"
        assert pkxyz("dbc", "--bus", bus, "--out", path, cwd=folder).returncode == 0
    recording = Recording.open(folder / "run" / "recording.parquet")
    return cantools.database.load_file(path), *ticks(folder / "run" / "frames.log", path, recording.ticks), recording


def ticks(log: Path, dbc: Path, count: int):
    """Of each tick, SYNC first: what every frame says by its message's name, in SI-like units and as raw counts."""
    database = cantools.database.load_file(dbc)
    found: list[dict] = []
    raw: list[dict] = []
    started = False
    for message in can.LogReader(log):
        described = database.get_message_by_frame_id(message.arbitration_id)  # KeyError: a frame that it doesn't know
        assert len(message.data) == described.length or described.name.startswith("EMCY"), described.name
        if described.name == "SYNC":
            started = True
            found.append({})
            raw.append({})
        if started:
            found[-1][described.name] = database.decode_message(message.arbitration_id, message.data)
            raw[-1][described.name] = message
    assert len(found) == count
    return found, raw


def column(ticks, message, signal):
    return np.array([tick[message][signal] for tick in ticks])


def test_capacitances_are_those_of_the_recording(run):
    """Before the homing each is the recorded one; afterwards it differs by what the homing took off, and no more."""
    _, found, _, recording = run
    homed = np.flatnonzero(recording["mode"] != recording["mode"][0])[0]
    for comb in (1, 2, 3):
        told_f = column(found, "TPDO2_sense", f"Sense_comb_{comb}") * 1e-15
        recorded_f = recording[f"sense_{comb}_f"]
        assert told_f[:homed] == pytest.approx(recorded_f[:homed], rel=1e-11)
        taken_off = told_f[homed + 1 :] - recorded_f[homed + 1 :]
        assert np.ptp(taken_off) < 1e-24
        assert abs(taken_off[0]) < 1e-15  # 8 nm of stroke: the noise of a homing


def test_drive_voltages_are_those_of_the_recording(run):
    """All but the last, which was still on the wire when the run ended."""
    _, found, _, recording = run
    driven = [tick for tick in found if "RPDO2_drive" in tick]
    assert len(driven) == recording.ticks - 1
    assert driven == found[:-1]
    for comb in (1, 2, 3):
        told_v = column(driven, "RPDO2_drive", f"Drive_comb_{comb}")
        assert told_v == pytest.approx(recording[f"voltage_{comb}_v"][:-1], rel=1e-11, abs=1e-11)
        assert told_v.max() > 50


def test_counts_counters_and_checksums(run):
    """Raw counts as recorded; SYNCs count 1..240, alive counters modulo 256; CRCs by crccheck."""
    database, found, raw, recording = run
    names = {"TPDO2_sense": "sense", "RPDO2_drive": "drive"}
    for message, prefix in names.items():
        described = database.get_message_by_name(message)
        frames = [tick[message] for tick in raw if message in tick]
        for comb in (1, 2, 3):
            counts = [described.decode(f.data, scaling=False)[f"{prefix.title()}_comb_{comb}"] for f in frames]
            assert counts == recording[f"{prefix}_{comb}_count"][: len(frames)].tolist()
        if f"{prefix.title()}_CRC_8" not in described.signal_tree:
            assert described.length == 6
            continue
        told = [tick[message] for tick in found if message in tick]
        alive = np.array([values[f"{prefix.title()}_alive_counter"] for values in told])
        assert (np.diff(alive) % 256 == 1).all()
        data_id = described.frame_id.to_bytes(2, "little")
        for frame, values in zip(frames, told, strict=True):
            assert values[f"{prefix.title()}_CRC_8"] == Crc8H2F.calc(data_id + frame.data[:7])
    syncs = column(found, "SYNC", "SYNC_counter")
    assert ((np.diff(syncs) - 1) % 240 == 0).all()
    assert (syncs.min(), syncs.max()) == (1, 240)


def test_heartbeats_say_operational(run):
    _, found, _, recording = run
    for who in ("Amplifier", "Controller"):
        beats = [str(t[f"Heartbeat_{who}"][f"{who}_state"]) for t in found if f"Heartbeat_{who}" in t]
        assert set(beats) == {"OPERATIONAL"}
        assert len(beats) == pytest.approx(recording.ticks * 200e-6 / 20e-3, abs=2)


def test_trigger_bits_and_the_signature(run):
    """Five bits by their names, in one byte; the signature of a protected node is one and the same, every 240 SYNCs."""
    database, found, _, recording = run
    outputs = database.get_message_by_name("RPDO1_outputs")
    assert outputs.length == 1
    for n, name in enumerate(("line", "pixel", "frame", "position", "in_position")):
        told = outputs.decode(bytes([1 << n]))
        assert [signal for signal, bit in told.items() if bit] == [f"Trigger_{name}"]
    if "TPDO3_signature" not in {message.name for message in database.messages}:
        assert database.get_message_by_name("RPDO2_drive").length == 6
        return
    signed = [n for n, tick in enumerate(found) if "TPDO3_signature" in tick]
    assert len(signed) == recording.ticks // 240
    assert {gap // 240 for gap in np.diff(signed)} <= {0, 1}
    assert len({found[n]["TPDO3_signature"]["Signature"] for n in signed}) == 1


def test_the_shipped_file_is_that_of_the_default_bus(tmp_path):
    assert pkxyz("dbc", cwd=tmp_path).stdout == SHIPPED.read_text(encoding="utf-8")


def test_what_it_refuses(tmp_path):
    none = pkxyz("dbc", "--bus", "local_20k", cwd=tmp_path)
    assert (none.returncode, none.stdout) == (2, "")
    assert none.stderr == "pkxyz: bus 'local_20k' has no [can] and carries no frames, so there is nothing to describe\n"
    (tmp_path / "mine.dbc").write_text('VERSION "of mine"\n')
    foreign = pkxyz("dbc", "--out", "mine.dbc", cwd=tmp_path)
    assert (foreign.returncode, foreign.stdout) == (2, "")
    assert "mine.dbc: was not written by `pkxyz dbc`" in foreign.stderr
    assert (tmp_path / "mine.dbc").read_text() == 'VERSION "of mine"\n'
    nowhere = pkxyz("dbc", "--out", "no/such/folder.dbc", cwd=tmp_path)
    assert (nowhere.returncode, nowhere.stderr) == (
        2, "pkxyz: --out: no/such/folder.dbc: no such file or directory; give another file\n"
    )  # fmt: skip
    for _ in range(2):  # its own file it replaces
        assert pkxyz("dbc", "--bus", "unix_1k", "--out", "ours.dbc", cwd=tmp_path).returncode == 0

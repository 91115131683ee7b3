"""The desk over the shared memory, with the real loop in lockstep at its other end: no process, no socket, no clock."""

import asyncio
import json
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from operated_rig import MIDDLE_M, OperatedRig, Script

from hil.operate.commands import Activity, Verb
from hil.operate.memory import StageMemory
from hil.operate.running.at_rate import OperatedLoop
from hil.operate.tick_frames import TickFrames
from hil.recording.recording import Recording
from hil.runs.run_folder import RECORDING
from hil.server.client import SAID_MOST, Client
from hil.server.desk import Desk
from hil.server.link import Link
from hil.server.paths import Planner
from hil.server.saving import AFTER_S
from pkxyz_ctrl.client import place
from pkxyz_ctrl.client.protocol import unpacked
from pkxyz_ctrl.safety.modes import Mode


class _NoFrames:
    frames = wire_ns = 0
    of_tick = TickFrames()


class DeskRig(OperatedRig):
    """``said`` is what each client was told, by kind."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
        memory = StageMemory(folder / "memory", kept_ticks=5000)
        self.session._say = memory.writer("answers").write
        place.write("stage", "loop", {"pid": 1, "memory": str(memory.path), "period_us": 200, "voltage_max_v": 200.0})
        monkeypatch.setattr(place, "_is_alive", lambda pid: True)
        self.loop = OperatedLoop(self.session, memory, _NoFrames(), lambda: 0)  # type: ignore[arg-type]

        async def plan(function: Any, *arguments: Any) -> Any:
            return function(*arguments)

        self.desk = Desk(Link("stage"), Planner("reconstructed", "youla", "fd_5k"), plan)
        self.every_tick.append(self.desk.look)
        self._server_tags = 0

    def after_tick(self, row: np.void) -> None:
        """By way of the memory, as at rate."""
        self.loop.after(0)

    def heard(self, client: Client) -> dict[str, list[Any]]:
        """All that waits for a client, by kind."""
        found: dict[str, list[Any]] = {"bytes": []}
        while not client.said.empty():
            said = asyncio.run(client.next_said())
            if isinstance(said, bytes):
                found["bytes"].append(said)
            else:
                for kind, value in json.loads(said).items():
                    found.setdefault(kind, []).append(value)
        return found

    def ask(self, client: Client, **message: Any) -> None:
        asyncio.run(self.desk.ask(client, json.dumps(message)))

    def finish(self, client: Client, **message: Any) -> Generator[None, None, dict[str, Any]]:
        """Ask, and wait for the last answer."""
        self._server_tags += 1
        tag = self._server_tags
        self.ask(client, tag=tag, **message)
        for _ in range(20_000):
            for answer in self.heard(client).get("answer", []):
                if answer["tag"] == tag and answer["state"] in ("done", "refused", "aborted"):
                    return answer
            yield
        raise AssertionError(f"no end of {message}")


@pytest.fixture
def rig(tmp_path, monkeypatch):
    return DeskRig(tmp_path, monkeypatch)


def switched_on(rig: DeskRig, client: Client) -> Script:
    rig.ask(client, do="take_control")
    for message in ({"do": "home"}, {"do": "enable"}, {"do": "move", "z_m": MIDDLE_M[2]}):
        answer = yield from rig.finish(client, **message)
        assert answer["state"] == "done", answer


def test_a_client_moves_the_stage_and_a_second_one_looks_on(rig):
    first, second = rig.desk.enter(), rig.desk.enter()

    def script() -> Script:
        yield from switched_on(rig, first)
        rig.heard(second)
        answer = yield from rig.finish(first, do="move", x_m=1e-6, y_m=-2e-6)
        assert answer["words"].startswith("in position at (1, -2, 18) um")
        others = rig.heard(second)
        assert [a["state"] for a in others["answer"]] == ["accepted", "running", "done"]
        assert {a["tag"] for a in others["answer"]} == {None}
        for message in ({"do": "move", "x_m": 0.0}, {"do": "home"}, {"do": "jog", "axis": "x"}, {"do": "path"}):
            answer = yield from rig.finish(second, **message)
            assert answer["words"] == "take control first: another client has it"
        answer = yield from rig.finish(second, do="take_control")
        assert "another client has control" in answer["words"]
        rig.desk.tell_status()
        status = rig.heard(second)["status"][-1]
        assert status["activity"] == "holding"
        assert np.allclose(status["position_m"], [1e-6, -2e-6, 18e-6], atol=10e-9)
        assert 0 < status["headroom_v"] < 200

    rig.play(script())


def test_anybody_may_stop(rig):
    holder, other = rig.desk.enter(), rig.desk.enter()

    def script() -> Script:
        yield from switched_on(rig, holder)
        rig.ask(holder, do="move", x_m=8e-6, velocity_m_per_s=50e-6, tag="m")
        yield from rig.wait_s(0.03)
        assert rig.session.state["activity"] == Activity.MOVING
        rig.ask(other, do="stop")
        yield from rig.wait_s(0.02)
        assert rig.session.state["activity"] == Activity.HOLDING
        assert [a["state"] for a in rig.heard(holder)["answer"] if a["tag"] == "m"][-1] == "aborted"

    rig.play(script())


def test_who_leaves_while_jogging_lets_go_of_the_key(rig):
    client = rig.desk.enter()

    def script() -> Script:
        yield from switched_on(rig, client)
        rig.ask(client, do="jog", axis="y", direction=1, velocity_m_per_s=10e-6)
        yield from rig.wait_s(0.05)
        assert rig.session.state["activity"] == Activity.JOGGING
        rig.desk.leave(client)
        assert rig.desk.holder is None
        yield from rig.wait_s(0.02)
        assert rig.session.state["activity"] == Activity.HOLDING
        following = rig.desk.enter()
        assert (yield from rig.finish(following, do="take_control"))["state"] == "done"

    rig.play(script())


def test_a_scan_from_a_form_is_previewed_followed_and_told_by_its_end(rig):
    client = rig.desk.enter()
    limits = {"velocity_max_m_per_s": 0.5e-3, "acceleration_max_m_per_s2": 0.5, "jerk_max_m_per_s3": 300.0}
    segments = [
        {"kind": "move", "to_m": MIDDLE_M, **limits},
        {"kind": "raster", "line_length_m": 2e-6, "lines": 5, "line_pitch_m": 0.2e-6, "layers": 1,
         "layer_pitch_m": 1e-6, "line_rate_hz": 60.0, **limits},
    ]  # fmt: skip

    def script() -> Script:
        yield from switched_on(rig, client)
        rig.ask(client, do="preview", segments=segments, tag=1)
        preview = rig.heard(client)["preview"][0]
        assert np.allclose(preview["start_m"], MIDDLE_M)
        assert 1.9e-6 < preview["high_m"][0] - preview["low_m"][0] < 2.5e-6
        answer = yield from rig.finish(client, do="path", segments=segments)
        assert answer["state"] == "done", answer
        for bad, words in (
            ({"scenario": "../secret"}, "name of a shipped scenario"),
            ({"scenario": "steps"}, "jumps on purpose"),
            ({"segments": [{"kind": "csv", "file": "/etc/passwd", **limits}]}, "sent by itself"),
            ({"segments": [segments[0] | {"to_m": (0, 0, 36.9e-6)}, segments[1]]}, "stroke"),
            ({"segments": "x"}, "reference"),
            ({"table": "t_s,x_um\n0,0\n"}, "at least two rows"),
        ):
            answer = yield from rig.finish(client, do="path", **{**limits_of(), **bad})
            assert answer["state"] == "refused"
            assert words in answer["words"], answer
            assert "/tmp" not in answer["words"]

    rig.play(script())


def limits_of() -> dict[str, float]:
    return {"velocity_m_per_s": 0.5e-3, "acceleration_m_per_s2": 0.5, "jerk_m_per_s3": 300.0}


def test_a_table_that_is_sent_is_followed(rig):
    client = rig.desk.enter()
    t = np.linspace(0, 0.05, 26)
    table = "t_s,x_um,y_um,z_um\n" + "".join(f"{s:.4f},{np.sin(40 * s) ** 2:.6f},{0.0},{18 + s:.6f}\n" for s in t)

    def script() -> Script:
        yield from switched_on(rig, client)
        answer = yield from rig.finish(client, do="path", table=table, **limits_of())
        assert answer["state"] == "done", answer

    rig.play(script())


def test_telemetry_comes_whole_to_the_fast_and_counted_to_the_slow(rig):
    fast, slow = rig.desk.enter(), rig.desk.enter()
    for client, precision in ((fast, "f8"), (slow, "f4")):
        rig.ask(client, do="subscribe", fields=["tick", "estimate_m", "voltage_v"], precision=precision)
    blocks = []

    def script() -> Script:
        for n in range(3000):
            yield
            if n % 100 == 0:
                rig.desk.show_telemetry(2000)
                blocks.extend(unpacked(b) for b in rig.heard(fast)["bytes"])

    rows = rig.play(script())
    ticks = np.concatenate([b["tick"] for b in blocks])
    assert (np.diff(ticks) == 1).all()
    assert len(ticks) > 2800
    at = int(ticks[500])
    assert np.array_equal(np.concatenate([b["estimate_m"] for b in blocks])[500], rows["estimate_m"][at])
    slow_blocks = rig.heard(slow)["bytes"]
    assert len(slow_blocks) == 4  # bounded, whatever it leaves undone
    assert slow.lost > 2000


def test_10_000_random_messages_move_nothing_and_nobody_without_control_can(rig):
    rng = np.random.default_rng(5)
    client = rig.desk.enter()
    words = [v.name.lower() for v in Verb] + ["subscribe", "preview", "x", "", "jog_again", "jog_end", "__class__"]
    values = [0, -1, 1e300, float("nan"), "x", None, True, [], {}, [[[]]], "raster", "../../etc/passwd", 10**400]
    keys = ["x_m", "axis", "direction", "window_m", "scenario", "segments", "fields", "relative", "tag", "precision"]

    def text() -> str:
        kind = rng.integers(4)
        if kind == 0:
            return bytes(rng.integers(32, 127, rng.integers(0, 60)).tolist()).decode()
        message: dict[str, Any] = {keys[rng.integers(len(keys))]: values[rng.integers(len(values))] for _ in range(3)}
        return json.dumps(message | ({"do": words[rng.integers(len(words))]} if kind > 1 else {}))

    def script() -> Script:
        yield from rig.switched_on_by_memory()
        driven = len(rig.rows)
        for n in range(10_000):
            said = text()
            if '"stop"' in said or '"release"' in said:
                continue
            asyncio.run(rig.desk.ask(client, said))
            rig.heard(client)
            if n % 100 == 0:
                yield
        yield from rig.wait_s(0.01)
        reference = np.array([row["reference_m"] for row in rig.rows[driven:]])
        assert (reference == MIDDLE_M).all()

    def by_memory() -> Script:
        other = rig.desk.enter()
        yield from switched_on(rig, other)
        rig.desk.leave(other)

    rig.switched_on_by_memory = by_memory
    rig.play(script())
    assert not client.is_hopeless


def test_a_client_that_reads_nothing_is_given_up(rig):
    client = rig.desk.enter()
    for tag in range(SAID_MOST + 5):
        rig.ask(client, do="move", tag=tag)
    assert client.is_hopeless
    assert client.said.qsize() <= SAID_MOST


def test_what_is_asked_while_the_loop_starts_is_answered(tmp_path, monkeypatch):
    """Before the loop reads its commands for the first time: a program that was quick waited for ever."""
    rig = DeskRig(tmp_path, monkeypatch)
    client = rig.desk.enter()
    rig.desk.link.join()
    rig.ask(client, do="take_control")
    rig.ask(client, do="move", tag="early", x_m=1e-6)
    memory = StageMemory(tmp_path / "memory")
    rig.loop = OperatedLoop(rig.session, memory, _NoFrames(), lambda: 0)  # type: ignore[arg-type]

    def script() -> Script:
        yield
        yield
        answers = [a for a in rig.heard(client)["answer"] if a["tag"] == "early"]
        assert [a["state"] for a in answers] == ["accepted", "refused"]

    rig.play(script())


def test_stops_do_not_use_up_the_room_for_commands(rig):
    """Two stops within a tick are one, and were counted as two commands of which one was never taken."""
    client = rig.desk.enter()

    def script() -> Script:
        yield from switched_on(rig, client)
        for _ in range(100):
            rig.ask(client, do="stop")
            rig.ask(client, do="stop")
            yield
        answer = yield from rig.finish(client, do="move", x_m=1e-6)
        assert answer["state"] == "done", answer

    rig.play(script())


def test_a_path_that_is_refused_takes_no_rows_from_the_one_that_is_followed(rig):
    """Of one that is longer than what is sent ahead."""
    client = rig.desk.enter()
    limits = {"velocity_max_m_per_s": 0.5e-3, "acceleration_max_m_per_s2": 0.5, "jerk_max_m_per_s3": 300.0}
    segments = [
        {"kind": "move", "to_m": MIDDLE_M, **limits},
        {"kind": "circle", "radius_m": 1e-6, "frequency_hz": 20.0, "turns": 24, "lead_s": 0.1},
    ]

    def script() -> Script:
        yield from switched_on(rig, client)
        rig.ask(client, do="path", tag="first", segments=segments)
        while rig.session.state["progress"][0] < 0.02:
            yield
        refused = yield from rig.finish(client, do="path", segments=segments)
        assert refused["state"] == "refused"
        assert "PATH" in refused["words"]
        rig.heard(client)
        while rig.session.state["activity"] in (Activity.MOVING, Activity.SCANNING):
            yield
        assert rig.session.state["activity"] == Activity.HOLDING
        yield from rig.wait_s(0.05)
        answers = [a for a in rig.heard(client)["answer"] if a["tag"] == "first"]
        assert [a["state"] for a in answers] == ["done"], answers

    rig.play(script())


def test_a_client_that_takes_nothing_ends_nobody_elses_telemetry(rig):
    stalled, other = rig.desk.enter(), rig.desk.enter()

    def script() -> Script:
        yield from rig.wait_s(0.01)
        for tag in range(SAID_MOST + 5):
            rig.ask(stalled, do="move", tag=tag)
        for client in (stalled, other):
            rig.ask(client, do="subscribe", fields=["tick"])
        yield from rig.wait_s(0.01)
        rig.desk.show_telemetry(2000)
        assert len(rig.heard(other)["bytes"]) == 1
        assert stalled.lost > 40

    rig.play(script())


def test_what_was_around_a_fault_is_kept_by_itself(rig, tmp_path):
    client = rig.desk.enter()
    rig.desk._saves = tmp_path / "runs"

    def script() -> Script:
        yield from switched_on(rig, client)
        yield from rig.wait_s(0.4)
        yield from rig.finish(client, do="release")
        yield from rig.wait_s(AFTER_S / 2)
        asyncio.run(rig.desk.keep_fault())
        assert not list(tmp_path.glob("runs/*"))  # not over yet
        while not rig.desk.saved:
            yield
            asyncio.run(rig.desk.keep_fault())

    rows = rig.play(script())
    (folder,) = tmp_path.glob("runs/fault-*")
    told = rig.heard(client)
    assert told["event"][-1] == {"kind": "saved", "words": str(folder)}
    kept = Recording.open(folder / RECORDING)
    assert kept.whole
    at = int(np.flatnonzero(rows["trips"])[0])
    expected = rows[rows["tick"] >= kept["tick"][0]][: kept.ticks]
    assert (kept["tick"] == expected["tick"]).all()
    assert (kept.vector("estimate_m") == expected["estimate_m"]).all()
    assert kept["mode"][-1] == Mode.FAULT
    after_s = (kept["t_us"][-1] - rows["t_us"][at]) * 1e-6
    assert AFTER_S - 1e-3 < after_s < AFTER_S + 0.01
    assert rows["t_us"][at] - kept["t_us"][0] == pytest.approx(min(2e6, rows["t_us"][at]), abs=1000)

"""``pkxyz ask``: every word that can be asked, and what of it the server is sent."""

import asyncio
import json
import sys
from types import SimpleNamespace
from typing import Any

import pytest

import pkxyz_ctrl
from hil import cli
from hil.commands.operation.ask import _FREE, _OTHERS, _PLAIN
from pkxyz_ctrl.client.plain import Stage
from pkxyz_ctrl.client.reply import Command
from pkxyz_ctrl.client.stage import AsyncStage


class Heard(AsyncStage):
    """The real client up to its socket: keeps what would be sent, and does all of it at once."""

    def __init__(self, end: str = "done") -> None:
        super().__init__("http://127.0.0.1:9", "", control=False)
        self.sent: list[dict[str, Any]] = []
        self.end = end

    async def __aenter__(self) -> "Heard":
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    async def _done(self, verb: str, wait: bool = True, **arguments: Any) -> Command:
        given = {key: value for key, value in arguments.items() if value is not None and key != "who"}
        self.sent.append({"do": verb, **given})
        return Command(7, verb, self.end, f"{verb} was said").require_done()


@pytest.fixture
def asked(capsys, monkeypatch):
    """Ask as at the command line: exit code, what was printed, what was sent, and how it connected."""

    def ask(*words: str, end: str = "done") -> SimpleNamespace:
        stage, connected = Heard(end), []

        def connect(url, *, name, control):
            connected.append((url, name, control))
            return Stage(stage)

        monkeypatch.setattr(pkxyz_ctrl, "connect", connect)
        monkeypatch.setattr(sys, "argv", ["pkxyz", "ask", *words])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        shown = capsys.readouterr()
        return SimpleNamespace(
            code=ended.value.code, out=shown.out, err=shown.err, sent=stage.sent, connected=connected
        )

    return ask


@pytest.mark.parametrize("word", _PLAIN)
def test_a_plain_word_is_sent_as_it_is(asked, word):
    done = asked(word)
    verb = word.replace("-", "_")
    expected = {"do": verb} | ({"seconds": 60.0} if word == "save" else {})
    assert (done.code, done.sent, done.out) == (0, [expected], f"{verb} was said\n")
    assert done.connected == [(None, "stage", word not in _FREE)]  # what stops or looks needs no control


LIMITS = {"velocity_m_per_s": 1e-3, "acceleration_m_per_s2": 0.5, "jerk_m_per_s3": 300.0}
SENT = [
    (["move", "x=1e-6", "z=18e-6"], {"do": "move", "x_m": 1e-6, "z_m": 18e-6, "relative": False}),
    (["move", "--by", "y=2e-9"], {"do": "move", "y_m": 2e-9, "relative": True}),
    (["path", "raster"], {"do": "path", "scenario": "raster"}),
    (["path", '[{"kind": "hold", "duration_s": 1}]'], {"do": "path", "segments": [{"kind": "hold", "duration_s": 1}]}),
    (["sample", "rotation_deg=30", "origin_m=0,0,19e-6", "scale=1,1,2"],
     {"do": "sample", "rotation_deg": 30.0, "origin_m": (0.0, 0.0, 19e-6), "scale": (1.0, 1.0, 2.0)}),
    (["tilt", "0,0,1e-6", "1e-6,0,0", "0,1e-6,0"],
     {"do": "tilt_plane", "points_m": [[0.0, 0.0, 1e-6], [1e-6, 0.0, 0.0], [0.0, 1e-6, 0.0]]}),
    (["name", "corner"], {"do": "name_position", "name": "corner"}),
    (["forget", "corner"], {"do": "forget_position", "name": "corner"}),
    (["go", "corner"], {"do": "move", "to": "corner"}),
    (["restore", "12ab"], {"do": "restore", "digest": "12ab"}),
    (["law", "lqg"], {"do": "law", "controller": "lqg"}),
    (["quiet", "on"], {"do": "quiet", "on": True}),
    (["quiet", "off"], {"do": "quiet", "on": False}),
    (["settle", "window_m=25e-9", "dwell_s=0.002"], {"do": "settle", "window_m": 25e-9, "dwell_s": 0.002}),
    (["settle", "window_m=25e-9", "dwell_s=0.002", "sigmas=2"],
     {"do": "settle", "window_m": 25e-9, "dwell_s": 0.002, "sigmas": 2.0}),
    (["limits", *(f"{key}={value}" for key, value in LIMITS.items())], {"do": "limits", **LIMITS}),
]  # fmt: skip


@pytest.mark.parametrize(("words", "sent"), SENT, ids=lambda v: " ".join(v) if isinstance(v, list) else "")
def test_a_word_with_arguments_is_sent_with_them(asked, words, sent):
    done = asked(*words)
    assert (done.code, done.sent) == (0, [sent]), done.err
    assert done.connected[0][2]


def test_no_word_is_left_out_here():
    looks = {"status", "settings", "preview", "jog"}
    assert {words[0] for words, _ in SENT} | looks == set(_OTHERS)


class Line:
    """Of ``Connection`` what a preview and a jog use; keeps what is said."""

    def __init__(self) -> None:
        self.said: list[dict[str, Any]] = []

    async def preview(self, path: dict[str, Any]) -> dict[str, Any]:
        self.said.append(path)
        corners = {"low_m": [-2e-6, -1e-6, 18e-6], "high_m": [2e-6, 1e-6, 20e-6]}
        return {"name": "raster", "duration_s": 1.07, "points_m": [[0.0, 0.0, 18e-6]] * 2, **corners}

    def asked(self) -> tuple[int, asyncio.Queue[Command]]:
        return 3, asyncio.Queue()

    async def say(self, message: dict[str, Any]) -> None:
        self.said.append(message)

    async def until(self, queue: object, states: object) -> Command:
        return Command(7, "jog", "done", "stands")


@pytest.fixture
def line(monkeypatch):
    found = Line()
    init = Heard.__init__

    def with_line(self: Heard, end: str = "done") -> None:
        init(self, end)
        self._connection = found  # type: ignore[assignment]

    monkeypatch.setattr(Heard, "__init__", with_line)
    return found


def test_a_preview_tells_time_and_reach_and_needs_no_control(asked, line):
    done = asked("preview", "raster")
    assert done.out == "raster: 1.07 s, from (-2, -1, 18) to (2, 1, 20) um; the combs can follow\n"
    assert not done.connected[0][2]
    told = json.loads(asked("preview", "[]", "--json").out)
    assert (told["duration_s"], told["high_m"]) == (1.07, [2e-6, 1e-6, 20e-6])
    assert line.said == [{"scenario": "raster"}, {"segments": []}]


def test_a_jog_is_said_again_for_as_long_as_it_lasts(asked, line):
    done = asked("jog", "y=-1e-5", "seconds=0.12")
    assert done.out == "stands\n"
    first, *again, last = line.said
    assert first == {"do": "jog", "tag": 3, "axis": "y", "direction": -1.0, "velocity_m_per_s": 1e-5}
    assert {m["do"] for m in again} == {"jog_again"}
    assert len(again) >= 2  # at 10 Hz or more
    assert last == {"do": "jog_end"}


def test_a_file_is_sent_by_what_it_is(asked, tmp_path):
    table, segments, law = tmp_path / "t.csv", tmp_path / "s.json", tmp_path / "mine.toml"
    table.write_text("t_s,x_um\n0,0\n1,1\n")
    segments.write_text('[{"kind": "hold", "duration_s": 1}]')
    law.write_text("name = 'mine'")
    (sent,) = asked("path", str(table)).sent
    assert (sent["do"], sent["table"]) == ("path", table.read_text())
    assert asked("path", str(segments)).sent == [{"do": "path", "segments": [{"kind": "hold", "duration_s": 1}]}]
    assert asked("law", str(law)).sent == [{"do": "law", "controller": "mine", "toml": "name = 'mine'"}]


WRONG = [
    ("jump", "'jump' can't be asked"), ("move", "where to?"), ("move x", "a number is wanted"),
    ("move q=1", "the axes are x, y and z"), ("move x=nan", "a number is wanted"), ("move x=1,2", "a number is wanted"),
    ("jog", "give one of x, y, z"), ("jog x=1e-5", "and seconds"), ("jog q=1 seconds=1", "give one of x, y, z"),
    ("path [1", "are no JSON"), ("path", "give one"), ("path a b", "give one"),
    ("path none.csv", "none.csv"), ("path none.json", "none.json"),
    ("sample", "give key=value"), ("sample window_m=1", "rotation_deg, slope_x"),
    ("sample origin_m=1", "three numbers"),
    ("sample rotation_deg=x", "a number is wanted"), ("tilt 0,0,0", "three points"), ("tilt 0,0 1,0,0 0,1,0", "three"),
    ("settle window_m=1e-9", "give dwell_s, too"), ("settle sigmas=2", "window_m and dwell_s"),
    ("settle rotation_deg=1", "window_m, dwell_s, sigmas"), ("limits velocity_m_per_s=1", "acceleration_m_per_s2 and"),
    ("name", "give one argument"), ("go a b", "give one argument"), ("quiet maybe", "neither on nor off"),
    ("law none.toml", "none.toml"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "said"), WRONG)
def test_what_means_nothing_is_one_line_and_sends_nothing(asked, monkeypatch, tmp_path, words, said):
    monkeypatch.chdir(tmp_path)
    done = asked(*words.split())
    assert (done.code, done.sent, done.out) == (2, [], "")
    assert done.err.count("\n") == 1
    assert said in done.err


@pytest.mark.parametrize("end", ["refused", "aborted"])
def test_what_the_stage_refuses_is_said_with_exit_code_1(asked, end):
    done = asked("home", end=end)
    assert (done.code, done.out, done.err) == (1, "", "pkxyz: home was said\n")


def test_as_json_an_answer_is_its_number_verb_state_and_words(asked):
    told = json.loads(asked("park", "--json").out)
    assert told == {"id": 7, "verb": "park", "state": "done", "words": "park was said"}
    assert asked("park", "--name", "other", "--url", "http://127.0.0.1:1").connected == [
        ("http://127.0.0.1:1", "other", True)
    ]

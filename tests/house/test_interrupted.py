"""Ctrl-C at any time from our first line on: one word, exit code 130. (Python's own start comes before that.)"""

import os
import signal
import subprocess
import sys
import time

import pytest
from command_line import ROOT

pytestmark = pytest.mark.at_rate

_BEGIN = """
import signal
import hil.__main__ as way_in

own = signal.signal


def tell(*words):  # our first line has run: from here on Ctrl-C has an owner
    signal.signal = own
    own(*words)
    print("begun", flush=True)


signal.signal = tell
way_in.main()
"""


@pytest.mark.parametrize(
    ("words", "after_s"),
    [
        *((("sil", "raster"), after_s) for after_s in (0.0, 0.01, 0.03, 0.08, 0.15, 0.25, 0.4, 0.6, 0.9)),
        *((("replay", "nowhere"), after_s) for after_s in (0.05, 0.3)),
        *((("margins", "--perturbed"), after_s) for after_s in (0.2, 0.5)),
    ],
)
def test_ctrl_c_while_it_starts_is_one_word(tmp_path, words, after_s):
    """A command that is over by then, in its own words, is well, too; and a run that had begun keeps what it has.

    Python drops an interrupt that meets it in a finaliser or a callback of C: whoever presses once more is heard.
    """
    code, stdout, stderr = _interrupted(tmp_path, words, after_s)
    if code == 0 and (stderr == "" or "Exception ignored in" in stderr):
        code, stdout, stderr = _interrupted(tmp_path, words, after_s)
    if words[0] == "replay" and code == 2:
        assert stderr.count("\n") == 1
        return
    assert code == 130, stderr
    own = [] if "interrupted: what was recorded until then is kept" in stdout else ["interrupted"]
    assert [line for line in stderr.splitlines() if not line.startswith("First run here")] == own


def _interrupted(folder, words, after_s):
    with subprocess.Popen(
        [sys.executable, "-c", _BEGIN, *words], cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        assert process.stdout.readline() == "begun\n"
        time.sleep(after_s)
        process.send_signal(signal.SIGINT)
        stderr, stdout = process.stderr.read(), process.stdout.read()
        return process.wait(timeout=60), stdout, stderr


def test_the_way_in_loads_nothing_that_takes_time():
    """What is loaded before the first line of ours is Python's own, so that Ctrl-C has an owner at once."""
    told = subprocess.run(
        [sys.executable, "-c", "import sys, hil.__main__; print(sorted({m.partition('.')[0] for m in sys.modules}))"],
        capture_output=True, text=True, check=True, cwd=ROOT,
    )  # fmt: skip
    assert not {"numpy", "pydantic", "typer", "rich", "pkxyz_ctrl", "json", "hashlib"} & set(eval(told.stdout))


def test_the_command_that_is_installed_takes_this_way():
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["scripts"] == {"pkxyz": "hil.__main__:main"}

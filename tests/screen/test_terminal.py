"""What is printed are words: brackets of file names, faults and plants are neither colours nor swallowed."""

import io
import sys

import numpy as np
import pytest
from rich.console import Console

from hil import cli
from hil.commands.studies import compare, faults, montecarlo
from hil.screen import terminal
from hil.screen.lazy_commands import LazyCommands
from hil.screen.progress import progress_bar
from hil.screen.terminal import bad, faint, plain_table, print_whole, say
from hil.studies.compare import Compared
from hil.studies.faults.matrix import CASES
from hil.studies.faults.outcome import Outcome

TRAPS = ("[red]", "[/]", "[sense.2]", "[bold]x[/bold]", ":smile:", "[0, 1]", "\\[dim]")


@pytest.mark.parametrize("trap", TRAPS)
def test_words_stay_as_they_are(capsys, trap):
    say(f"fault {trap} text")
    say(bad(trap), f": {trap}")
    table = plain_table(f"head {trap}", "n", title=f"of {trap}")
    table.add_row(f"cell {trap}", faint(trap))
    terminal.screen().print(table)
    print_whole(table)
    shown = capsys.readouterr().out
    for text in (f"fault {trap} text\n", f"{trap}: {trap}\n", f"head {trap}", f"cell {trap}", f"of {trap}"):
        assert text in shown


@pytest.mark.parametrize("trap", TRAPS)
def test_a_bar_says_what_is_being_done_as_it_is(monkeypatch, trap):
    console = Console(file=io.StringIO(), force_terminal=True, markup=False, emoji=False, width=100)
    monkeypatch.setattr("hil.screen.progress.notes", lambda: console)
    with progress_bar(f"runs/{trap}", quiet=False, still=True) as tell:
        tell(1, 4)
    assert f"runs/{trap}" in console.file.getvalue()
    assert "25 %" in console.file.getvalue()


def test_without_a_terminal_or_when_quiet_there_is_no_bar(capsys):
    for quiet in (False, True):
        with progress_bar("work", quiet=quiet) as tell:
            tell(1, 2)
    assert capsys.readouterr() == ("", "")


def test_a_narrow_terminal_cuts_no_number(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "12")
    table = plain_table("law", "Ms")
    table.add_row("lqg", "1.6234567890123456789")
    print_whole(table)
    assert "lqg  1.6234567890123456789" in capsys.readouterr().out


@pytest.mark.parametrize("trap", TRAPS)
def test_compare_tells_a_law_and_its_problem_as_they_are(capsys, trap):
    run = Compared(f"{trap}.toml", "lqg", {}, 0, f"COMB_FORCE_2 {trap} at tick 3", np.zeros(0), np.zeros((0, 3)))
    compare._show([run], f"on {trap}", None)
    shown = capsys.readouterr().out
    assert f"{trap}.toml: COMB_FORCE_2 {trap} at tick 3" in shown
    assert f"on {trap}" in shown


@pytest.mark.parametrize("trap", TRAPS)
def test_montecarlo_tells_how_to_run_the_worst_plant_as_it_is(capsys, trap):
    data = {
        "controller": trap, "scenario": "raster", "plants": 3, "tolerances": trap, "not_held": 1, "rms_error_nm": None,
        "hold_noise_nm": None, "peak_s": None,
    }  # fmt: skip
    montecarlo._show(data, f"pkxyz montecarlo --out {trap}")
    shown = capsys.readouterr().out
    assert f"the worst one alone: pkxyz montecarlo --out {trap}\n" in shown
    assert shown.startswith(f"{trap}, raster, 3 plants")


@pytest.mark.parametrize("trap", TRAPS)
def test_faults_tells_what_broke_as_it_is(capsys, monkeypatch, trap):
    monkeypatch.setenv("COLUMNS", "200")
    outcome = Outcome(
        "lqg", trap, (trap,), 3, 100.0, 1.0, 0.0, 0.2, 0.1, (), None, (f"a bound {trap} was not kept",)
    )  # fmt: skip
    faults._show([outcome], [CASES[0]], ["lqg"])
    shown = " ".join(capsys.readouterr().out.split())
    assert f"{trap} 3 {trap}" in shown


def test_sil_tells_its_folder_as_it_is(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pkxyz", "sil", "steps", "--lane", "fast", "--out", "[bold]mine[/]"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 0
    assert capsys.readouterr().out.endswith("picture are in [bold]mine[/]/\n")


def test_the_list_of_commands_loads_none_of_them(capsys, monkeypatch):
    loaded = []
    monkeypatch.setattr(LazyCommands, "__getitem__", lambda self, name: loaded.append(name))
    monkeypatch.setattr(sys, "argv", ["pkxyz", "--help"])
    with pytest.raises(SystemExit):
        cli.main()
    shown = capsys.readouterr().out
    assert loaded == []
    assert all(f"  {name} " in shown and words in shown for name, (_, words) in cli.COMMANDS.items())


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_each_command_is_where_the_table_says(name, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["pkxyz", name, "--help"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith(f"Usage: pkxyz {name} ")


def test_a_command_that_there_is_not_is_refused_with_the_nearest(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["pkxyz", "montecarl"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert "montecarlo" in capsys.readouterr().err

"""Who imports whom, read from the sources: arrows run one way, nothing runs in a circle, and what is pure has no clock.

The table of rooms is in ``rooms.py``.
"""

import ast
import subprocess
import sys

import pytest
from rooms import HOUSE, LIBRARIES, PACKAGES, ROOT, House, Room, circles, is_in_any, may_use, page_table

AS_IT_IS = House.of(ROOT)
MODULES = sorted(AS_IT_IS.sources)
WRONG = AS_IT_IS.wrong_arrows(HOUSE)
PURE = ("pkxyz_ctrl.core", "pkxyz_ctrl.safety", "pkxyz_ctrl.loop.cycle", "pkxyz_ctrl.loop.row", "sim.kernels")
SANS_IO = (*PURE, "pkxyz_ctrl.can", "pkxyz_ctrl.loop.controller", "pkxyz_ctrl.loop.runtime", "sim")
CLOCKS_AND_DICE = ("time", "datetime", "random", "secrets", "logging", "os", "socket", "threading", "asyncio", "uuid")
NAMES_FOR_NOTHING = ("utils", "util", "helpers", "common", "misc", "base")
SMALL = {"low": "", "low.a": "", "low.b": "", "high": "", "high.c": "from low.a import x\n"}
"""A house of two rooms, for tests of the tests: ``high`` may use ``low``."""
SMALL_TABLE = {"low": Room(), "high": Room(("low",))}


def small_house(**changed: str) -> House:
    """The small house with other sources; ``low_a`` for ``low.a``."""
    return House(SMALL | {name.replace("_", "."): source for name, source in changed.items()}, ("low", "high"))


# -- the table -------------------------------------------------------------------------------------------------------


def test_every_room_is_in_the_table_and_uses_only_rooms_above_it():
    assert set(HOUSE) == set(AS_IT_IS.rooms)
    above: list[str] = []
    for name, room in HOUSE.items():
        for other in room.uses:
            known = [seen for seen in above if other in (seen, "pkxyz_ctrl.*")]
            assert known, f"{name} uses {other}, which stands below it"
        above.append(name)


@pytest.mark.parametrize("module", MODULES)
def test_arrows_run_one_way(module):
    assert [line for line in WRONG if line.startswith(f"{module} imports ")] == []


def test_no_arrow_of_the_table_is_left_over():
    """Else the table would say what is no longer so."""
    used = AS_IT_IS.rooms
    left = [(name, other) for name, room in HOUSE.items() for other in room.uses if other not in used[name]]
    assert [pair for pair in left if pair[1] != "pkxyz_ctrl.*"] == []


def test_no_circle_among_files_and_none_among_rooms():
    assert circles(AS_IT_IS.ours) == []
    assert circles(AS_IT_IS.rooms) == []


def test_the_site_shows_every_room_with_what_it_holds():
    rows = page_table(AS_IT_IS.sources).splitlines()[2:]
    assert [row.split(" | ")[0] for row in rows] == [f"| `{name}`" for name in HOUSE]
    assert all(len(row.split(" | ")[1]) > 10 for row in rows)


# -- would it be found? ----------------------------------------------------------------------------------------------


def test_the_small_house_is_in_order():
    house = small_house()
    assert house.wrong_arrows(SMALL_TABLE) == []
    assert house.rooms == {"low": frozenset(), "high": frozenset({"low"})}
    assert circles(house.ours) == circles(house.rooms) == []


@pytest.mark.parametrize(
    "source",
    [
        "import high.c\n",
        "from high import c\n",
        "from high.c import anything\n",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from high.c import Anything\n",
        "def late():\n    from high.c import anything\n",
        "class Late:\n    async def load(self):\n        import high.c as other\n",
        "import importlib\nmodule = importlib.import_module('high.c')\n",
        "PLACES = {'name': ('high.c:function', 'words')}\n",
        "try:\n    from high.c import anything\nexcept ImportError:\n    pass\n",
    ],
)
def test_a_planted_arrow_upwards_is_found_however_it_is_written(source):
    house = small_house(low_b=source)
    assert house.wrong_arrows(SMALL_TABLE) == ["low.b imports high.c: low may not use high"]
    assert circles(house.rooms) == ["high -> low -> high"]


@pytest.mark.parametrize(
    ("source", "other"),
    [
        ("if TYPE_CHECKING:\n    from low.b import Thing\n", "from low.a import Other\n"),
        ("def late():\n    from low.b import thing\n", "from low.a import other\n"),
        ("from . import b\n", "from .a import other\n"),
        ("def late():\n    import low.b\n", "if TYPE_CHECKING:\n    import low.a\n"),
    ],
)
def test_a_planted_circle_among_files_is_found_however_it_is_hidden(source, other):
    house = small_house(low_a=source, low_b=other)
    assert circles(house.ours) == ["low.a -> low.b -> low.a"]
    assert house.wrong_arrows(SMALL_TABLE) == []  # within a room the table has nothing to say


def test_a_circle_over_three_is_found_and_told_once():
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set(), "e": {"a"}}
    assert circles(graph) == ["a -> b -> c -> a"]


def test_a_room_that_nobody_entered_in_the_table_may_use_nothing():
    house = House(SMALL | {"attic": "", "attic.d": "import low.a\n"}, ("low", "high", "attic"))
    assert house.wrong_arrows(SMALL_TABLE) == ["attic.d imports low.a: attic may not use low"]


@pytest.mark.parametrize(
    ("room", "other"),
    [
        ("pkxyz_ctrl.core", "pkxyz_ctrl.safety"),
        ("pkxyz_ctrl.safety", "pkxyz_ctrl.core"),
        ("pkxyz_ctrl.io", "pkxyz_ctrl.loop"),
        ("pkxyz_ctrl", "hil"),
        ("pkxyz_ctrl.loop", "sim"),
        ("sim", "pkxyz_ctrl.core"),
        ("sim", "hil.plant"),
        ("hil.bus", "hil.lanes"),
        ("hil.lanes", "hil.runs"),
        ("hil.runs", "hil.pictures"),
        ("hil.studies", "hil.commands"),
    ],
)
def test_what_the_design_forbids_the_table_does_not_allow(room, other):
    """The arrows that matter most, said once more by hand."""
    assert not may_use(HOUSE, room, other)


# -- what is pure ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("module", MODULES)
def test_libraries_stay_in_their_rooms(module):
    foreign = {name for name in AS_IT_IS.imports[module] if not is_in_any(name, PACKAGES)}
    room = HOUSE[AS_IT_IS.room_of(module)]
    allowed = LIBRARIES.get(module, room.libraries)
    if allowed is not None:
        assert {name for name in foreign if not is_in_any(name, allowed)} == set()
    if not is_in_any(module, ("pkxyz_ctrl.io", "hil")):
        assert not {name for name in foreign if is_in_any(name, ("can",))}, f"{module} imports python-can"


@pytest.mark.parametrize("module", [m for m in MODULES if is_in_any(m, SANS_IO)])
def test_no_clock_no_dice_no_log_where_time_is_handed_in(module):
    assert not {m for m in AS_IT_IS.imports[module] if is_in_any(m, CLOCKS_AND_DICE)}
    for node in ast.walk(ast.parse(AS_IT_IS.sources[module])):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("np.random", "numpy.random"):
            assert node.attr in ("SFC64", "SeedSequence"), f"line {node.lineno}"  # both only spread a seed handed in
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and is_in_any(module, PURE):
            assert node.func.id not in ("open", "print", "input", "eval", "exec"), f"line {node.lineno}"


def test_the_core_knows_of_configuration_the_stage_alone():
    ours = {name for module in MODULES if is_in_any(module, ("pkxyz_ctrl.core",)) for name in AS_IT_IS.ours[module]}
    outside = {name for name in ours if not is_in_any(name, ("pkxyz_ctrl.core",))}
    assert outside == {"pkxyz_ctrl.config.stage", "pkxyz_ctrl.compiled.kernel"}


def test_the_cycle_knows_core_and_safety_and_nothing_of_frames():
    ours = AS_IT_IS.ours["pkxyz_ctrl.loop.cycle"]
    assert ours
    assert {name for name in ours if not is_in_any(name, ("pkxyz_ctrl.core", "pkxyz_ctrl.safety"))} <= {
        "pkxyz_ctrl.compiled.kernel",
        "pkxyz_ctrl.loop.row",
        "pkxyz_ctrl.loop.set_points",
        "pkxyz_ctrl.loop.landing",
    }


def test_what_runs_on_the_target_loads_no_harness_and_no_python_can():
    """The loop with all that it needs, imported in a fresh interpreter."""
    code = (
        "import sys, pkxyz_ctrl.loop.runtime, pkxyz_ctrl.loop.cycle\n"
        "print(sorted({m.partition('.')[0] for m in sys.modules} & {'can', 'canopen', 'cantools', 'hil', 'sim',"
        " 'control', 'filterpy', 'osqp', 'matplotlib', 'pyarrow', 'rich', 'typer', 'ruckig'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == "[]"


# -- size ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("module", MODULES)
def test_files_are_of_one_idea(module):
    """None is so long that it must be several, and none is called after what nobody could name."""
    assert len(AS_IT_IS.sources[module].splitlines()) <= 400
    assert module.rpartition(".")[2] not in NAMES_FOR_NOTHING


def test_files_of_tests_and_scripts_are_of_one_idea_too():
    files = [path for top in ("tests", "docs", "benchmarks", "examples") for path in (ROOT / top).rglob("*.py")]
    assert len(files) > 200
    long = {str(path.relative_to(ROOT)): n for path in files if (n := len(path.read_text("utf-8").splitlines())) > 400}
    assert long == {}


def test_no_folder_has_more_modules_than_one_can_overlook():
    """Sixteen, also of tests, examples and scripts."""
    tops = (*PACKAGES, "tests", "docs", "benchmarks", "examples")
    files = [path for top in tops for path in (ROOT / top).rglob("*.py")]
    folders = {path.parent for path in files}
    assert len(folders) > 40
    counted = {str(folder.relative_to(ROOT)): len(list(folder.glob("*.py"))) for folder in folders}
    assert {folder: count for folder, count in counted.items() if count > 16} == {}


def test_every_room_has_its_folder_of_tests():
    """That of ``hil.studies.tune`` is ``tests/studies/tune``; the plant's stand in ``tests/sim``."""
    owned = [room.removeprefix("hil.").removeprefix("pkxyz_ctrl.") for room in AS_IT_IS.rooms if "." in room]
    folders = {path.parent.relative_to(ROOT / "tests").as_posix() for path in (ROOT / "tests").rglob("test_*.py")}
    assert {room.replace(".", "/") for room in owned} - folders == set()

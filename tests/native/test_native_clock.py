"""Where the native loop's ticks lie beside what the kernel does a hundred or a thousand times a second."""

import subprocess
from pathlib import Path

import pytest

from hil.native.program import FLAGS, compiler

HERE = Path(__file__).parent
LATE = 5 / 8


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    if (cc := compiler()) is None:
        pytest.skip("no C compiler")
    built = tmp_path_factory.mktemp("clock") / "clock"
    words = [cc, *FLAGS, "-Wno-unused-parameter", "-o", str(built), str(HERE / "clock_alone.c")]
    subprocess.run(words, check=True, capture_output=True, text=True)
    return built


def placed(program, period_us):
    done = subprocess.run([program, str(period_us), str(round(LATE * period_us))], check=True, capture_output=True)
    first, *others = done.stdout.decode().splitlines()
    return int(first), [tuple(map(int, line.split())) for line in others]


@pytest.mark.parametrize("period_us", [200, 500, 1000])
def test_the_kernel_works_when_the_voltages_have_gone(program, period_us):
    """The tick begins within a period of when it was to, and so that the kernel comes next where it is wanted."""
    kernel_ns, ticks = placed(program, period_us)
    if kernel_ns == 0 or (kernel_ns % (1000 * period_us) and 1000 * period_us % kernel_ns):
        pytest.skip(f"the kernel's period of {kernel_ns} ns and {period_us} us do not go together")
    for asked_us, begins_us, past_ns in ticks:
        assert 0 <= begins_us - asked_us < period_us
        assert abs(past_ns - 1000 * round(LATE * period_us)) < 1000


def test_where_the_periods_do_not_go_together_a_tick_begins_when_it_was_to(program):
    kernel_ns, ticks = placed(program, 997)
    assert kernel_ns == 0 or kernel_ns % 997_000
    assert all(begins_us == asked_us for asked_us, begins_us, _ in ticks)


def test_what_the_kernel_is_said_to_do_it_does_at_the_same_place_again(program):
    """Two looks, some time apart; its period is the resolution of the coarse clock."""
    periods = {placed(program, 500)[0] for _ in range(2)}
    assert len(periods) == 1
    assert periods <= {0, *(10**9 // hz for hz in (100, 250, 300, 1000))}

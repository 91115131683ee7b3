"""Every number with a unit in README and docs has somebody who answers for it: ``numbers.toml`` says who, page by page.

A number that is new, or that was changed in the text, is missing there, and this test says so. One that has gone is
told as well. Generated tables and blocks of code answer for themselves.
"""

import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
PAGES = ["README.md", *sorted(p.relative_to(ROOT).as_posix() for p in (ROOT / "docs").rglob("*.md"))]
ANSWERS: dict[str, dict[str, list[str]]] = tomllib.loads(Path(__file__).with_name("numbers.toml").read_text("utf-8"))

WORDS = {
    "published": "a paper, a data sheet or a standard, which the text names",
    "chosen": "what an example or an experiment takes, or what is asked for",
    "derived": "follows from other numbers of the text",
    "limit": "0 V and the like: what the words mean",
}
"""Who answers where it is no test, no file and no command."""

_UNITS = {
    "%": 1e-2, "ppm": 1e-6, "pm": 1e-12, "nm": 1e-9, "um": 1e-6, "mm": 1e-3, "um³": 1e-18,
    "Hz": 1.0, "kHz": 1e3, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "uN": 1e-6, "mN": 1e-3, "N/m": 1.0,
    "N/mm": 1e3, "uV": 1e-6, "mV": 1e-3, "V": 1.0, "aF": 1e-18, "fF": 1e-15, "pF": 1e-12, "dB": 1.0, "mg": 1e-6,
    "K": 1.0, "rad": 1.0, "mrad": 1e-3, "degrees": 1.0, "deg": 1.0, "MB": 1e6, "kB": 1e3, "Mbit/s": 1e6,
    "ticks": 1.0, "SYNCs": 1.0, "times": 1.0,
}  # fmt: skip
_NUMBER = r"[-+]?\d+(?: \d{3})*(?:\.\d+)?(?:e-?\d+)?"
_UNIT = "|".join(sorted(map(re.escape, _UNITS), key=len, reverse=True))
_TOLD = re.compile(rf"(?<![\w.^])({_NUMBER}(?:(?:\s?/\s?|, | to | and |\.\.){_NUMBER})*)\s?({_UNIT})(?![\w/])")


def prose(name: str) -> str:
    """A page in one line, without what is generated, without blocks of code and formulas."""
    text = (ROOT / name).read_text(encoding="utf-8")
    text = re.sub(r"<!-- (generated|table): .*?<!-- (end|table: end) -->", "", text, flags=re.DOTALL)
    text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    return " ".join(re.sub(r"^    .*$|`[^`\n]*`", "", text, flags=re.MULTILINE).split())


def numbers(text: str) -> list[str]:
    """Numbers with their unit, as written; those of a series that share one stay together."""
    return list(dict.fromkeys(match[0] for match in _TOLD.finditer(text)))


@pytest.mark.parametrize("name", PAGES)
def test_every_number_of_a_page_is_answered_for(name: str) -> None:
    told, answered = set(numbers(prose(name))), [n for listed in ANSWERS.get(name, {}).values() for n in listed]
    assert sorted(told - set(answered)) == [], f"who answers for them? tests/docs/numbers.toml, [{name!r}]"
    assert sorted(set(answered) - told) == [], "no longer on the page"
    assert len(answered) == len(set(answered)), "one answer each"


def test_no_page_is_answered_for_that_is_gone() -> None:
    assert sorted(set(ANSWERS) - set(PAGES)) == []


@pytest.mark.parametrize("who", sorted({who for page in ANSWERS.values() for who in page}))
def test_who_answers_is_there(who: str) -> None:
    if who.startswith("tests/") and Path(who).name.startswith("test_"):
        assert "\ndef test_" in (ROOT / who).read_text(encoding="utf-8")
    else:
        assert who in WORDS or (ROOT / who).exists()


TOLD_BY = [
    (name, who, told)
    for name, page in ANSWERS.items()
    for who, listed in page.items()
    for told in listed
    if who not in WORDS and not who.startswith("configs/") and who != "benchmarks/results.json"
]


@pytest.mark.parametrize(("name", "who", "told"), TOLD_BY)
def test_who_answers_has_the_number_or_reads_the_page(name: str, who: str, told: str) -> None:
    """Whatever the unit, so by its digits."""
    text = (ROOT / who).read_text(encoding="utf-8")
    if Path(name).name in text:
        return
    had = [float(n.replace("_", "")) for n in re.findall(r"(?<![\w.])\d[\d_]*(?:\.\d+)?(?:e-?\d+)?", text)]
    for number in re.findall(_NUMBER, told):
        value = abs(float(number.replace(" ", "")))
        scaled = [value * 10.0**power for power in range(-15, 16)]
        assert any(abs(h - s) <= 1e-3 * s for h in had for s in scaled), f"{who} has no {number}"


def in_si(told: str) -> list[float]:
    match = _TOLD.fullmatch(told)
    assert match is not None, told
    return [float(n.replace(" ", "")) * _UNITS[match[2]] for n in re.findall(_NUMBER, match[1])]


def values(data: Any) -> Iterator[float]:
    """Every number of plain data."""
    if isinstance(data, bool):
        return
    if isinstance(data, int | float):
        yield float(data)
    elif isinstance(data, dict | list):
        for inner in data.values() if isinstance(data, dict) else data:
            yield from values(inner)


SET = [(n, who, told) for n, page in ANSWERS.items() for who, listed in page.items() for told in listed
       if who.startswith("configs/") and Path(who).suffix in ("", ".toml")]  # fmt: skip


@pytest.mark.parametrize(("name", "who", "told"), SET)
def test_what_a_file_sets_is_in_that_file(name: str, who: str, told: str) -> None:
    """By value, in the key's unit: SI, microseconds, milliseconds, or a rate where the file has a period."""
    files = [ROOT / who] if (ROOT / who).is_file() else sorted((ROOT / who).glob("*.toml"))
    found = [v for file in files for v in values(tomllib.loads(file.read_text(encoding="utf-8")))]
    for value in in_si(told):
        shapes = {value, abs(value), value * 1e3, value * 1e6, value * 1e9, 1e6 / value if value else 0.0}
        assert any(abs(v - s) <= 2e-3 * abs(s) for v in found for s in shapes), f"{name}: {told} is not in {who}"


MEASURED = [(n, told) for n, page in ANSWERS.items() for told in page.get("benchmarks/results.json", [])]


@pytest.mark.parametrize(("name", "told"), MEASURED)
def test_what_was_measured_is_in_the_results(name: str, told: str) -> None:
    """As a figure's value, or in the words beside it, rounded as it is told."""
    results = json.loads((ROOT / "benchmarks" / "results.json").read_text(encoding="utf-8"))["figures"]
    known = [float(f["value"]) for f in results] + [
        float(n.replace(" ", "")) for f in results for n in re.findall(_NUMBER, f["detail"])
    ]
    for number in re.findall(_NUMBER, told):
        digits = len(number.partition(".")[2])
        assert any(abs(abs(k) - abs(float(number.replace(" ", "")))) <= 0.51 * 10**-digits for k in known), (
            f"{name}: {told}"
        )


def test_numbers_are_found_with_their_units() -> None:
    text = (
        "| 3.5 / 3.2 / 2.8 nm | 10 000 ticks, 0x2012 and 5kHz, Eq. 19; -0.6 dB, 2.6 and 4.1 kHz, 619, 619 and 777 Hz |"
    )
    assert numbers(text) == ["3.5 / 3.2 / 2.8 nm", "10 000 ticks", "5kHz", "-0.6 dB", "2.6 and 4.1 kHz",
                             "619, 619 and 777 Hz"]  # fmt: skip
    assert in_si("2.6 and 4.1 kHz") == [2600.0, 4100.0]

"""The documentation's site: it builds without a warning, offline, and no page loads or names another host."""

import html
import inspect
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
import reference_tables
import wire_tables
from generated_pages import commands, field_meanings
from mkdocs.commands.build import build
from mkdocs.config import load_config

from hil.conformance.run import CHECKS
from hil.screen.fault_codes import CLEARS, EMERGENCY_CAUSES, stem
from hil.studies.faults.matrix import CASES
from pkxyz_ctrl.can.emergency import _EXACT
from pkxyz_ctrl.client.plain import Stage
from pkxyz_ctrl.loop.row import ROW, columns
from pkxyz_ctrl.safety.monitors import NodeEvent, SenseStatus
from pkxyz_ctrl.safety.trips import Trip

ROOT = Path(__file__).parents[2]
NAMESPACES = {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink", "http://www.w3.org/1999/xhtml"}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(out)))  # strict: a warning, as of a dead link, is an error
    return out


class Addresses(HTMLParser):
    """What a browser would fetch or follow, and the classes of all elements."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.classes: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.found += [given[name] for name in ("src", "href", "srcset", "data", "action", "poster") if name in given]
        self.classes.update(given.get("class", "").split())


@pytest.mark.slow
def test_no_page_names_another_host(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 20
    for page in pages:
        read = Addresses(page.read_text(encoding="utf-8"))
        elsewhere = [a for a in read.found if re.match(r"(\w+:)?//", a)]
        assert not elsewhere, f"{page.name}: {elsewhere}"
        assert "mermaid" not in read.classes, f"{page.name}: the theme would fetch a renderer for this diagram"


def test_styles_and_drawings_fetch_nothing(site: Path) -> None:
    for path in [*site.rglob("*.css"), *site.rglob("*.svg")]:
        text = path.read_text(encoding="utf-8")
        fetched = re.findall(r"(?:url\(|@import|href=)\s*[\"']?((?:https?:)?//[^\"')\s]+)", text)
        assert not set(fetched) - NAMESPACES, path.name


def test_an_address_of_another_host_would_be_seen() -> None:
    read = Addresses('<link href="https://fonts.example/x.css"><img src="//cdn.example/y.png"><a href="page.html">')
    assert [a for a in read.found if re.match(r"(\w+:)?//", a)] == read.found[:2]


def test_every_link_to_a_picture_or_page_has_its_file(site: Path) -> None:
    for page in site.rglob("*.html"):
        if page.name == "404.html":
            continue  # is served from anywhere, so it has absolute addresses
        for address in Addresses(page.read_text(encoding="utf-8")).found:
            path = address.partition("#")[0].partition("?")[0]
            if path and not re.match(r"(\w+:)", path) and not path.startswith("__"):
                assert (page.parent / path).exists(), f"{page.relative_to(site)}: {address}"


def test_every_command_and_its_options_are_on_the_page(site: Path) -> None:
    text = (site / "lookup" / "commands.html").read_text(encoding="utf-8")
    listed = dict(commands())
    assert {"sil", "run", "plant", "check-amplifier", "configs"} <= set(listed)
    for name, command in listed.items():
        assert f"pkxyz {name}" in text
        for parameter in command.params:
            for option in parameter.opts:
                assert getattr(parameter, "hidden", False) or not option.startswith("--") or option in text


def test_every_column_is_on_the_page_with_its_meaning(site: Path) -> None:
    meanings = field_meanings()
    assert tuple(meanings) == ROW.names
    assert all(len(words) > 3 for words in meanings.values()), [n for n, words in meanings.items() if len(words) <= 3]
    text = (site / "lookup" / "recording.html").read_text(encoding="utf-8")
    for field in meanings:
        assert all(f"<code>{column}</code>" in text for column in columns(field))


def test_the_verbs_of_a_stage_in_operation_are_on_the_page_with_arguments_and_words(site: Path) -> None:
    text = (site / "lookup" / "api.html").read_text(encoding="utf-8")
    for verb, function in inspect.getmembers(Stage, inspect.isfunction):
        if not verb.startswith("_"):
            _, _, section = text.partition(f'id="pkxyz_ctrl.client.plain.Stage.{verb}"')
            words = html.unescape(re.sub(r"<[^>]+>", "", section[:9000])).split()
            wanted = [*inspect.signature(function).parameters][1:] + (inspect.getdoc(function) or "").split()[:4]
            assert all(any(word.strip("`") in said for said in words) for word in wanted), verb


@pytest.mark.parametrize("name", sorted(reference_tables.BUILT))
def test_every_table_of_the_code_stands_on_a_page_of_the_site(site: Path, name: str) -> None:
    pages = [p for p in (ROOT / "docs").rglob("*.md") if f"<!-- built: {name} -->" in p.read_text(encoding="utf-8")]
    assert len(pages) == 1
    text = (site / pages[0].relative_to(ROOT / "docs")).with_suffix(".html").read_text(encoding="utf-8")
    rows = reference_tables.BUILT[name]().splitlines()[2:]
    assert len(rows) >= 3
    assert text.count("<tr>") > len(rows)
    assert f"built: {name}" not in text


def test_every_check_of_an_amplifier_is_in_its_table() -> None:
    text = reference_tables.conformance()
    assert all(f"| {check.name} | {check.expected} | {check.basis} |" in text for check in CHECKS)


def test_every_bit_that_the_wire_tells_has_its_meaning() -> None:
    assert list(wire_tables.STATUS) == list(SenseStatus)
    assert list(wire_tables.EVENTS) == list(NodeEvent)


def test_the_kept_matrix_is_of_today_s_faults() -> None:
    told = [line.split(" | ")[0].strip("| ") for line in reference_tables.matrix().splitlines()[2:]]
    assert told == [case.text for case in CASES]


def test_a_mark_that_nobody_serves_is_an_error() -> None:
    with pytest.raises(KeyError, match="nothing"):
        reference_tables.with_tables("<!-- built: nothing -->")


def test_every_fault_and_emergency_code_is_on_the_troubleshooting_page_with_an_address(site: Path) -> None:
    text = (site / "do" / "troubleshooting.html").read_text(encoding="utf-8")
    for trip in Trip:
        assert f'<a id="{(trip.name or "").lower()}"></a>' in text
    assert {stem(trip.name or "") for trip in Trip} <= set(CLEARS)
    for code in _EXACT:
        assert f'<a id="{code:04x}"></a>0x{code:04X}' in text
    assert set(EMERGENCY_CAUSES) == set(_EXACT)

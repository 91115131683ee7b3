"""What nobody calls is not there: every function and class is named by the product, its pages or its examples."""

import ast
import re
from collections import Counter
from collections.abc import Iterable

from rooms import ROOT, House

SOURCES = House.of(ROOT).sources
CALLED_FROM_OUTSIDE = ("model_validator", "field_validator", "app.callback")
"""Decorators whose functions another library calls."""
NAMED_NOWHERE = {
    "set_bit_error_rate": "a user's bus: disturbances beside those of the fault catalogue",
    "corrupt_next": "a user's bus: disturbances beside those of the fault catalogue",
    "worst_case_frame_us": "the literature's bound, which the exact range is held against",
    "comb_force": "Stage, for programs", "strokes_from_capacitance": "Stage, for programs",
    "energy_j": "the integral of the gradient that is used, and what it is held against",
    "hinge_moment_max_n_m": "Eq. 29", "rest_slider_m": "Eq. 8", "position_by_sextic": "Appendix A",
    "spring_energy_j": "Eq. 15 and 16", "assembled_stiffness_n_per_m": "Eq. 18", "platform_force_n": "Eq. 22 and 23",
    "comb_stiffness_n_per_m": "Eq. 24", "exact_jacobians": "Eq. 9 to 12",
    "_send_periodic_internal": "python-can", "capture_signals": "uvicorn", "format_commands": "click",
    "add_callback": "bluesky", "hints": "bluesky", "describe_configuration": "bluesky", "check_value": "bluesky",
    "locate": "bluesky",
}  # fmt: skip
"""Who wants it all the same."""
BY_NAME = {"pkxyz_ctrl.instrument.scpi": "a table of verbs looks them up"}


def defined(source: str) -> list[str]:
    """Functions and classes of a source that no other library calls by itself."""
    return [
        node.name
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
        and not node.name.startswith("__")
        and not any(name in ast.unparse(d) for d in node.decorator_list for name in CALLED_FROM_OUTSIDE)
    ]


def named_once(sources: Iterable[str], others: Iterable[str]) -> set[str]:
    """What is defined in a source and is written nowhere else, there or in others."""
    sources = list(sources)
    words = Counter(word for text in [*sources, *others] for word in re.findall(r"\w+", text))
    return {name for source in sources for name in defined(source) if words[name] == 1}


def test_nothing_is_there_that_only_tests_call():
    others = [
        path.read_text(encoding="utf-8")
        for folder, kind in (("docs", "*.md"), ("docs", "*.py"), ("examples", "*.py"), ("benchmarks", "*.py"))
        for path in (ROOT / folder).rglob(kind)
    ]
    found = named_once(SOURCES.values(), [*others, (ROOT / "README.md").read_text(encoding="utf-8")])
    looked_up = {name for module in BY_NAME for name in defined(SOURCES[module])}
    assert found - looked_up - set(NAMED_NOWHERE) == set()
    assert set(NAMED_NOWHERE) <= {name for source in SOURCES.values() for name in defined(source)}, "gone, or renamed"


def test_what_nobody_calls_is_found():
    used = (
        "def used(): pass\ndef unused(): used()\nclass C:\n  @model_validator(mode='after')\n  def _ordered(self): C()"
    )
    assert named_once([used], []) == {"unused"}
    assert named_once([used], ["see unused"]) == set()

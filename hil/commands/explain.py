"""``pkxyz explain``: a fault code or an emergency code in words, its usual cause, and what clears it."""

import json
from typing import Annotated

import typer

from hil.screen.fault_codes import Explained, explained, trips
from hil.screen.options import AnswerAsJson
from hil.screen.terminal import say
from pkxyz_ctrl.config.files import ConfigError


def explain(
    codes: Annotated[
        list[str] | None,
        typer.Argument(help="Codes as the screen writes them: SENSE_STALE, COMB_FORCE_2, 0x8130. None: all faults."),
    ] = None,
    as_json: AnswerAsJson = False,
) -> None:
    """Say what a fault or an amplifier's emergency means, its usual cause, and what clears it."""
    found = [words for code in codes for words in _known(code)] if codes else list(trips().values())
    if as_json:
        print(json.dumps([words._asdict() for words in found]))
        return
    for name, happened, cause, clears in found:
        say(f"{name}: {happened}")
        say(f"  usual cause, what to check: {cause}")
        say(f"  what clears it: {clears}")


def _known(code: str) -> list[Explained]:
    found = explained(code)
    if not found:
        raise ConfigError(f"no code {code!r}: `pkxyz explain` lists all faults; emergencies are 0x0000 to 0xFFFF")
    return found

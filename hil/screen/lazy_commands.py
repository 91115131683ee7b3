"""A command is loaded when it is called: what the others need is no business of its start."""

import importlib
from collections.abc import Iterator, Mapping
from typing import Any

import typer
from typer.core import TyperGroup

HELP = {"help_option_names": ["-h", "--help"]}


class LazyCommands(Mapping[str, Any]):
    """Commands by name. ``places``: of each the module and function, as ``"module:function"``, and what it is for."""

    def __init__(self, places: Mapping[str, tuple[str, str]]) -> None:
        self.places = places
        self._loaded: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._loaded:
            place, words = self.places[name]
            module, _, function = place.partition(":")
            alone = typer.Typer(add_completion=False, rich_markup_mode=None)
            called = getattr(importlib.import_module(module), function)
            alone.command(name, short_help=words, context_settings=HELP)(called)
            self._loaded[name] = typer.main.get_command(alone)
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.places)

    def __len__(self) -> int:
        return len(self.places)


def group_of(places: Mapping[str, tuple[str, str]]) -> type[TyperGroup]:
    """A group of these commands; its help is written without loading any."""

    class Group(TyperGroup):
        def __init__(self, **attributes: Any) -> None:
            super().__init__(**attributes)
            self.commands: Any = LazyCommands(places)

        def format_commands(self, ctx: Any, formatter: Any) -> None:
            with formatter.section("Commands"):
                formatter.write_dl([(name, words) for name, (_, words) in places.items()])

    return Group

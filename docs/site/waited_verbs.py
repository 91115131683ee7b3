"""What mkdocstrings reads of ``pkxyz_ctrl.client.plain.Stage``, whose verbs are made from those of ``AsyncStage``."""

from typing import Any

import griffe


class WaitedVerbs(griffe.Extension):
    """In the place of ``verb = _waited(AsyncStage.verb)``, the verb with arguments and words."""

    def on_package(self, *, pkg: griffe.Module, loader: Any, **kwargs: Any) -> None:
        if pkg.name != "pkxyz_ctrl":
            return
        waited, plain = pkg["client.stage.AsyncStage"], pkg["client.plain.Stage"]
        for name, member in list(plain.members.items()):
            if not (member.is_attribute and str(member.value).startswith("_waited(")):
                continue
            verb = waited[name]
            said = griffe.Function(
                name, lineno=member.lineno, endlineno=member.endlineno, parameters=verb.parameters,
                returns=verb.returns, docstring=verb.docstring,
            )  # fmt: skip
            plain.set_member(name, said)

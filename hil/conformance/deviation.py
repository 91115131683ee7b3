"""How a check ends that does not pass: with what came instead, what has to be measured, or why it was not made."""


class DeviationError(Exception):
    """The node did something else than expected; the text says what came. ``is_unsafe``: whatever the check is about,
    this node must not be enabled.
    """

    def __init__(self, text: str, *, is_unsafe: bool = False) -> None:
        super().__init__(text)
        self.is_unsafe = is_unsafe


class UndecidedError(Exception):
    """What the node says of itself decides nothing; the text says what to measure, and what it must be."""


class NotTestedError(Exception):
    """The check could not be made; the text says why. Not a verdict on the node."""


def first_few(deviations: list[str], limit: int = 6) -> str:
    """A list for one line of a report."""
    more = len(deviations) - limit
    return "; ".join(deviations[:limit]) + (f"; and {more} more" if more > 0 else "")


def deviate_if(deviations: list[str]) -> None:
    """Raise ``DeviationError`` if there is anything in the list."""
    if deviations:
        raise DeviationError(first_few(deviations))

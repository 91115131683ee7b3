"""A pipe by which the loop and whoever it is not to outlive know of each other's end, however it comes."""

import os


class HeldPipe:
    """``pipe`` is for the loop to inherit, ``alive`` the end that is read: closed here, the loop is to end; at its end,
    the loop has.
    """

    def __init__(self) -> None:
        self.alive, self.pipe = os.pipe()

    def handed_over(self) -> None:
        """The loop has inherited ``pipe``, and is the only one to hold it from now on."""
        if self.pipe >= 0:
            os.close(self.pipe)
            self.pipe = -1

"""The one exception for mistakes in the user's input, and nothing else."""


class InputError(ValueError):
    """Input that cannot be used; the message is one line: the thing and the mend.

    Scripts turn it into that one line and exit code 2; library users catch it as
    a `ValueError`. What would break the line, as a file's name may, becomes a space.
    """

    def __init__(self, message: str) -> None:
        super().__init__("".join(c if c.isprintable() else " " for c in message))


class InputWarning(UserWarning):
    """Input that was mended on the way in or costs accuracy; the message says how."""

"""The one exception for mistakes in the user's input, and who says what it is about."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager


class InputError(ValueError):
    """Input that cannot be used; the message is one line: the thing and the mend.

    Scripts turn it into that one line and exit code 2; library users catch it as
    a `ValueError`. What would break the line, as a file's name may, becomes a space.
    """

    def __init__(self, message: str) -> None:
        super().__init__("".join(c if c.isprintable() else " " for c in message))


class InputWarning(UserWarning):
    """Input that was mended on the way in or costs accuracy; the message says how."""


@contextmanager
def naming(thing: str) -> Iterator[None]:
    """Let errors and warnings about input say which file or object it is."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            yield
        except InputError as error:
            if thing in str(error):
                raise
            raise InputError(f"{thing}: {error}") from None
    for warning in told:
        text = warning.message
        if isinstance(text, InputWarning) and thing not in str(text):
            text = InputWarning(f"{thing}: {text}")
        # Here, contextlib, who names it, and whoever called that.
        warnings.warn(text, stacklevel=4)

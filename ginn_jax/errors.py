"""The one exception for mistakes in the user's input, and who says what it is about."""

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

# Of this thread alone, as filters of warnings are not: what `naming` names, outermost
# first, and whether `silence` is kept.
_NAMES: ContextVar[tuple[str, ...]] = ContextVar("names", default=())
_SILENT: ContextVar[bool] = ContextVar("silent", default=False)


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
    """Let errors about input, and what `warn` says, tell which file or object it is."""
    before = _NAMES.set((*_NAMES.get(), thing))
    try:
        yield
    except InputError as error:
        if thing in str(error):
            raise
        raise InputError(f"{thing}: {error}") from None
    finally:
        _NAMES.reset(before)


@contextmanager
def silence() -> Iterator[None]:
    """Let `warn` say nothing."""
    before = _SILENT.set(True)
    try:
        yield
    finally:
        _SILENT.reset(before)


def warn(message: str) -> None:
    """An `InputWarning` where the package was called, by the names of `naming`."""
    if _SILENT.get():
        return
    for thing in reversed(_NAMES.get()):
        if thing not in message:
            message = f"{thing}: {message}"
    package, level, frame = __name__.partition(".")[0], 2, sys._getframe(1)
    while frame and frame.f_globals.get("__name__", "").startswith(f"{package}."):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, InputWarning, stacklevel=level)

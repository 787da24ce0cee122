"""What every script does with its command line: options, --quick, one-line errors."""

import contextlib
import io
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any, TypeVar

import tyro

from ginn_jax.errors import InputError
from ginn_jax.process import tune_process

Options = TypeVar("Options")
FRAME = re.compile(r"[\u2500-\u257f]+")


def start(
    kind: type[Options],
    main: Callable[[Options], Any],
    quick: Mapping[str, Any],
    description: str | None = None,
) -> None:
    """Run a script: mistakes in its options or input end in one line and code 2."""
    options = parse(kind, description)
    tune_process()
    try:
        main(hasten(options, quick))
    except InputError as error:
        fail(str(error))


def parse(kind: type[Options], description: str | None) -> Options:
    """Options from the command line; what cannot be parsed is said in one line."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(kind, description=description)
    except SystemExit as stop:
        if not stop.code:
            raise
        fail(" ".join(FRAME.sub(" ", said.getvalue()).split()))
        raise


def fail(message: str) -> None:
    """Print one line and leave with exit code 2."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


def hasten(options: Any, quick: Mapping[str, Any]) -> Any:
    """With --quick, `quick` takes the place of whatever was left at its default."""
    if not quick or not options.quick:
        return options
    default = {f.name: f.default for f in fields(options)}
    left = {n: v for n, v in quick.items() if getattr(options, n) == default[n]}
    return replace(options, **left)


def require_positive(options: Any, name: str) -> None:
    """Raise `InputError` for an option that is not a finite number above 0."""
    value = getattr(options, name)
    if not 0 < value < float("inf"):
        raise InputError(f"--{name.replace('_', '-')} is {value}: give it above 0")


def require(options: Any, least: Mapping[str, int]) -> None:
    """Raise `InputError` for the first option below its least value."""
    for name, minimum in least.items():
        if getattr(options, name) < minimum:
            flag = name.replace("_", "-")
            raise InputError(
                f"--{flag} is {getattr(options, name)}: give at least {minimum}"
            )

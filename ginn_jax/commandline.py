"""What every script does with its command line: options, --quick, one-line errors."""

import contextlib
import io
import logging
import os
import re
import shlex
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor
from dataclasses import fields, replace
from typing import Any, TypeVar

import tyro

from ginn_jax.checks import LARGEST_INDEX
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
    """Run a script; whatever ends it is said in one line, without a traceback.

    The exit code is 2 where the user can mend it: options, input, a disk that is full
    or not to be written to, too little memory. It is 1 where the mistake is ours, and
    130 where Ctrl-C stopped the run. With GINN_JAX_TRACEBACK set, what is ours comes
    with its traceback. Where nobody reads on, as after `| head`, it ends in silence.
    """
    try:
        run(parse(kind, description), main, quick)
    except BrokenPipeError:
        # Or Python would say so once more, when it flushes at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def run(
    options: Options, main: Callable[[Options], Any], quick: Mapping[str, Any]
) -> None:
    """Run a script with these options and leave as `start` says."""
    tune_process()
    traced = bool(os.environ.get("GINN_JAX_TRACEBACK"))
    if not traced:
        silence_threads()
    try:
        main(hasten(options, quick))
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except KeyboardInterrupt:
        fail("stopped", 130)
    except Exception as error:
        code, message = explain(error)
        if code == 1 and traced:
            raise
        fail(message, code)


def command_line(module: str, options: Any) -> str:
    """The command that runs a script with these options, but for where it writes."""
    words, usual = ["python", "-m", module], type(options)()
    for field in fields(options):
        value = getattr(options, field.name)
        if field.name != "out" and value != getattr(usual, field.name):
            given = value if isinstance(value, tuple | list) else (value,)
            words += [f"--{field.name.replace('_', '-')}"]
            words += [] if value is True else map(str, given)
    return shlex.join(words)


def silence_threads() -> None:
    """Let no thread print a traceback: what matters of it reaches the main one.

    TensorStore's and orbax's would where a checkpoint turns out to be damaged.
    """
    sys.excepthook = threading.excepthook = sys.unraisablehook = lambda *_: None
    logging.getLogger("absl").setLevel(logging.CRITICAL)


def explain(error: Exception) -> tuple[int, str]:
    """Exit code and message for what ended a script."""
    if isinstance(error, InputError):
        return 2, str(error)
    if isinstance(error, OSError) and error.errno is not None:
        place = f"{error.filename}: " if error.filename else ""
        return 2, f"{place}{error.strerror}; make room or name another place"
    said = " ".join(str(error).split())[:300]
    if isinstance(error, MemoryError | BrokenExecutor) or "RESOURCE_EXHAUSTED" in said:
        return 2, f"not enough memory ({said}); ask for fewer points or pixels"
    frame = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{os.path.basename(frame.filename)}:{frame.lineno}"
    return 1, (
        f"a mistake of ours, {type(error).__name__} at {where}: {said}; please report "
        "it with what GINN_JAX_TRACEBACK=1 shows"
    )


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


def fail(message: str, code: int = 2) -> None:
    """Print one line and leave with that exit code."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(code)


def hasten(options: Any, quick: Mapping[str, Any]) -> Any:
    """With --quick, `quick` takes the place of whatever was left at its default."""
    if not quick or not options.quick:
        return options
    default = {f.name: f.default for f in fields(options)}
    left = {n: v for n, v in quick.items() if getattr(options, n) == default[n]}
    return replace(options, **left)


def require_positive(options: Any, *names: str) -> None:
    """Raise `InputError` for the first option that is not a finite number above 0.

    Of an option of several values each is looked at.
    """
    for name in names:
        flag = name.replace("_", "-")
        for value in _values(options, name):
            if not 0 < value < float("inf"):
                raise InputError(f"--{flag} is {value}: give it above 0")


def require(options: Any, least: Mapping[str, int]) -> None:
    """Raise `InputError` for the first option below its least value, or beyond all.

    An option left out, None, has its value chosen by the script; of several values each
    is looked at.
    """
    for name, minimum in least.items():
        flag = name.replace("_", "-")
        for value in _values(options, name):
            if value < minimum:
                raise InputError(f"--{flag} is {value}: give at least {minimum}")
            if value > LARGEST_INDEX:
                raise InputError(f"--{flag} is {value}: give at most {LARGEST_INDEX}")


def require_some(options: Any, *names: str, least: int = 1) -> None:
    """Raise `InputError` for the first option with fewer than so many values."""
    for name in names:
        if (count := len(_values(options, name))) < least:
            flag = name.replace("_", "-")
            raise InputError(f"--{flag} has {count} values: give at least {least}")


def require_shares(options: Any, name: str) -> None:
    """Raise `InputError` for the first share of an option beyond .01 or 1."""
    for value in _values(options, name):
        if not 0.01 <= value <= 1:
            raise InputError(f"--{name} is {value}: give it from 0.01 to 1")


def _values(options: Any, name: str) -> tuple[Any, ...]:
    """The values of an option: several, one, or none where it is left out."""
    value = getattr(options, name)
    if isinstance(value, tuple):
        return value
    return () if value is None else (value,)

"""Benchmarks, one script per question: `python -m benchmarks.NAME`.

Each takes --quick and --out DIR, and writes metrics.json, report.md and a figure there.
Times are wall times, compilation apart, of variants that take turns in one process.
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any, TypeVar

import tyro

from ginn_jax.errors import InputError
from ginn_jax.process import tune_process

Options = TypeVar("Options")


def start(
    kind: type[Options], main: Callable[[Options], Any], quick: Mapping[str, Any]
) -> None:
    """Command line of a script: mistakes in the input end in one line and code 2."""
    options = tyro.cli(kind)
    tune_process()
    try:
        main(hasten(options, quick))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def hasten(options: Any, quick: Mapping[str, Any]) -> Any:
    """With --quick, `quick` takes the place of whatever was left at its default."""
    if not options.quick:
        return options
    default = {f.name: f.default for f in fields(options)}
    left = {n: v for n, v in quick.items() if getattr(options, n) == default[n]}
    return replace(options, **left)


def require(options: Any, least: Mapping[str, int]) -> None:
    """Raise `InputError` for the first option below its least value."""
    for name, minimum in least.items():
        if getattr(options, name) < minimum:
            flag = name.replace("_", "-")
            raise InputError(
                f"--{flag} is {getattr(options, name)}: give at least {minimum}"
            )

"""How long things take: compilation apart, variants alternated in one process."""

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

import jax
import numpy as np

from ginn_jax.report import environment, write_results

WARM = 0.2  # seconds
Variants = Mapping[str, Callable[[], Any]]


class Timing(NamedTuple):
    """Wall seconds of one variant: its first call, which compiles, and the others."""

    first: float
    seconds: tuple[float, ...]

    @property
    def median(self) -> float:
        """The median call."""
        return float(np.median(self.seconds))

    @property
    def minimum(self) -> float:
        """The fastest call, which other processes disturbed least."""
        return min(self.seconds)

    @property
    def spread(self) -> float:
        """Interquartile range over the median."""
        low, high = np.percentile(self.seconds, [25, 75])
        return float((high - low) / self.median)

    @property
    def compile(self) -> float:
        """What the first call took beyond a median one."""
        return max(self.first - self.median, 0.0)

    def __str__(self) -> str:
        return f"{1e3 * self.median:.3g} ms ± {50 * self.spread:.0f} %"

    def record(self) -> dict[str, Any]:
        """Everything, for metrics.json."""
        names = ("median", "minimum", "spread", "compile")
        return {name: getattr(self, name) for name in names} | self._asdict()


def measure(variants: Variants, repeats: int) -> dict[str, Timing]:
    """Time each variant `repeats` times, in turns, after a first call of each.

    Turns share out what else the machine does. What one variant leaves behind, in
    caches and in threads that spin, would fall on the next: every round has an order of
    its own, and short calls come after others of the same that fill `WARM` and do not
    count. Each call is over when its result is.
    """
    first = {name: clock(call) for name, call in variants.items()}
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    order = np.random.default_rng(0)
    for _ in range(repeats):
        for name in order.permutation(list(variants)).tolist():
            spent = min(seconds[name], default=0.0)
            while spent < WARM:
                spent += clock(variants[name])
            seconds[name].append(clock(variants[name]))
    return {name: Timing(first[name], tuple(seconds[name])) for name in variants}


def clock(call: Callable[[], Any]) -> float:
    """Wall seconds until the result of one call is there."""
    begin = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - begin


def load() -> float:
    """Processes that want a core, averaged over a minute: above 1 others compete."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")


def circumstances(options: Any, begin: float) -> dict[str, Any]:
    """What every metrics.json has; `begin` is what `time.perf_counter` said then."""
    return {
        "options": asdict(options),
        "environment": environment() | {"load": load()},
        "machine": describe(),
        "seconds_total": time.perf_counter() - begin,
    }


def write_cases(
    options: Any, cases: list[dict[str, Any]], text: str, begin: float
) -> dict[str, Any]:
    """Write and print the report; metrics.json, returned, has the cases' timings."""
    timed = [
        case | {"timings": {n: t.record() for n, t in case["timings"].items()}}
        for case in cases
    ]
    metrics = {"cases": timed} | circumstances(options, begin)
    write_results(options.out, metrics, text)
    print(text)
    return metrics


def describe() -> str:
    """One line a report begins with: device, cores, load and versions."""
    env = environment()
    packages = ", ".join(f"{name} {v}" for name, v in env["packages"].items())
    return (
        f"{env['processor']}, {env['cores']} cores, {env['devices']} JAX device(s) "
        f"({env['device']}), load {load():.1f}; python {env['python']}, {packages}."
    )

"""Capacities of all searches of a network, and what they turned out to need.

Every search reports its true demand under the name of its capacity, so a caller can
tell which limit to raise. Host-level calls raise it, try again, and say so once.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from ginn_jax.candidates import DENSE_PACKET
from ginn_jax.checks import LARGEST_INDEX
from ginn_jax.errors import InputError
from ginn_jax.process import spare_memory_maps

LOG = logging.getLogger("ginn_jax")
# What each capacity needs: a number, or one for every device.
Demands = dict[str, Int[Any, "..."]]
Made = TypeVar("Made")
# What is made room for beyond what was needed.
SLACK = 1.25
# Calls in room for more than so many times that take a tenth longer and more.
LOOSE = 2.0
# So many probes take less time than compiling them for tighter limits does; what they
# needed at the most, times so much, is seldom exceeded by others.
FEW, AMPLE = 8, 3.0


@dataclass(frozen=True)
class Limits:
    """Named capacities; hashable, so that they can be static under jit."""

    sizes: tuple[tuple[str, int], ...]

    def of(self, name: str) -> int:
        """The capacity called `name`."""
        if (size := dict(self.sizes).get(name)) is None:
            raise InputError(
                f"the limits lack {name}: they are of another network: give those "
                "of this one"
            )
        return size


def fits(limits: Limits, demands: Demands) -> Bool[Array, ""]:
    """Whether every demand is within its limit."""
    return jnp.all(jnp.stack([d <= limits.of(name) for name, d in demands.items()]))


def exceeded(limits: Limits, demands: Demands) -> dict[str, int]:
    """Host: the limits that were too small, and what each should have been."""
    wanted = {name: int(np.max(demand)) for name, demand in demands.items()}
    return {name: need for name, need in wanted.items() if need > limits.of(name)}


def most_exceeded(limits: Limits, demands: Sequence[Demands]) -> dict[str, int]:
    """Host: what at most was needed of each capacity that did not suffice."""
    short: dict[str, int] = {}
    for demand in demands:
        for name, need in exceeded(limits, demand).items():
            short[name] = max(need, short.get(name, 0))
    return short


def with_room(
    limits: Limits,
    attempt: Callable[[Limits], tuple[Made, Sequence[Demands]]],
    measure: Callable[[], Limits] | None = None,
) -> tuple[Made, Limits, Sequence[Demands]]:
    """Host: what `attempt` makes in limits that suffice for its demands, and both.

    Where several searches build on each other, what the later ones say they need means
    little once an earlier one lacked room: a Poisson disk that misses edges keeps too
    many points. `measure` finds limits by what all of them truly need. Every other size
    is another program, and a process has room for so many, see `process`.
    """
    while True:
        made, demands = attempt(limits)
        demands = jax.device_get(demands)
        if not (short := most_exceeded(limits, demands)):
            return made, limits, demands
        spare_memory_maps()
        measured = limits if measure is None else measure()
        limits = widened(limits, measured, short)


def in_fitting_room(
    limits: Limits,
    attempt: Callable[[Limits], tuple[Made, Sequence[Demands]]],
    measure: Callable[[], Limits],
) -> tuple[Made, Limits]:
    """Host: `with_room`, made anew where room was loose: for what is used often."""
    made, sufficed, demands = with_room(limits, attempt, measure)
    if (fit := fitted(sufficed, demands)) != sufficed:
        made, sufficed, _ = with_room(fit, attempt, measure)
    return made, sufficed


def fitted(limits: Limits, demands: Sequence[Demands]) -> Limits:
    """Host: limits that fit these demands with slack, unless the given ones about do.

    Every other size is compiled for anew: worth it to whoever makes the same again, not
    where each scene is another.
    """
    need = most_exceeded(Limits(tuple((n, -1) for n, _ in limits.sizes)), demands)
    snug = dict(limits_for(need, SLACK).sizes)
    if all(limits.of(name) <= LOOSE * size for name, size in snug.items()):
        return limits
    return Limits(tuple((n, min(size, snug.get(n, size))) for n, size in limits.sizes))


def largest(limits: Limits, *others: Limits) -> Limits:
    """Host: limits as large as all, for what may be as large as any."""
    sizes = [dict(other.sizes) for other in others]
    return Limits(
        tuple((n, max(size, *(s.get(n, 0) for s in sizes))) for n, size in limits.sizes)
    )


def only(limits: Limits, conv: str) -> Limits:
    """The limits of one convolution: others must not make it compile again."""
    return Limits(tuple(s for s in limits.sizes if s[0].startswith(f"{conv}.")))


def without(limits: Limits, conv: str) -> Limits:
    """The limits of everything else."""
    return Limits(tuple(s for s in limits.sizes if not s[0].startswith(f"{conv}.")))


def widened(limits: Limits, measured: Limits, short: dict[str, int]) -> Limits:
    """Limits as large as both; where that is nothing new, raised by what was short."""
    wider = largest(limits, measured)
    return raise_limits(limits, short, SLACK) if wider == limits else wider


def say_raised(given: Limits, found: Limits) -> None:
    """Host: one line for a caller whose limits did not suffice, nothing otherwise."""
    old = dict(given.sizes)
    raised = [f"{n} {old[n]} to {size}" for n, size in found.sizes if size > old[n]]
    if raised:
        LOG.warning(
            "raised %s: pass the limits that come back to spare the second attempt",
            ", ".join(raised),
        )


def raise_limits(limits: Limits, demands: dict[str, int], slack: float) -> Limits:
    """Limits that hold each of these demands and `slack` times as much.

    Raises `InputError` for more than arrays can be indexed by; demands stop there.
    """
    sizes = dict(limits.sizes)
    for name, need in demands.items():
        if need * slack >= most_of(name):
            raise InputError(
                f"{name} would need {need} or more: points coincide or crowd within "
                "the radius; merge those, or choose smaller radii"
            )
    for name, need in demands.items():
        sizes[name] = max(sizes[name], round_up(int(need * slack)))
    return Limits(tuple(sizes.items()))


def most_of(name: str) -> int:
    """The largest capacity whose entries can be counted: a word is one a query."""
    return LARGEST_INDEX // (DENSE_PACKET if name.endswith(".words") else 1)


def round_up(count: int) -> int:
    """A capacity with at most 1/8 to spare, so that few shapes are compiled.

    Of what is not needed at all too: arrays of no rows cannot be gathered from.
    """
    count = max(count, 1)
    step = 1 << max(count.bit_length() - 4, 6)
    return -(-count // step) * step


def measure_limits(
    limits: Limits, probe: Callable[[Limits, int], Demands], count: int, slack: float
) -> Limits:
    """Host: limits that hold the demands of `count` probes, with slack."""
    return limits_for(suffices_for(1.0, measure_demands(limits, probe, count)), slack)


def measure_demands(
    limits: Limits, probe: Callable[[Limits, int], Demands], count: int
) -> list[dict[str, int]]:
    """Host: the demands of `count` probes.

    `probe(limits, i)` builds the geometry of example i. `limits` should be generous,
    and name stages in the order in which they build on each other: the first `FEW`
    examples are probed with them, any others with `AMPLE` times what those needed at
    the most. Every time that limits are raised costs a compilation.
    """
    found: list[dict[str, int]] = []
    # Kept, for demands come back from jit sorted by name, and so do limits of them.
    order = [name for name, _ in limits.sizes]
    for i in range(count):
        demands = probe(limits, i)
        while short := exceeded(limits, demands):
            limits = raise_limits(limits, first_stage(short, order), 2.0)
            demands = probe(limits, i)
        found.append({name: int(np.max(demand)) for name, demand in demands.items()})
        if len(found) == FEW < count:
            limits = limits_for(suffices_for(1.0, found), AMPLE)
    return found


def first_stage(short: dict[str, int], order: Sequence[str]) -> dict[str, int]:
    """Those of the first level's search or points that lacked room, or all others.

    What later stages say they need means nothing yet: a Poisson disk that misses edges
    keeps too many points. Searches on levels that are whole do not hang on each other.
    """

    def stage(name: str) -> str:
        if name not in of_levels:
            return "other"
        return name if name.endswith(".points") else name.rpartition(".")[0]

    levels = [i for i, name in enumerate(order) if name.endswith(".points")]
    of_levels = order[: max(levels, default=-1) + 1]
    first = stage(next(name for name in order if name in short))
    return {name: need for name, need in short.items() if stage(name) == first}


def limits_for(demands: dict[str, int], slack: float) -> Limits:
    """Limits of `slack` times each demand."""
    return Limits(
        tuple((name, round_up(int(d * slack))) for name, d in demands.items())
    )


def suffices_for(share: float, demands: Sequence[dict[str, int]]) -> dict[str, int]:
    """What, by each name, holds this share of the demands: all of them at 1."""
    return {
        name: int(np.quantile([d[name] for d in demands], share, method="higher"))
        for name in demands[0]
    }

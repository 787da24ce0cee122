"""Which objects and lights go together, and which are trained or tested on."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np

from ginn_jax.checks import LARGEST_INDEX, LARGEST_SEED, whole
from ginn_jax.errors import InputError
from ginn_jax.objects import LightSource, Source

T = TypeVar("T")


@dataclass(frozen=True)
class Split:
    """How many objects, each under how many lights, to train, validate and test on.

    No object and no light is in two of the three.
    """

    train: tuple[int, int]
    validation: tuple[int, int]
    test: tuple[int, int]
    points: int
    paths: int


# Section "Training Data Generation" of the paper: sizes, points and rays of GI and SSS.
PAPER_SPLIT = Split((1000, 20), (200, 5), (500, 5), 20_000, 4096)


def split_apart(items: Sequence[T], counts: Sequence[int], seed: int) -> list[list[T]]:
    """Disjoint random parts of a list, of so many items each.

    Raises `InputError` where there are too few, or for a negative count or seed.
    """
    whole("seed", seed, 0, LARGEST_SEED)
    counts = [whole("count", count, 0, LARGEST_INDEX) for count in counts]
    if len(items) < sum(counts):
        raise InputError(
            f"a split into {', '.join(map(str, counts))} needs {sum(counts)} objects "
            f"or lights, there are {len(items)}: give more"
        )
    order = np.random.default_rng((seed, 6)).permutation(len(items))
    stops = np.cumsum([0, *counts])
    return [[items[i] for i in sorted(order[a:b])] for a, b in pairwise(stops)]


def spread(items: Sequence[T], count: int) -> list[T]:
    """So many of a list, or all if there are fewer, evenly spread over it."""
    count = min(count, len(items))
    return [items[i * len(items) // count] for i in range(count)]


def pair_up(
    objects: Sequence[Source], lights: Sequence[LightSource], each: int
) -> list[Source]:
    """Every object under `each` of the lights, in turns, so that all are used.

    Raises:
        InputError: fewer lights than that.
    """
    if not lights:
        raise InputError("no lights: give environment maps, or ask for procedural ones")
    each = whole("lights for each object", each, 1, LARGEST_SEED)
    if each > len(lights):
        raise InputError(
            f"{each} lights for each object, there are {len(lights)}: ask for fewer"
        )
    pairs = []
    for i, source in enumerate(objects):
        for k in range(each):
            light = lights[(i * each + k) % len(lights)]
            name = f"{source.name}__{light.name}"
            # Under one light it keeps its seed, as in the runs of the manifest; under
            # several, names tell materials apart, whatever else is paired.
            own = source.path is None and each == 1
            seed = source.seed if own else zlib.crc32(name.encode())
            pairs.append(replace(source, name=name, light=light, seed=seed))
    return pairs


def mixed(
    lights: Sequence[LightSource], maps: Sequence[LightSource], pairs: int, seed: int
) -> list[LightSource]:
    """Lights for so many pairs, those of files among them at random places."""
    whole("seed", seed, 0, LARGEST_SEED)
    if not maps:
        return list(lights)
    both = [*lights[: max(pairs - len(maps), 0)], *maps]
    order = np.random.default_rng((seed, 7)).permutation(len(both))
    return [both[i] for i in order]

"""Shading at a lower rate: joint bilateral upsampling guided by the G-buffer.

Only every so manieth pixel is shaded. A pixel in between takes the mean of the four
shaded ones around it, weighted by how well they lie in its own surface, so no value
crosses an edge of depth or normal. Where none of them does, the pixel has no value and
has to be shaded itself: borders neither darken nor bleed. Which ones those are says the
geometry alone, so they are shaded together with the samples.

Pixels that lie alike between the shaded ones are taken together, as a smaller image:
what is done is then done to whole images side by side, without an index.
"""

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Shaped

from ginn_jax.checks import real_array
from ginn_jax.errors import InputError

SHARPNESS = 8
LEAST_WEIGHT = 0.05
COARSEST = 4

Part = tuple[slice, ...]
Ends = list[tuple[Part, float]]


class Surface(NamedTuple):
    """What guides: position, unit normal and foreground mask of every pixel."""

    position: Float[Any, "H W 3"]
    normal: Float[Any, "H W 3"]
    mask: Bool[Any, "H W"]


class Blend(NamedTuple):
    """How pixels are made of samples around them.

    `weights` are by place between the samples, and there by sample: what it counts for
    each pixel that lies so. `known` are the pixels whose samples count enough.
    """

    weights: tuple[tuple[Float[Any, "_ _"], ...], ...]
    known: Bool[Any, "H W"]


def shading_step(scale: float) -> int:
    """Pixels from one that is shaded to the next, at a scale of 1, 1/2, 1/3 or 1/4.

    Raises:
        InputError: any other scale.
    """
    given = real_array("resolution scale", scale)
    usable = not given.ndim and 0.9 / COARSEST < scale <= 1
    step = round(1 / scale) if usable else 0
    if not (usable and abs(step * scale - 1) < 0.01):
        raise InputError(
            f"resolution scale {scale}: give 1 over a whole number up to {COARSEST}, "
            "as 1, .5 or .333"
        )
    return step


def sampled(size: int, step: int) -> slice:
    """The pixels of a row that are shaded; there is at least one."""
    return slice(min(step // 2, size - 1), size, step)


def blend_between(step: int, surface: Surface, thickness: Float[Array, ""]) -> Blend:
    """What pixels take of those `sampled` at a step.

    `thickness` is how far a sample may lie off a pixel's tangent plane, as a standard
    deviation in units of length.
    """
    shape = surface.mask.shape
    places = tuple(sampled(n, step) for n in shape)
    samples = Surface(*(_beyond_borders(a[places]) for a in surface))
    weights, known = [], []
    for here, around in _alike(step, shape):
        pixels = Surface(*(a[here] for a in surface))
        parts = tuple(
            share * _likeness(pixels, Surface(*(a[there] for a in samples)), thickness)
            for there, share in around
        )
        # Or XLA works them out once more for their sum.
        parts = jax.lax.optimization_barrier(parts)
        weights.append(parts)
        known.append(_enough(sum(parts))[..., None])
    return Blend(tuple(weights), _interleaved(known, step, shape)[..., 0])


def blend(
    values: Float[Array, "h w *C"], step: int, taken: Blend
) -> Float[Array, "H W *C"]:
    """Values of all pixels from those `sampled` at a step; 0 where there is none."""
    shape = taken.known.shape
    lights = values.reshape(*values.shape[:2], -1)
    lights = [_beyond_borders(lights[..., c]) for c in range(lights.shape[2])]
    parts = []
    for (_, around), weights in zip(_alike(step, shape), taken.weights, strict=True):
        total = sum(weights)
        inverse = jnp.where(_enough(total), 1 / jnp.maximum(total, LEAST_WEIGHT), 0.0)
        pairs = list(zip(weights, (there for there, _ in around), strict=True))
        made = [inverse * sum(w * light[i] for w, i in pairs) for light in lights]
        parts.append(jnp.stack(made, -1))
    found = _interleaved(parts, step, shape)
    return found.reshape(*shape, *values.shape[2:])


def _enough(weight: Any) -> Bool[Array, "H W"]:
    """Where samples weigh enough to say what a pixel is."""
    return weight > LEAST_WEIGHT


def _alike(step: int, shape: tuple[int, ...]) -> Iterator[tuple[Part, Ends]]:
    """Pixels that lie alike between their samples, as a part of the image; and those.

    Samples as parts of all `_beyond_borders`, each with its share.
    """
    starts = [sampled(n, step).start for n in shape]
    for place in product(range(step), repeat=2):
        above, left = map(_around, place, starts, (step, step), shape)
        ends = [((i, j), a * b) for i, a in above for j, b in left]
        yield tuple(slice(first, None, step) for first in place), ends


def _around(place: int, start: int, step: int, size: int) -> list[tuple[slice, float]]:
    """The samples before and after the pixels of a row from `place` on, every `step`.

    As slices of the samples `_beyond_borders`, each with its share; none without one.
    """
    count = len(range(place, size, step))
    first, share = divmod(place - start, step)
    ends = [(first + 1, 1 - share / step), (first + 2, share / step)]
    return [(slice(i, i + count), part) for i, part in ends if part]


def _beyond_borders(samples: Shaped[Array, "h w *C"]) -> Shaped[Array, "n m *C"]:
    """Samples with those at the border again beyond it."""
    around = ((1, 1), (1, 1)) + ((0, 0),) * (samples.ndim - 2)
    # By itself, or it is done anew for every pixel that looks.
    return jax.lax.optimization_barrier(jnp.pad(samples, around, mode="edge"))


def _interleaved(
    parts: Sequence[Shaped[Array, "..."]], step: int, shape: tuple[int, ...]
) -> Shaped[Array, "H W C"]:
    """One image of those of which each has every so manieth pixel."""
    high, wide = (-(-n // step) for n in shape)
    filled = [
        jnp.pad(a, ((0, high - a.shape[0]), (0, wide - a.shape[1]), (0, 0)))
        for a in parts
    ]
    grid = jnp.stack(filled).reshape(step, step, high, wide, -1)
    image = jax.lax.optimization_barrier(grid).transpose(2, 0, 3, 1, 4)
    image = image.reshape(high * step, wide * step, -1)
    return image[: shape[0], : shape[1]]


def _likeness(
    here: Surface, there: Surface, thickness: Float[Array, ""]
) -> Float[Array, "H W"]:
    """1 for a sample in the pixel's own tangent plane, near 0 for another surface."""
    off_plane = turned = jnp.float32(0)
    for axis in range(3):
        offset = there.position[..., axis] - here.position[..., axis]
        off_plane += offset * here.normal[..., axis]
        turned += there.normal[..., axis] * here.normal[..., axis]
    likeness = jnp.exp(-0.5 * (off_plane / thickness) ** 2)
    likeness *= jnp.maximum(turned, 0.0) ** SHARPNESS
    return jnp.where(there.mask & here.mask, likeness, 0.0)

"""Shading at a lower rate: joint bilateral upsampling guided by the G-buffer.

Only every so manieth pixel is shaded. A pixel in between takes the mean of the four
shaded ones around it, weighted by how well they lie in its own surface, so no value
crosses an edge of depth or normal. Where none of them does, the pixel has no value and
has to be shaded itself: borders neither darken nor bleed.

Pixels that lie alike between the shaded ones are taken together, as a smaller image:
what is done is then done to whole images side by side, without an index.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Shaped

from ginn_jax.errors import InputError

SHARPNESS = 8
LEAST_WEIGHT = 0.05
COARSEST = 4

Ends = list[tuple[slice, float]]


class Surface(NamedTuple):
    """What guides: position, unit normal and foreground mask of every pixel."""

    position: Float[Any, "H W 3"]
    normal: Float[Any, "H W 3"]
    mask: Bool[Any, "H W"]


def shading_step(scale: float) -> int:
    """Pixels from one that is shaded to the next, at a scale of 1, 1/2, 1/3 or 1/4.

    Raises:
        InputError: any other scale.
    """
    step = round(1 / scale) if 0.9 / COARSEST < scale <= 1 else 0
    if not abs(step * scale - 1) < 0.01:
        raise InputError(
            f"resolution scale {scale}: give 1 over a whole number up to {COARSEST}, "
            "as 1, .5 or .333"
        )
    return step


def sampled(size: int, step: int) -> slice:
    """The pixels of a row that are shaded; there is at least one."""
    return slice(min(step // 2, size - 1), size, step)


def upsample(
    values: Float[Array, "h w *C"],
    step: int,
    surface: Surface,
    thickness: Float[Array, ""],
) -> tuple[Float[Array, "H W *C"], Bool[Array, "H W"]]:
    """Values of all pixels from those `sampled` at a step, and which have one.

    `thickness` is how far a sample may lie off a pixel's tangent plane, as a standard
    deviation in units of length. Values where there is none are 0.
    """
    shape = surface.mask.shape
    places = tuple(sampled(n, step) for n in shape)
    samples = Surface(*(_beyond_borders(a[places]) for a in surface))
    lights = values.reshape(*values.shape[:2], -1)
    lights = [_beyond_borders(lights[..., c]) for c in range(lights.shape[2])]
    parts = []
    for row in range(step):
        for column in range(step):
            here = Surface(*(a[row::step, column::step] for a in surface))
            above = _around(row, places[0].start, step, shape[0])
            left = _around(column, places[1].start, step, shape[1])
            parts.append(_between(here, samples, lights, above, left, thickness))
    found, known = (_interleaved(p, step, shape) for p in zip(*parts, strict=True))
    return found.reshape(*shape, *values.shape[2:]), known[..., 0]


def _around(place: int, start: int, step: int, size: int) -> Ends:
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


def _between(
    here: Surface,
    samples: Surface,
    lights: list[Float[Array, "n m"]],
    above: Ends,
    left: Ends,
    thickness: Float[Array, ""],
) -> tuple[Float[Array, "H W C"], Bool[Array, "H W 1"]]:
    """Values of pixels that all lie alike between their samples."""
    total, weight = [jnp.float32(0)] * len(lights), jnp.float32(0)
    for rows, share_i in above:
        for columns, share_j in left:
            there = Surface(*(a[rows, columns] for a in samples))
            like = share_i * share_j * _likeness(here, there, thickness)
            pairs = zip(total, lights, strict=True)
            total = [t + like * light[rows, columns] for t, light in pairs]
            weight += like
    known = here.mask & (weight > LEAST_WEIGHT)
    inverse = jnp.where(known, 1 / jnp.where(known, weight, 1.0), 0.0)
    return jnp.stack([t * inverse for t in total], axis=-1), known[..., None]


def _interleaved(
    parts: tuple[Shaped[Array, "..."], ...], step: int, shape: tuple[int, int]
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

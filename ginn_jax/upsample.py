"""Shading at a lower rate: joint bilateral upsampling guided by the G-buffer.

Only every so manieth pixel is shaded. A pixel in between takes the mean of the four
shaded ones around it, weighted by how well they lie in its own surface, so no value
crosses an edge of depth or normal. Where none of them does, the pixel has no value and
has to be shaded itself: borders neither darken nor bleed.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

SHARPNESS = 8
LEAST_WEIGHT = 0.05


class Surface(NamedTuple):
    """What guides: position, unit normal and foreground mask of every pixel."""

    position: Float[Any, "H W 3"]
    normal: Float[Any, "H W 3"]
    mask: Bool[Any, "H W"]


def sample_pixels(size: int, scale: float) -> Int[np.ndarray, "S"]:
    """The pixels of a row that are shaded at a resolution scale in (0, 1]."""
    count = max(round(size * scale), 1)
    return ((np.arange(count) + 0.5) * size / count).astype(np.int32)


def upsample(
    values: Float[Array, "h w *C"],
    rows: Int[Array, "h"],
    columns: Int[Array, "w"],
    surface: Surface,
    thickness: Float[Array, ""],
) -> tuple[Float[Array, "H W *C"], Bool[Array, "H W"]]:
    """Values of all pixels from those at `rows` x `columns`, and which have one.

    `thickness` is how far a sample may lie off a pixel's tangent plane, as a standard
    deviation in units of length. Values where there is none are 0.
    """
    height, width = surface.mask.shape
    above, down = _between(rows, height)
    left, right = _between(columns, width)
    channels = tuple(range(2, values.ndim))
    total = jnp.zeros((height, width, *values.shape[2:]))
    weight = jnp.zeros((height, width))
    for j, share_j in ((left, 1 - right), (left + 1, right)):
        j = jnp.clip(j, 0, columns.size - 1)
        column = jax.tree.map(lambda a: a[rows][:, columns[j]], surface)  # noqa: B023
        # Columns first and once: they cost much more than the rows, which are whole.
        column = jax.lax.optimization_barrier((*column, values[:, j]))
        for i, share_i in ((above, 1 - down), (above + 1, down)):
            i = jnp.clip(i, 0, rows.size - 1)
            *there, value = (a[i] for a in column)
            share = _likeness(surface, Surface(*there), thickness)
            share = share * share_i[:, None] * share_j
            total += jnp.expand_dims(share, channels) * value
            weight += share
    known = surface.mask & (weight > LEAST_WEIGHT)
    inverse = jnp.where(known, 1 / jnp.where(known, weight, 1.0), 0.0)
    return total * jnp.expand_dims(inverse, channels), known


def _between(
    samples: Int[Array, "s"], size: int
) -> tuple[Int[Array, "S"], Float[Array, "S"]]:
    """The last sample before every pixel (-1: none), and how far on it is."""
    pixel = jnp.arange(size)
    before = jnp.searchsorted(samples, pixel, side="right").astype(jnp.int32) - 1
    start = samples[jnp.maximum(before, 0)]
    stop = samples[jnp.minimum(before + 1, samples.size - 1)]
    share = (pixel - start) / jnp.maximum(stop - start, 1)
    return before, jnp.clip(share, 0.0, 1.0)


def _likeness(
    here: Surface, there: Surface, thickness: Float[Array, ""]
) -> Float[Array, "H W"]:
    """1 for a sample in the pixel's own tangent plane, near 0 for another surface."""
    offset = there.position - here.position
    off_plane = jnp.sum(offset * here.normal, axis=-1) / thickness
    turned = jnp.maximum(jnp.sum(here.normal * there.normal, axis=-1), 0.0)
    likeness = jnp.exp(-0.5 * off_plane**2) * turned**SHARPNESS
    return jnp.where(there.mask & here.mask, likeness, 0.0)

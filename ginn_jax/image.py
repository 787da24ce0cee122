"""From a G-buffer to an image: f_2D at the pixels in sight, or at some of them.

A pixel is a point: points are shaded, in an order that keeps neighbours together.
"""

from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ginn_jax.architecture import Network
from ginn_jax.block_shading import shade_blocks
from ginn_jax.checks import LARGEST, number
from ginn_jax.dataset import relative_to
from ginn_jax.errors import InputError
from ginn_jax.example import numbers_asked
from ginn_jax.given import check_queries
from ginn_jax.lane_shading import lanes_for, shade_in_lanes
from ginn_jax.limits import Limits
from ginn_jax.network import Variables
from ginn_jax.process import on_cpu
from ginn_jax.searches import check_limits, warn_of_gaps
from ginn_jax.shading import Encoded
from ginn_jax.upsample import (
    Surface,
    blend,
    blend_between,
    sampled,
    shading_step,
)

# Cells of space that pixels are sorted into, in radii of f_2D.
COARSE = 4.0

_blend_between = jax.jit(blend_between, static_argnums=0)
_blend = jax.jit(blend, static_argnums=1)


@lru_cache(maxsize=8)
def pixel_order(height: int, width: int) -> Int[np.ndarray, "P"]:
    """All pixels of an image along a Morton curve: neighbours come together."""
    row, column = np.mgrid[:height, :width]
    code = np.zeros((height, width), np.int64)
    for bit in range(max(height, width).bit_length()):
        code |= ((column >> bit) & 1) << (2 * bit) | ((row >> bit) & 1) << (2 * bit + 1)
    return np.argsort(code, axis=None)


def pixels_in_rows(mask: Bool[np.ndarray, "H W"]) -> Int[np.ndarray, "M"]:
    """The pixels in `mask`, neighbours in the image together."""
    order = pixel_order(*mask.shape)
    return order[mask.reshape(-1)[order]]


def coherent_pixels(
    position: Float[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"],
    cell: float,
    center: Float[Any, "3"] | None = None,
) -> Int[np.ndarray, "M"]:
    """The pixels in `mask`, neighbours in the image and in space together.

    Along a curve of the image within cells of space that wide, counted from `center`,
    which keeps apart what only the image has side by side; of 32 cells each way, for
    then they begin anew. Sorting 16 bits takes NumPy a pass or two.
    """
    rows = pixels_in_rows(mask)
    place = np.asarray(position).reshape(-1, 3).take(rows, axis=0)
    origin = (0.0,) * 3 if center is None else map(float, center)
    code = np.zeros(len(rows), np.int32)
    with np.errstate(invalid="ignore", over="ignore"):
        for along, start in zip(place.T, origin, strict=True):
            code = code << 5 | ((along - start) / cell).astype(np.int32) & 31
    return rows[np.argsort(code.astype(np.uint16), kind="stable")]


def pixels_in_order(
    network: Network,
    center: Float[Any, "3"] | None,
    surface: Surface,
    numbers: tuple[Float[np.ndarray, "C H W _"] | None, ...],
) -> tuple[Int[np.ndarray, "M"], tuple[Any, ...], bool]:
    """The pixels in the mask in the order that f_2D takes them in, their position,
    normal and `numbers` (material and light), and whether neighbours come together.

    A GPU sorts them in less time than they take to get there.
    """
    position, normal, mask = surface
    if coherent := on_cpu():
        cell = COARSE * network.query.radius
        rows = coherent_pixels(position, mask, cell, center)
    else:
        rows = np.flatnonzero(mask)
    # `take` is three times as fast here as an index.
    ends = (np.reshape(a, (-1, 3)).take(rows, axis=0) for a in (position, normal))
    numbers = tuple(
        a if a is None else np.reshape(a, (len(a), mask.size, -1)).take(rows, 1)
        for a in numbers
    )
    return rows, (*ends, *numbers), coherent


def shade_image(
    network: Network,
    limits: Limits,
    variables: Variables,
    encoded: Encoded,
    position: Float[np.ndarray, "H W 3"],
    normal: Float[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"],
    background: float = 1.0,
    resolution_scale: float = 1.0,
    material: Float[np.ndarray, "C H W A"] | None = None,
    light: Float[np.ndarray, "C H W L"] | None = None,
) -> tuple[Float[np.ndarray, "H W *C"], Limits]:
    """An image; only the pixels in `mask` are computed. With light, one a channel.

    At a `resolution_scale` of 1/2, 1/3 or 1/4 fewer are: the others are interpolated
    inside their own surface, or computed as well where that is not possible (see
    `upsample`).

    Raises:
        InputError: another resolution scale, arrays of unequal size, a mask that is not
            of bool, or what `shade_points` refuses.
    """
    check_limits(network, limits)
    check_image(position, normal, mask, background)
    step = shading_step(resolution_scale)
    surface = Surface(*map(np.asarray, (position, normal, mask)))
    numbers = numbers_asked(network, material, light)
    for name, given in zip(("material", "light"), numbers, strict=True):
        if given is not None and np.shape(given)[1:-1] != surface.mask.shape:
            raise InputError(
                f"{name} {np.shape(given)} does not fit the mask {surface.mask.shape}: "
                "give [C H W numbers]"
            )
    if not surface.mask.size:
        channels = () if encoded.scale is None else np.shape(encoded.scale)
        return np.zeros((*surface.mask.shape, *channels), np.float32), limits
    shade = partial(_shade_pixels, network, limits, variables, encoded, background)
    if step == 1:
        return shade(surface, numbers)
    thickness = np.float32(0.2 * network.query.radius)
    near = surface
    if surface.position.dtype != np.float32:
        # Only differences count: in single precision no other origin betters them.
        near = surface._replace(position=counted_from(encoded.center, surface.position))
    taken = _blend_between(step, near, thickness)
    places = tuple(sampled(n, step) for n in surface.mask.shape)
    between = np.array(taken.known)
    between[places] = False
    values, sufficed = shade(surface._replace(mask=surface.mask & ~between), numbers)
    blended = np.asarray(_blend(values[places], step, taken))
    where = between.reshape(between.shape + (1,) * (values.ndim - 2))
    np.copyto(values, blended, where=where)
    return values, sufficed


def _shade_pixels(
    network: Network,
    limits: Limits,
    variables: Variables,
    encoded: Encoded,
    background: float,
    surface: Surface,
    numbers: tuple[Float[np.ndarray, "C H W _"] | None, ...],
) -> tuple[Float[np.ndarray, "H W *C"], Limits]:
    """Values of the pixels in the mask; `numbers`: material and light."""
    mask = surface.mask
    if lanes_for(network):
        rows = pixels_in_rows(mask)
        found = _shade_rows(network, variables, encoded, surface, numbers, rows)
    else:
        ends = network, encoded.center, surface, numbers
        rows, pixels, coherent = pixels_in_order(*ends)
        check_queries(network, variables, encoded, *pixels)
        given: tuple[Any, ...] = encoded, *pixels, coherent
        found, limits = shade_blocks(network, limits, variables, *given)
    values = np.full((mask.size, *found.shape[1:]), background, np.float32)
    values[rows] = within_range(encoded, found)
    return values.reshape(*mask.shape, *found.shape[1:]), limits


def _shade_rows(
    network: Network,
    variables: Variables,
    encoded: Encoded,
    surface: Surface,
    numbers: tuple[Float[np.ndarray, "C H W _"] | None, ...],
    rows: Int[np.ndarray, "M"],
) -> Float[np.ndarray, "M *C"]:
    """Values of those pixels, in lanes, which read them where they are."""
    ends: list[Any] = [np.reshape(a, (-1, 3)) for a in surface[:2]]
    ends += [
        a if a is None else np.reshape(a, (len(a), surface.mask.size, -1))
        for a in numbers
    ]

    def check(rows: Int[np.ndarray, "M"]) -> None:
        taken: list[Any] = [None if a is None else a.take(rows, -2) for a in ends]
        check_queries(network, variables, encoded, *taken)

    try:
        check(rows[:0])  # types and shapes
    except InputError:
        check(rows)  # says how many
        raise
    shaded = shade_in_lanes(network, variables, encoded, *ends, rows=rows)
    if shaded.doubtful:
        check(rows)
    warn_of_gaps(network.query, shaded.pairs, len(rows))
    return shaded.values


def counted_from(
    center: Float[Any, "3"] | None, position: Float[np.ndarray, "H W 3"]
) -> Float[np.ndarray, "H W 3"]:
    """`relative_to` of an image, whose background may be anything."""
    with np.errstate(invalid="ignore", over="ignore"):
        return relative_to(center, position)


def check_image(position: Any, normal: Any, mask: Any, background: float) -> None:
    """Raise `InputError` for what is no G-buffer, or no background for one."""
    mask = np.asarray(mask)
    if mask.dtype != bool or mask.ndim != 2:
        raise InputError(f"mask is {mask.dtype} {mask.shape}: give bool [H W]")
    number("background", background, -LARGEST)
    if not np.shape(position) == np.shape(normal) == (*mask.shape, 3):
        raise InputError(
            f"position {np.shape(position)} and normal {np.shape(normal)} do not fit "
            f"the mask {mask.shape}: give [H W 3]"
        )


def within_range(
    encoded: Encoded, values: Float[np.ndarray, "*P"]
) -> Float[np.ndarray, "*P"]:
    """Output as what it can be: openness in [0, 1], or light, which is not negative."""
    return as_openness(values) if encoded.scale is None else np.maximum(values, 0.0)


def as_openness(values: Float[np.ndarray, "*P"]) -> Float[np.ndarray, "*P"]:
    """Network output as openness: it can be nothing outside [0, 1]."""
    return np.clip(values, 0.0, 1.0)

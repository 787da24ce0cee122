"""Ambient occlusion from what is on the screen alone: the usual way, and today's.

Both take a G-buffer and give openness; both miss what the camera does not see. Their
thickness and bias were tuned on 5 procedural shapes (seeds 0 to 4, 256 pixels, radius
.1) against ray-traced openness; infinitely thick, both are worse than a constant.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ginn_jax.camera import Camera
from ginn_jax.checks import number, positive
from ginn_jax.screen import (
    Screen,
    check_above_zero,
    check_counts,
    check_pairs,
    dot,
    enter_screen,
    inverse_depths,
    look_up,
)
from ginn_jax.screen_sectors import Sweep, look_round

PATTERN = 4
GOLDEN = (5**0.5 - 1) / 2


def ambient_occlusion(
    position: Float[Any, "H W 3"],
    normal: Float[Any, "H W 3"],
    mask: Bool[Any, "H W"],
    camera: Camera,
    radius: float,
    *,
    directions: int = 16,
    steps: int = 32,
    thickness: float = 0.05,
    bias: float = 0.01,
) -> Float[Array, "H W"]:
    """Openness by depth tests along rays, as in the paper (after Mittring 2007).

    Each pixel marches `directions` cosine-distributed rays to the `radius` in `steps`;
    a ray is blocked where the depth buffer lies up to `thickness` before it. The rays
    turn in a pattern of 4 x 4 pixels, over which openness is averaged within a surface.
    Lengths are in units of length, `bias` in radii; background is open (1).
    """
    check_counts(directions=directions, steps=steps)
    check_above_zero(thickness=thickness)
    radius, bias = positive("radius", radius), number("bias", bias, 0.0)
    screen = enter_screen(position, normal, mask, camera)
    table = inverse_depths(screen)
    turns = jnp.array(rotation_pattern(screen.mask.shape))
    side, up = _tangents(screen.normal)
    start = screen.position + (bias * radius) * screen.normal

    def cast(number: Array, still_open: Array) -> Array:
        local = _local_direction(number, directions, turns)
        ray = local[0] * side + local[1] * up + local[2] * screen.normal
        ray = radius * ray

        def step(k: Array, blocked: Array) -> Array:
            share = (k.astype(jnp.float32) + 0.5) / steps
            return blocked | _hidden(screen, table, start + share * ray, thickness)

        blocked = lax.fori_loop(0, steps, step, jnp.zeros_like(screen.mask))
        return still_open + jnp.where(blocked, 0.0, 1.0)

    total = lax.fori_loop(0, directions, cast, jnp.zeros(screen.mask.shape))
    smooth = smooth_pattern(screen, total / directions, radius)
    return jnp.where(screen.mask, smooth, 1.0)


def bitmask_occlusion(
    position: Float[Any, "H W 3"],
    normal: Float[Any, "H W 3"],
    mask: Bool[Any, "H W"],
    camera: Camera,
    radius: float,
    *,
    directions: int = 16,
    steps: int = 32,
    thickness: float = 0.05,
) -> Float[Array, "H W"]:
    """Openness by bitmasks of sectors (Therrien et al. 2023), cosine-weighted.

    Two `directions` are one slice; each marches `steps` pixels up to the `radius`. What
    is seen is a slab, `thickness` deep along the view; infinite gives the horizons of
    Jimenez et al. 2016. Lengths are in units of length; background is open (1).
    """
    check_counts(directions=directions, steps=steps)
    check_above_zero(thickness=thickness)
    radius = positive("radius", radius)
    check_pairs(directions)
    screen = enter_screen(position, normal, mask, camera)
    sweep = Sweep(radius, thickness, directions // 2, steps, 1.0, 0.0, joined=False)
    return jnp.where(screen.mask, look_round(screen, sweep)[0], 1.0)


def rotation_pattern(shape: tuple[int, ...]) -> Float[np.ndarray, "H W"]:
    """Turns in [0, 1), all sixteenths once in every 4 x 4 pixels, neighbours far."""
    i, j = np.indices(shape) % PATTERN
    bayer = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]])
    return (bayer[i, j] / PATTERN**2).astype(np.float32)


def _local_direction(
    number: Array, count: int, turns: Float[Array, "H W"]
) -> tuple[Array, Array, Array]:
    """The cosine-distributed ray of a number, on a spiral that every pixel turns."""
    step = number.astype(jnp.float32)
    square = (step + (turns * 7 + 0.5 / PATTERN**2) % 1) / count
    angle = 2 * np.pi * (step * GOLDEN + turns)
    flat = jnp.sqrt(square)
    whole = (flat * jnp.cos(angle), flat * jnp.sin(angle), jnp.sqrt(1 - square))
    x, y, z = (a[..., None] for a in whole)
    return x, y, z


def _tangents(
    normal: Float[Array, "H W 3"],
) -> tuple[Float[Array, "H W 3"], Float[Array, "H W 3"]]:
    """Two unit vectors at right angles to each normal (Duff et al. 2017)."""
    x, y, z = jnp.moveaxis(normal, -1, 0)
    sign = jnp.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    side = jnp.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    return side, jnp.stack([b, sign + y * y * a, -y], axis=-1)


def _hidden(
    screen: Screen,
    table: Float[Array, "P 3"],
    point: Float[Array, "H W 3"],
    thickness: float,
) -> Bool[Array, "H W"]:
    """Whether a point is behind what is seen there, by no more than a thickness."""
    height, width = screen.mask.shape
    x, y, z = jnp.moveaxis(point, -1, 0)
    depth = jnp.maximum(z, 1e-6)
    column = x / depth * screen.focal + (width - 1) / 2
    row = y / depth * screen.focal + (height - 1) / 2
    nearness, _, _ = look_up(table, column, row)
    seen = 1 / jnp.maximum(nearness, 1e-9)
    return (z > 1e-6) & (seen < z) & (z < seen + thickness)


def smooth_pattern(
    screen: Screen, values: Float[Array, "H W"], thickness: float
) -> Float[Array, "H W"]:
    """Means over 4 x 4 pixels, of those in a pixel's own surface."""
    shape = screen.mask.shape
    around = ((PATTERN // 2, PATTERN // 2), (PATTERN // 2, PATTERN // 2))
    position, normal = (
        jnp.pad(a, (*around, (0, 0))) for a in (screen.position, screen.normal)
    )
    mask, padded = jnp.pad(screen.mask, around), jnp.pad(values, around)
    total, weight = jnp.zeros(shape), jnp.zeros(shape)
    for i in range(PATTERN):
        for j in range(PATTERN):
            there = slice(i, i + shape[0]), slice(j, j + shape[1])
            offset = position[there] - screen.position
            off_plane = dot(offset, screen.normal) / (0.1 * thickness)
            like = jnp.maximum(dot(normal[there], screen.normal), 0.0) ** 8
            share = jnp.where(mask[there], like * jnp.exp(-(off_plane**2)), 0.0)
            total, weight = total + share * padded[there], weight + share
    return total / jnp.maximum(weight, 1e-12)

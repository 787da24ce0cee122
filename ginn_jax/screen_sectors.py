"""What a pixel sees round itself on the screen, by slices and sectors.

Every pixel marched over, as a slab of a given thickness, takes the sectors of the slice
that it covers and that nothing nearer has taken, one bit each: Therrien, Levesque and
Gilet, "Screen Space Indirect Lighting with Visibility Bitmask" (2023). Other than
there, a slab is cut to the sphere of the radius before its angles are taken, and
sectors are even in cosine-weighted solid angle, not in angle.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, UInt

from ginn_jax.screen import (
    Screen,
    dot,
    framed,
    gradient_noise,
    inverse_depths,
    look_up,
    pixel_places,
)
from ginn_jax.screen_slices import (
    SECTORS,
    Slice,
    bits_below,
    cut_slice,
    sector,
    view_ray,
)


class Sweep(NamedTuple):
    """How a pixel looks round: all lengths in units of length, all static.

    radius      how far it sees
    thickness   how far behind what is seen a slab reaches, along the depth
    slices      directions of the image, each marched to both sides
    steps       pixels marched over to each side
    crowding    exponent of the steps' distances: above 1, nearer ones are denser
    back        share of its exitance that a sender shows from behind
    joined      whether what is seen goes on in its plane from step to step
    """

    radius: float
    thickness: float
    slices: int
    steps: int
    crowding: float
    back: float
    joined: bool


def look_round(
    screen: Screen, sweep: Sweep, exitance: Float[Array, "H W 3"] | None = None
) -> tuple[Float[Array, "H W"], Float[Array, "H W 3"]]:
    """Openness of every pixel, and the irradiance that its surroundings send it.

    `exitance` is what each pixel's surface sends out, to its front alone; without it
    the irradiance is 0.
    """
    depths = inverse_depths(screen)
    colors = None if exitance is None else _senders(screen, exitance)
    noise = jnp.array(gradient_noise(screen.mask.shape))

    def add(number: Array, sums: tuple[Array, ...]) -> tuple[Array, ...]:
        angle = (number.astype(jnp.float32) + noise) * (np.pi / sweep.slices)
        part = cut_slice(screen, angle)
        covered, arrived = _march(screen, sweep, part, depths, colors)
        share = part.weight * lax.population_count(~covered).astype(jnp.float32)
        return (
            sums[0] + share / SECTORS,
            sums[1] + part.weight[..., None] * arrived / SECTORS,
            sums[2] + part.weight,
        )

    zero = jnp.zeros(screen.mask.shape)
    start = (zero, jnp.zeros_like(screen.position), zero)
    still_open, arrived, whole = lax.fori_loop(0, sweep.slices, add, start)
    whole = jnp.maximum(whole, 1e-12)
    return still_open / whole, arrived / whole[..., None]


def _senders(screen: Screen, exitance: Float[Array, "H W 3"]) -> Float[Array, "P 6"]:
    lit = jnp.where(screen.mask[..., None], exitance, 0.0)
    return framed(jnp.concatenate([lit, screen.normal], axis=-1))


def _march(
    screen: Screen,
    sweep: Sweep,
    part: Slice,
    depths: Float[Array, "P 3"],
    colors: Float[Array, "P 6"] | None,
) -> tuple[UInt[Array, "H W"], Float[Array, "H W 3"]]:
    """The sectors that are covered, and the exitance seen, each sector once."""
    columns, rows = (jnp.array(a) for a in pixel_places(screen.mask.shape))
    reach = _reach(screen, sweep.radius)
    jitter = jnp.array(gradient_noise(screen.mask.shape[::-1]).T)

    def step(number: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        covered, arrived = state
        side = (1 - 2 * (number % 2)).astype(jnp.float32)
        shares = [(number // 2).astype(jnp.float32) + x for x in (jitter, 0.0, 1.0)]
        away = [
            side * (0.5 + reach * (share / sweep.steps) ** sweep.crowding)
            for share in shares
        ]
        column = columns + away[0] * part.direction[..., 0]
        row = rows + away[0] * part.direction[..., 1]
        nearness, slope, place = look_up(depths, column, row)
        change = dot(slope, part.direction)
        patch = [(a / screen.focal, nearness + (a - away[0]) * change) for a in away]
        taken = _cover(part, sweep, patch, side)
        if colors is not None:
            ray = screen.rays + patch[0][0][..., None] * part.direction
            seen = _seen(screen, ray, nearness, colors[place], sweep.back)
            fresh = lax.population_count(taken & ~covered).astype(jnp.float32)
            arrived += fresh[..., None] * seen
        return covered | taken, arrived

    nothing = jnp.zeros(screen.mask.shape, jnp.uint32)
    start = (nothing, jnp.zeros_like(screen.position))
    return lax.fori_loop(0, 2 * sweep.steps, step, start)


def _reach(screen: Screen, radius: float) -> Float[Array, "H W"]:
    """Pixels that the radius measures at each pixel's depth: at most the whole image.

    Nearest to the eye a sphere looks largest; half a radius nearer is a fair mean.
    """
    height, width = screen.mask.shape
    depth = screen.position[..., 2]
    near = jnp.maximum(depth - 0.5 * radius, 0.5 * depth)
    return jnp.minimum(radius * screen.focal / near, float(max(height, width)))


def _cover(
    part: Slice,
    sweep: Sweep,
    patch: list[tuple[Float[Array, "H W"], Float[Array, "H W"]]],
    side: Float[Array, ""],
) -> UInt[Array, "H W"]:
    """Sectors that a patch covers: what is looked up, where its step starts and ends.

    Each is given by how far out it is on the screen (at depth 1) and its 1 / z. The
    first is a slab, of which counts what is within the radius. Joined to its step's
    ends it lets no light through between two far steps; where steps are a pixel apart
    it would only make outlines thicker.
    """
    (out, nearness), *ends = patch if sweep.joined else patch[:1]
    first, last = _within(part, sweep, out, nearness)
    depths = [1 / jnp.maximum(w, 1e-6) for _, w in ends]
    sectors = [sector(part, out, z, side) for z in (first, last)]
    sectors += [
        sector(part, a, z, side) for (a, _), z in zip(ends, depths, strict=True)
    ]
    low = functools.reduce(jnp.minimum, sectors)
    high = functools.reduce(jnp.maximum, sectors)
    met = (nearness > 0) & (first < last)
    return jnp.where(met, bits_below(high) & ~bits_below(low), jnp.uint32(0))


def _within(
    part: Slice,
    sweep: Sweep,
    out: Float[Array, "H W"],
    nearness: Float[Array, "H W"],
) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    """From which to which depth a slab is within the radius; the other way round: no.

    A point at depth t lies at (distance + t up, t aside) from the pixel, in the
    slice's plane; where that is within the radius is an interval of t.
    """
    up, aside = view_ray(part, out)
    square = up**2 + aside**2
    middle = -part.distance * up / square
    inside = middle**2 - (part.distance**2 - sweep.radius**2) / square
    half = jnp.sqrt(jnp.maximum(inside, 0.0))
    depth = 1 / jnp.maximum(nearness, 1e-9)
    first = jnp.maximum(depth, middle - half)
    return first, jnp.minimum(depth + sweep.thickness, middle + half)


def _seen(
    screen: Screen,
    ray: Float[Array, "H W 3"],
    nearness: Float[Array, "H W"],
    sender: Float[Array, "H W 6"],
    back: float,
) -> Float[Array, "H W 3"]:
    """Exitance of the senders that turn their front to the pixel, and a share else."""
    there = ray / jnp.maximum(nearness, 1e-9)[..., None]
    toward = dot(sender[..., 3:], screen.position - there)
    return sender[..., :3] * jnp.where(toward > 0, 1.0, back)[..., None]

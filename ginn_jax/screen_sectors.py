"""What a pixel sees round itself on the screen, by slices and sectors.

A slice is the half plane pair through the eye and the pixel along one direction of the
image. Its hemisphere is cut into 32 sectors of equal cosine-weighted solid angle, one
bit each; every pixel marched over, as a slab of a given thickness, takes the sectors
that it covers and that nothing nearer has taken. After Therrien, Levesque and Gilet,
"Screen Space Indirect Lighting with Visibility Bitmask" (2023), in the cosine-weighted
slices of Jimenez et al., "Practical Realtime Strategies for Accurate Indirect
Occlusion" (2016). Other than there, a slab is cut to the sphere of the radius before
its angles are taken, and sectors are even in weight, not in angle.
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

SECTORS = 32


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


class Slice(NamedTuple):
    """One slice of every pixel, and its plane by two axes: to the eye, and across.

    direction   unit vector on the screen, (column, row, 0)
    along       its components to the eye and across
    distance    of the pixel from the eye
    length      of the ray to it, at depth 1
    facing      cosine and sine of the normal's angle in the plane, from the eye's
    before      share of the slice's weight that lies on the side against `direction`
    whole       the slice's weight for a normal in its plane: |sin t| cos(t - angle)
    weight      the same for the pixel's normal: its share of all slices
    """

    direction: Float[Array, "H W 3"]
    along: tuple[Float[Array, "H W"], Float[Array, "H W"]]
    distance: Float[Array, "H W"]
    length: Float[Array, "H W"]
    facing: tuple[Float[Array, "H W"], Float[Array, "H W"]]
    before: Float[Array, "H W"]
    whole: Float[Array, "H W"]
    weight: Float[Array, "H W"]


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


def cut_slice(screen: Screen, angle: Float[Array, "H W"]) -> Slice:
    """The slice of every pixel along a direction of the image."""
    flat = jnp.zeros_like(angle)
    direction = jnp.stack([jnp.cos(angle), jnp.sin(angle), flat], axis=-1)
    eye = -_unit(screen.position)
    across = _unit(direction - dot(direction, eye)[..., None] * eye)
    up, side = dot(screen.normal, eye), dot(screen.normal, across)
    tilt = jnp.clip(jnp.arctan2(side, up), -np.pi / 2, np.pi / 2)
    cos, sin = jnp.cos(tilt), jnp.sin(tilt)
    whole = cos + tilt * sin
    return Slice(
        direction,
        along=(dot(direction, eye), dot(direction, across)),
        distance=-dot(screen.position, eye),
        length=-dot(screen.rays, eye),
        facing=(cos, sin),
        before=0.5 - np.pi / 4 * sin / whole,
        whole=whole,
        weight=jnp.hypot(up, side) * whole,
    )


def _unit(vector: Float[Array, "H W 3"]) -> Float[Array, "H W 3"]:
    return vector * lax.rsqrt(jnp.maximum(dot(vector, vector), 1e-20))[..., None]


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
    sectors = [_sector(part, out, z, side) for z in (first, last)]
    sectors += [
        _sector(part, a, z, side) for (a, _), z in zip(ends, depths, strict=True)
    ]
    low = functools.reduce(jnp.minimum, sectors)
    high = functools.reduce(jnp.maximum, sectors)
    met = (nearness > 0) & (first < last)
    return jnp.where(met, _bits_below(high) & ~_bits_below(low), jnp.uint32(0))


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
    up, aside = _view_ray(part, out)
    square = up**2 + aside**2
    middle = -part.distance * up / square
    inside = middle**2 - (part.distance**2 - sweep.radius**2) / square
    half = jnp.sqrt(jnp.maximum(inside, 0.0))
    depth = 1 / jnp.maximum(nearness, 1e-9)
    first = jnp.maximum(depth, middle - half)
    return first, jnp.minimum(depth + sweep.thickness, middle + half)


def _view_ray(
    part: Slice, out: Float[Array, "H W"]
) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    """The ray from the eye that is `out` from the pixel's, by the slice's axes."""
    return out * part.along[0] - part.length, out * part.along[1]


def _sector(
    part: Slice,
    out: Float[Array, "H W"],
    depth: Float[Array, "H W"],
    side: Float[Array, ""],
) -> UInt[Array, "H W"]:
    """How many sectors lie before a point of the slice's plane, rounded.

    The weight before an angle t is a closed form (Jimenez et al. 2016, equation 7).
    """
    up, aside = _view_ray(part, out)
    up, aside = part.distance + depth * up, depth * aside
    scale = lax.rsqrt(jnp.maximum(up**2 + aside**2, 1e-20))
    c, s = up * scale, aside * scale
    cos, sin = part.facing
    double = (c * c - s * s) * cos + 2 * s * c * sin
    beyond = side * (cos - double + 2 * side * _angle(c) * sin) / 4
    before = beyond / part.whole + part.before
    end = jnp.where(side > 0, 1.0, 0.0)
    before = jnp.where(c * cos + s * sin > 0, before, end)
    return jnp.round(jnp.clip(before, 0, 1) * SECTORS).astype(jnp.uint32)


def _angle(cosine: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Arc cosine to 7e-5 (Abramowitz and Stegun 4.4.45): most of the time is here."""
    x = jnp.minimum(jnp.abs(cosine), 1.0)
    smooth = 1.5707288 + x * (-0.2121144 + x * (0.0742610 - 0.0187293 * x))
    angle = jnp.sqrt(1 - x) * smooth
    return jnp.where(cosine < 0, np.pi - angle, angle)


def _bits_below(count: UInt[Array, "H W"]) -> UInt[Array, "H W"]:
    """The lowest bits, from none to all 32."""
    all_bits = jnp.uint32(2**SECTORS - 1)
    shifted = lax.shift_left(jnp.ones_like(count), jnp.minimum(count, 31)) - 1
    return jnp.where(count >= SECTORS, all_bits, shifted)


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

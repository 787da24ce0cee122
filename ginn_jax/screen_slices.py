"""The directions round a pixel, in planes through the eye, cut to sectors.

A slice is the plane through the eye and the pixel along one direction of the image. Its
hemisphere is cut into 32 sectors of equal cosine-weighted solid angle, numbered from
one side to the other, after Jimenez et al., "Practical Realtime Strategies for Accurate
Indirect Occlusion" (2016).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, UInt

from ginn_jax.screen import Screen, dot

SECTORS = 32


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


def view_ray(
    part: Slice, out: Float[Array, "H W"]
) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    """The ray from the eye that is `out` from the pixel's, by the slice's axes."""
    return out * part.along[0] - part.length, out * part.along[1]


def sector(
    part: Slice,
    out: Float[Array, "H W"],
    depth: Float[Array, "H W"],
    side: Float[Array, ""],
) -> UInt[Array, "H W"]:
    """How many sectors lie before a point of the slice's plane, rounded.

    The weight before an angle t is a closed form (Jimenez et al. 2016).
    """
    up, aside = view_ray(part, out)
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


def bits_below(count: UInt[Array, "H W"]) -> UInt[Array, "H W"]:
    """The lowest bits, from none to all 32."""
    all_bits = jnp.uint32(2**SECTORS - 1)
    shifted = lax.shift_left(jnp.ones_like(count), jnp.minimum(count, 31)) - 1
    return jnp.where(count >= SECTORS, all_bits, shifted)

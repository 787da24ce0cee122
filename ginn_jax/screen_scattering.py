"""Subsurface scattering from what is on the screen alone: blurred irradiance.

Separable as in Jimenez, Sundstedt and Gutierrez, "Screen-Space Perceptual Rendering of
Human Skin" (2009): a diffusion profile is a sum of Gaussians, each a pass along rows
and one along columns. The profile is normalised diffusion (Christensen and Burley,
"Approximate Reflectance Profiles for Efficient Subsurface Scattering", 2015), its width
that of a medium whose mean free path is 1 / extinction.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ginn_jax.camera import Camera
from ginn_jax.checks import number, positive, vector
from ginn_jax.errors import InputError
from ginn_jax.screen import (
    STEEPEST,
    Screen,
    check_counts,
    check_images,
    dot,
    enter_screen,
    pixel_places,
)
from ginn_jax.slab import external_reflectance

# Normalised diffusion of unit shape as a sum of Gaussians, variance and weight: least
# squares of the energy within a distance, which is met to .011.
GAUSSIANS = (
    (0.00436, 0.0665),
    (0.16107, 0.21675),
    (1.92145, 0.40198),
    (16.98, 0.31477),
)
REACH = 3.0


def radiant_exitance(
    position: Float[Any, "H W 3"],
    normal: Float[Any, "H W 3"],
    mask: Bool[Any, "H W"],
    irradiance: Float[Any, "H W 3"],
    camera: Camera,
    *,
    albedo: Float[Any, "3"] | tuple[float, float, float],
    extinction: float,
    ior: float,
    taps: int = 25,
    widening: float = 3.0,
) -> Float[Array, "H W 3"]:
    """What leaves a translucent object, from the irradiance on what is seen of it.

    `albedo`, `extinction` (per unit of length) and `ior` are those of
    `subsurface.Medium`. Where irradiance is even on a plane the exitance is that times
    the albedo and the share that the boundary lets in. Every pass takes `taps` samples
    up to 3 standard deviations, fewer of them where the surface breaks off. Black in
    the background.

    `widening` scales all lengths: light inside is thrown back by the boundary, and the
    profile is one for a half space lit at a point. Tuned on 5 procedural objects under
    procedural skies (seeds 0 to 4, 192 pixels) against random walks: errors fell until
    2 to 4.
    """
    check_counts(taps=taps)
    positive("extinction", extinction)
    positive("widening", widening)
    number("ior", ior, 1.0, 2.0)
    if not np.all((vector("albedo", albedo) >= 0) & (np.asarray(albedo) <= 1)):
        raise InputError(f"albedo {albedo} must be from 0 to 1")
    screen = enter_screen(position, normal, mask, camera)
    check_images(screen.mask.shape, irradiance=irradiance)
    albedo = jnp.asarray(albedo, jnp.float32)
    lengths = widening / extinction / profile_shape(albedo)
    light = jnp.where(screen.mask[..., None], irradiance, 0.0)
    spread = _diffuse(screen, jnp.moveaxis(light, -1, 0), lengths, taps)
    entered = 1 - external_reflectance(ior) if ior > 1 else 1.0
    return jnp.where(screen.mask[..., None], entered * albedo * spread, 0.0)


def profile_shape(albedo: Float[Array, "3"]) -> Float[Array, "3"]:
    """Mean free paths in the length scale of the profile, for light that comes diffuse.

    Christensen and Burley 2015, their fit for diffuse surface transmission.
    """
    return 1.9 - albedo + 3.5 * (albedo - 0.8) ** 2


def _diffuse(
    screen: Screen,
    light: Float[Array, "3 H W"],
    lengths: Float[Array, "3"],
    taps: int,
) -> Float[Array, "H W 3"]:
    """Light blurred by the profile of a length for each channel."""
    weights = jnp.array([w for _, w in GAUSSIANS], jnp.float32)
    deviations = jnp.sqrt(jnp.array([v for v, _ in GAUSSIANS], jnp.float32))
    widths = pixel_widths(screen)

    def channel(one: tuple[Array, Array]) -> Array:
        values, length = one

        def add(k: Array, total: Array) -> Array:
            deviation = deviations[k] * length
            blurred = values
            for axis in (1, 0):
                blurred = blur(screen, blurred, deviation, widths[axis], axis, taps)
            return total + weights[k] * blurred

        return lax.fori_loop(0, len(GAUSSIANS), add, jnp.zeros_like(values))

    total = lax.map(channel, (light, lengths)) / jnp.sum(weights)
    return jnp.moveaxis(total, 0, -1)


def pixel_widths(screen: Screen) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    """Length on the surface from row to row, and from column to column.

    On the pixel's tangent plane; at most `STEEPEST` times what it would be face on.
    """
    depth = screen.position[..., 2]
    facing = dot(screen.normal, screen.rays)
    facing = jnp.where(jnp.abs(facing) > 1e-3, facing, -1e-3)
    widths = []
    for axis in (1, 0):
        along = -screen.normal[..., axis, None] / facing[..., None] * screen.rays
        along = along + jnp.array(np.eye(3, dtype=np.float32)[axis])
        widths.append(jnp.minimum(jnp.sqrt(dot(along, along)), STEEPEST))
    return widths[0] * depth / screen.focal, widths[1] * depth / screen.focal


def blur(
    screen: Screen,
    values: Float[Array, "H W"],
    deviation: Float[Array, ""],
    width: Float[Array, "H W"],
    axis: int,
    taps: int,
) -> Float[Array, "H W"]:
    """A Gaussian along the columns (axis 0) or rows (1), within a connected surface.

    A tap counts less the farther it is in space beyond where its distance on the
    screen would put it on a plane: nothing bleeds over a gap in depth. Weights are
    divided by their sum, so that nothing darkens at an edge.
    """
    height, length = screen.mask.shape
    columns, rows = (jnp.array(a) for a in pixel_places((height, length)))
    ahead = jnp.minimum(deviation / width, max(height, length) / (2 * REACH))
    variance = 2 * (ahead * width) ** 2

    def tap(number: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        at = (number.astype(jnp.float32) + 0.5) / taps * 2 * REACH - REACH
        stray = jnp.round(at * ahead)
        column = columns + (stray if axis == 1 else 0.0)
        row = rows + (stray if axis == 0 else 0.0)
        on = (column >= 0) & (column < length) & (row >= 0) & (row < height)
        i = jnp.clip(row, 0, height - 1).astype(jnp.int32)
        j = jnp.clip(column, 0, length - 1).astype(jnp.int32)
        way = screen.position[i, j] - screen.position
        excess = jnp.maximum(dot(way, way) - (stray * width) ** 2, 0.0)
        share = jnp.exp(-0.5 * at**2 - excess / variance)
        share = jnp.where(on & screen.mask[i, j] & screen.mask, share, 0.0)
        return sums[0] + share * values[i, j], sums[1] + share

    zero = jnp.zeros((height, length))
    total, weight = jax.lax.fori_loop(0, taps, tap, (zero, zero))
    return total / jnp.maximum(weight, 1e-12)

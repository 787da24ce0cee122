"""Lit scenes seen by a camera, and networks that carry light on clouds and pixels."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ginn_jax.architecture import Network
from ginn_jax.camera import Camera, orbit_camera
from ginn_jax.estimates import ColorEstimate
from ginn_jax.evaluate import Image, Model, fill
from ginn_jax.image import Encoded, shade_image
from ginn_jax.inference import encode_cloud
from ginn_jax.limits import Limits
from ginn_jax.lit_clouds import LitCloud, network_numbers
from ginn_jax.lit_scenes import (
    Illumination,
    Lit,
    Scattering,
    light_up,
    lit_points,
    transport,
)
from ginn_jax.objects import Source
from ginn_jax.reference import GBuffer, build_scene, render_gbuffer
from ginn_jax.samples import Samples


class LitView(NamedTuple):
    """One lit object seen by one camera; its foreground pixels are a cloud."""

    lit: Lit
    gbuffer: GBuffer
    pixels: LitCloud


def lit_view(
    source: Source,
    settings: Illumination | Scattering,
    paths: int,
    size: int,
) -> LitView:
    """A source with its path-traced reference at every foreground pixel."""
    camera = orbit_camera(width=size, height=size)
    view = lit_frame(light_up(source, settings), camera, settings, seed=source.seed)
    return with_truth(view, traced(view, paths, seed=source.seed))


def lit_frame(
    lit: Lit, camera: Camera, settings: Illumination | Scattering, *, seed: int
) -> LitView:
    """A lit scene seen by a camera, with direct light and no reference yet."""
    gbuffer = render_gbuffer(build_scene(lit.scene.mesh), camera)
    seen = gbuffer.position, gbuffer.normal, gbuffer.material
    samples = Samples(*(a[gbuffer.mask] for a in seen))
    pixels = lit_points(lit, samples, settings.looks, seed=seed)
    return LitView(lit, gbuffer, pixels)


def traced(
    view: LitView, paths: int, *, stratified: bool = False, seed: int
) -> ColorEstimate:
    """Path tracing of the transported light at the pixels of a view."""
    ends = view.lit, view.pixels.position, view.pixels.normal
    return transport(*ends, paths=paths, seed=seed, stratified=stratified)


def with_truth(view: LitView, truth: ColorEstimate) -> LitView:
    """The view with a reference."""
    pixels = view.pixels._replace(target=truth.mean, variance=truth.variance)
    return view._replace(pixels=pixels)


def displayed(
    view: LitView, transported: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "H W 3"]:
    """Radiance of the pixels: (direct + indirect) albedo / pi, or exitance / pi."""
    pixels = view.pixels
    if pixels.medium.size:
        return fill(view.gbuffer.mask, transported / np.pi)
    albedo = pixels.albedo[pixels.material]
    return fill(view.gbuffer.mask, (pixels.irradiance + transported) * albedo / np.pi)


def encode_lit(
    network: Network,
    limits: Limits,
    model: Model,
    cloud: LitCloud,
    kept_before: Bool[Any, "L R"] | None = None,
    *,
    merge_grey: bool = False,
) -> tuple[Encoded, Limits]:
    """f_3D of a cloud, in all three channels.

    With `merge_grey` in one where all are the same, as of grey light on grey material:
    queries are then given only `channels_of` their own, and values have one channel.
    """
    numbers = network_numbers(cloud)
    if merge_grey:
        numbers = distinct_channels(*numbers)
    ends = model.variables, cloud.position, cloud.normal
    return encode_cloud(network, limits, *ends, *numbers, kept_before, key=model.key)


def distinct_channels(
    material: Float[np.ndarray, "3 N A"], light: Float[np.ndarray, "3 N L"]
) -> tuple[Float[np.ndarray, "C N A"], Float[np.ndarray, "C N L"]]:
    """One channel where all three are the same, as under grey light on grey things."""
    same = all(np.array_equal(a[0], a[k]) for a in (material, light) for k in (1, 2))
    return (material[:1], light[:1]) if same else (material, light)


def channels_of(encoded: Encoded) -> slice:
    """The channels that were encoded, all three or the first, for the queries."""
    return slice(np.size(np.asarray(encoded.scale)))


def pixel_numbers(view: LitView) -> list[Float[np.ndarray, "3 H W _"]]:
    """Material and light of all pixels as networks take them, background zero."""
    mask = view.gbuffer.mask
    return [
        np.stack([fill(mask, channel) for channel in number])
        for number in network_numbers(view.pixels)
    ]


def shade_seen(
    network: Network,
    limits: Limits,
    model: Model,
    encoded: Encoded,
    gbuffer: GBuffer,
    numbers: Sequence[Float[np.ndarray, "3 H W _"]],
    scale: float = 1.0,
) -> tuple[Image, Limits]:
    """f_2D at the pixels, whose material and light `pixel_numbers` has."""
    material, light = (number[channels_of(encoded)] for number in numbers)
    return shade_image(
        network,
        limits,
        model.variables,
        encoded,
        gbuffer.position,
        gbuffer.normal,
        gbuffer.mask,
        background=0.0,
        resolution_scale=scale,
        material=material,
        light=light,
    )

"""Errors of networks that carry light: at points, in images, against run time.

All errors are in units of the squared mean light of the cloud and channel (see
`dataset.unit_light`), so that a bright light weighs no more than a dim one, and pooled
over channels and clouds as a ratio of means.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ginn_jax.architecture import Network
from ginn_jax.camera import Camera, orbit_camera
from ginn_jax.dataset import count_asked
from ginn_jax.estimates import ColorEstimate
from ginn_jax.evaluate import (
    Image,
    Model,
    Row,
    at_scale,
    fill,
    timed,
    timed_network,
)
from ginn_jax.image import Encoded, shade_image
from ginn_jax.inference import encode_cloud, shade_points
from ginn_jax.limits import Limits
from ginn_jax.lit_clouds import LitCloud, network_numbers, split_points
from ginn_jax.lit_scenes import (
    Illumination,
    Lit,
    Scattering,
    light_up,
    lit_points,
    transport,
)
from ginn_jax.metrics import dssim, relative_error, tone_map
from ginn_jax.objects import Source
from ginn_jax.reference import GBuffer, build_scene, render_gbuffer
from ginn_jax.samples import Samples


class LitView(NamedTuple):
    """One lit object seen by one camera; its foreground pixels are a cloud."""

    lit: Lit
    gbuffer: GBuffer
    pixels: LitCloud


def encode_lit(
    network: Network,
    limits: Limits,
    model: Model,
    cloud: LitCloud,
    kept_before: Bool[Any, "L R"] | None = None,
) -> tuple[Encoded, Limits]:
    """f_3D of a cloud; all channels, or one where the light is grey."""
    numbers = distinct_channels(*network_numbers(cloud))
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


def evaluate_lit_clouds(
    network: Network,
    limits: Limits,
    model: Model,
    clouds: Sequence[LitCloud],
    names: Sequence[str],
    settings: Illumination | Scattering,
) -> tuple[list[Row], Limits]:
    """3D errors of every cloud, at those points that have a target, noise subtracted.

    The other points are the network's input.
    """
    rows = []
    targets = settings.targets or count_asked(settings.points)
    for name, cloud in zip(names, clouds, strict=True):
        given, asked = split_points(cloud, len(cloud.position) - targets)
        encoded, limits = encode_lit(network, limits, model, given)
        numbers = network_numbers(asked, channels_of(encoded))
        ends = model.variables, encoded, asked.position, asked.normal
        values, limits = shade_points(network, limits, *ends, *numbers)
        errors = unit_errors(encoded, asked, np.maximum(values, 0.0))
        rows.append({"name": name, "points": int(np.sum(encoded.points.mask))} | errors)
        rows[-1]["ray_variance"] = rows[-1]["noise_floor_3d"] * settings.paths
        medium = zip(("extinction", "ior"), cloud.medium.tolist(), strict=False)
        rows[-1] |= dict(medium)
    return rows, limits


def unit_errors(
    encoded: Encoded, asked: LitCloud, values: Float[np.ndarray, "N C"]
) -> Row:
    """Errors of `values` at points, noise subtracted."""
    scale = np.asarray(encoded.scale)
    noise = np.asarray(np.mean(asked.variance, axis=0, dtype=np.float64))
    error = np.mean((values.astype(np.float64) - asked.target) ** 2, axis=0) - noise
    spread = np.asarray(np.var(asked.target, axis=0, dtype=np.float64) - noise)
    errors = {
        "mse_3d": in_units(error, scale),
        "noise_floor_3d": in_units(noise, scale),
        "variance_3d": in_units(spread, scale),
    }
    relative = relative_error(errors["mse_3d"], errors["variance_3d"])
    return errors | {"relative_mse_3d": relative}


def in_units(squared: Float[np.ndarray, "C"], scale: Float[np.ndarray, "K"]) -> float:
    """Mean of squared light over the channels that are lit, in units of their light.

    `scale` is the mean light of each channel, or of all where it is one number.
    """
    scale = np.broadcast_to(scale, squared.shape).astype(np.float64)
    lit = scale > 0
    return float(np.mean(squared[lit] / scale[lit] ** 2)) if lit.any() else float("nan")


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


def traced(view: LitView, paths: int, *, seed: int) -> ColorEstimate:
    """Path tracing of the transported light at the pixels of a view."""
    ends = view.pixels.position, view.pixels.normal
    return transport(view.lit, *ends, paths=paths, seed=seed)


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


def lit_image_errors(
    view: LitView, values: Float[np.ndarray, "P 3"], scale: Float[np.ndarray, "C"]
) -> Row:
    """2D errors of the foreground: of the transported light less its noise, in units of
    the mean light; DSSIM of what is displayed, tone-mapped."""
    mask, pixels = view.gbuffer.mask, view.pixels
    noise = np.mean(pixels.variance, axis=0, dtype=np.float64)
    error = np.mean((values.astype(np.float64) - pixels.target) ** 2, axis=0) - noise
    spread = np.var(pixels.target, axis=0, dtype=np.float64) - noise
    right = displayed(view, pixels.target)
    mine, right = (tone_map(i, right, mask) for i in (displayed(view, values), right))
    return {
        "mse_2d": in_units(error, scale),
        "variance_2d": in_units(spread, scale),
        "dssim_2d": dssim(mine, right, mask),
    }


def lit_network_row(
    network: Network,
    limits: Limits,
    model: Model,
    cloud: LitCloud,
    view: LitView,
    scale: float = 1.0,
) -> tuple[Row, Float[np.ndarray, "P 3"], Encoded, Limits]:
    """Errors and times of the network on one object; its values and codes."""
    mask = view.gbuffer.mask
    pixels = view.gbuffer.position, view.gbuffer.normal, mask
    material, light = (
        np.stack([fill(mask, a) for a in number])
        for number in network_numbers(view.pixels)
    )

    def shade(limits: Limits, encoded: Encoded) -> tuple[Image, Limits]:
        some = channels_of(encoded)
        return shade_image(
            network,
            limits,
            model.variables,
            encoded,
            *pixels,
            background=0.0,
            resolution_scale=scale,
            material=material[some],
            light=light[some],
        )

    encoded, image, limits, times = timed_network(
        limits, lambda limits: encode_lit(network, limits, model, cloud), shade
    )
    values = np.broadcast_to(image[mask], view.pixels.target.shape)
    row = {"method": "network" + at_scale(scale)} | times
    errors = lit_image_errors(view, values, np.asarray(encoded.scale))
    return row | errors, values, encoded, limits


def path_row(
    view: LitView, paths: int, seed: int, scale: Float[np.ndarray, "C"]
) -> Row:
    """Error and time of path tracing the same pixels with `paths` each."""
    truth, seconds = timed(lambda: traced(view, paths, seed=seed))
    row = {"method": f"{paths} paths", "paths": paths, "seconds": seconds}
    return row | lit_image_errors(view, truth.mean, scale)

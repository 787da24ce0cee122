"""Errors of networks that carry light: at points, in images, against run time.

All errors are in units of the squared mean light of the cloud and channel (see
`dataset.unit_light`), so that a bright light weighs no more than a dim one, and pooled
over channels and clouds as a ratio of means.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ginn_jax.architecture import Network
from ginn_jax.dataset import count_asked
from ginn_jax.evaluate import Image, Model, Row, at_scale, timed, timed_network
from ginn_jax.image import Encoded
from ginn_jax.inference import shade_points
from ginn_jax.limits import Limits
from ginn_jax.lit_clouds import LitCloud, network_numbers, split_points
from ginn_jax.lit_scenes import Illumination, Scattering
from ginn_jax.lit_views import (
    LitView,
    channels_of,
    displayed,
    encode_lit,
    pixel_numbers,
    shade_seen,
    traced,
)
from ginn_jax.metrics import dssim, relative_error, tone_map


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
        values, encoded, limits = values_at(network, limits, model, given, asked)
        errors = unit_errors(np.asarray(encoded.scale), asked, values)
        rows.append({"name": name, "points": int(np.sum(encoded.points.mask))} | errors)
        rows[-1]["ray_variance"] = rows[-1]["noise_floor_3d"] * settings.paths
        medium = zip(("extinction", "ior"), cloud.medium.tolist(), strict=False)
        rows[-1] |= dict(medium)
    return rows, limits


def values_at(
    network: Network, limits: Limits, model: Model, given: LitCloud, asked: LitCloud
) -> tuple[Float[np.ndarray, "N C"], Encoded, Limits]:
    """What a network that is given a cloud says of other points; its codes; the limits
    that sufficed."""
    encoded, limits = encode_lit(network, limits, model, given)
    numbers = network_numbers(asked, channels_of(encoded))
    ends = model.variables, encoded, asked.position, asked.normal
    values, limits = shade_points(network, limits, *ends, *numbers)
    return np.maximum(values, 0.0), encoded, limits


def unit_errors(
    scale: Float[np.ndarray, "C"], asked: LitCloud, values: Float[np.ndarray, "N C"]
) -> Row:
    """Errors of `values` at points, noise subtracted; `scale` as in `in_units`."""
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
    seen = pixel_numbers(view)

    def encode(limits: Limits) -> tuple[Encoded, Limits]:
        return encode_lit(network, limits, model, cloud, merge_grey=True)

    def shade(limits: Limits, encoded: Encoded) -> tuple[Image, Limits]:
        return shade_seen(network, limits, model, encoded, view.gbuffer, seen, scale)

    encoded, image, limits, times = timed_network(limits, encode, shade)
    values = np.broadcast_to(image[view.gbuffer.mask], view.pixels.target.shape)
    row = {"method": "network" + at_scale(scale)} | times
    errors = lit_image_errors(view, values, np.asarray(encoded.scale))
    return row | errors, values, encoded, limits


def path_row(
    view: LitView, paths: int, seed: int, scale: Float[np.ndarray, "C"]
) -> Row:
    """Error and time of stratified path tracing with `paths` a pixel."""
    truth, seconds = timed(lambda: traced(view, paths, stratified=True, seed=seed))
    row = {"method": f"{paths} paths", "paths": paths, "seconds": seconds}
    return row | lit_image_errors(view, truth.mean, scale)

"""From a cloud and a G-buffer to an image: f_3D once, f_2D for the pixels in sight.

A pixel is a point, so the same two functions give values at points of a cloud. Both are
host-level: they hold no more than a block of queries at a time, and where a capacity is
too small they raise it and try again; the limits that sufficed come back for reuse.
"""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from ginn_jax.architecture import Network
from ginn_jax.checks import LARGEST, number, real_array, unit_rows
from ginn_jax.dataset import center_of, relative_to
from ginn_jax.errors import InputError
from ginn_jax.geometry import Limits, exceeded, limits_for, raise_limits
from ginn_jax.neighbors import bucket, pad_rows
from ginn_jax.network import Variables
from ginn_jax.process import ALONE
from ginn_jax.receptive_field import Oriented
from ginn_jax.shading import Encoded, encode, shade
from ginn_jax.upsample import Surface, sample_pixels, upsample

BLOCK = 1 << 14
SLACK = 1.25


encode_whole = jax.jit(encode, static_argnums=(0, 1))
shade_block = jax.jit(shade, static_argnums=(0, 1), compiler_options=ALONE)
_upsample = jax.jit(upsample)


def encode_cloud(
    network: Network,
    limits: Limits,
    variables: Variables,
    position: Float[np.ndarray, "N 3"],
    normal: Float[np.ndarray, "N 3"],
    material: Float[np.ndarray, "C N A"] | None = None,
    light: Float[np.ndarray, "C N L"] | None = None,
    *,
    key: Key[Array, ""],
) -> tuple[Encoded, Limits]:
    """Codes of a cloud, and the limits that sufficed.

    Raises:
        InputError: an empty cloud, or one that is not finite; normals that are not of
            unit length; material or light that the network does not take.
    """
    if not np.size(position):
        raise InputError("the cloud is empty: sample at least one point")
    unit_rows(position, normal, "the cloud")
    check_numbers("material", material, network.materials, len(position))
    check_numbers("light", light, network.lights, len(position))
    rows = bucket(len(position))
    center = center_of(position)
    padded, mask = pad_rows(relative_to(center, position), rows)
    turned, _ = pad_rows(np.asarray(normal, np.float32), rows)
    cloud = Oriented(padded, turned, mask)
    more = pad_channels(material, rows), pad_channels(light, rows)
    while True:
        deep = without(limits, network.query.name)
        encoded, demands = encode_whole(network, deep, variables, cloud, *more, key)
        short = exceeded(limits, demands)
        if not short:
            return encoded._replace(center=center), limits
        limits = raise_limits(limits, short, SLACK)


def check_numbers(name: str, numbers: Any, width: int, rows: int) -> None:
    """Raise `InputError` unless so many numbers come with each of these points."""
    if width == 0 and numbers is not None:
        raise InputError(f"the network takes no {name}: leave it out")
    given = real_array(name, () if numbers is None else numbers)
    shape = given.shape
    if width and (len(shape) != 3 or shape[1:] != (rows, width)):
        raise InputError(f"{name} is {shape}, the network takes [C {rows} {width}]")
    if width and not np.isfinite(given).all():
        raise InputError(f"{name} holds non-finite numbers: remove those points")


def pad_channels(
    numbers: Float[np.ndarray, "C N A"] | None, rows: int
) -> Float[np.ndarray, "C R A"] | None:
    """Zeros for rows up to `rows`."""
    if numbers is None:
        return None
    padding = ((0, 0), (0, rows - numbers.shape[1]), (0, 0))
    return np.pad(np.asarray(numbers, np.float32), padding)


def only(limits: Limits, conv: str) -> Limits:
    """The limits of one convolution: others must not make it compile again."""
    return Limits(tuple(s for s in limits.sizes if s[0].startswith(f"{conv}.")))


def without(limits: Limits, conv: str) -> Limits:
    """The limits of everything else."""
    return Limits(tuple(s for s in limits.sizes if not s[0].startswith(f"{conv}.")))


def shade_points(
    network: Network,
    limits: Limits,
    variables: Variables,
    encoded: Encoded,
    position: Float[np.ndarray, "M 3"],
    normal: Float[np.ndarray, "M 3"],
    material: Float[np.ndarray, "C M A"] | None = None,
    light: Float[np.ndarray, "C M L"] | None = None,
) -> tuple[Float[np.ndarray, "M *C"], Limits]:
    """Values at any points, in blocks over all devices; the limits that sufficed.

    With light they have a last axis of channels. `material` and `light` of the points
    themselves are needed only where the network asks for all.

    Raises:
        InputError: as `encode_cloud`, but for no points at all, which have no values.
    """
    unit_rows(position, normal)
    if network.asks == "all":
        check_numbers("material", material, network.materials, len(position))
        check_numbers("light", light, network.lights, len(position))
    center, encoded = encoded.center, encoded._replace(center=None)
    copies = [jax.device_put((variables, encoded), d) for d in jax.devices()]
    size = min(BLOCK, bucket(len(position)))
    while True:
        parts, demands = [], []
        flat = only(limits, network.query.name)
        for turn, first in enumerate(range(0, len(position), size)):
            block = slice(first, first + size)
            place, mask = pad_rows(relative_to(center, position[block]), size)
            turned, _ = pad_rows(np.asarray(normal[block], np.float32), size)
            queries = Oriented(place, turned, mask)
            numbers = (
                None if a is None else pad_channels(a[:, block], size)
                for a in (material, light)
            )
            arrays = copies[turn % len(copies)]
            values, demand = shade_block(network, flat, *arrays, queries, *numbers)
            parts.append(values)
            demands.append(demand)
        short: dict[str, int] = {}
        for demand in jax.device_get(demands):
            for name, need in exceeded(limits, demand).items():
                short[name] = max(need, short.get(name, 0))
        if not short:
            if not parts:
                channels = () if encoded.scale is None else encoded.scale.shape
                return np.zeros((0, *channels), np.float32), limits
            values = [np.moveaxis(np.asarray(part), -1, 0) for part in parts]
            return np.concatenate(values)[: len(position)], limits
        limits = raise_limits(limits, short, SLACK)


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

    Below a `resolution_scale` of 1 fewer are: the others are interpolated inside their
    own surface, and computed where that is not possible (see `upsample`).

    Raises:
        InputError: a resolution scale outside (0, 1], arrays of unequal size, a mask
            that is not of bool, or pixels in it that `shade_points` refuses.
    """
    mask = np.asarray(mask)
    if mask.dtype != bool or mask.ndim != 2:
        raise InputError(f"mask is {mask.dtype} {mask.shape}: give bool [H W]")
    number("background", background, -LARGEST)
    if not np.shape(position) == np.shape(normal) == (*mask.shape, 3):
        raise InputError(
            f"position {np.shape(position)} and normal {np.shape(normal)} do not fit "
            f"the mask {mask.shape}: give [H W 3]"
        )
    if not 0 < resolution_scale <= 1:
        raise InputError(f"resolution scale {resolution_scale}: give it in (0, 1]")
    channels = () if encoded.scale is None else encoded.scale.shape
    values = np.full((*mask.shape, *channels), background, np.float32)
    wanted, surface = mask, Surface(position, normal, mask)

    def shade(pixels: Bool[np.ndarray, "H W"], limits: Limits) -> Limits:
        ends = position[pixels], normal[pixels]
        more = (None if a is None else a[:, pixels] for a in (material, light))
        found, limits = shade_points(network, limits, variables, encoded, *ends, *more)
        values[pixels] = within_range(encoded, found)
        return limits

    if resolution_scale < 1:
        rows, columns = (sample_pixels(n, resolution_scale) for n in mask.shape)
        sampled = np.zeros_like(mask)
        sampled[np.ix_(rows, columns)] = mask[np.ix_(rows, columns)]
        limits = shade(sampled, limits)
        coarse, thickness = values[np.ix_(rows, columns)], 0.2 * network.query.radius
        wanted = mask & ~sampled
        for channel in np.ndindex(*channels):
            layer = (..., *channel)
            between, known = _upsample(coarse[layer], rows, columns, surface, thickness)
            known = np.asarray(known) & mask & ~sampled
            values[layer][known] = np.asarray(between)[known]
            wanted &= ~known
    return values, shade(wanted, limits)


def within_range(
    encoded: Encoded, values: Float[np.ndarray, "*P"]
) -> Float[np.ndarray, "*P"]:
    """Output as what it can be: openness in [0, 1], or light, which is not negative."""
    return np.clip(values, 0.0, 1.0 if encoded.scale is None else np.inf)


def as_openness(values: Float[np.ndarray, "*P"]) -> Float[np.ndarray, "*P"]:
    """Network output as openness: it can be nothing outside [0, 1]."""
    return np.clip(values, 0.0, 1.0)


def with_disk_radius(network: Network, radius: float) -> Network:
    """The same network on a finest level of another Poisson disk radius.

    Raises:
        InputError: a radius not positive, or one that leaves gaps in the f_2D field.
    """
    if not 0 < radius < network.query.radius:
        raise InputError(
            f"Poisson radius {radius}: must lie between 0 and the f_2D radius "
            f"{network.query.radius}, or pixels are left without a point"
        )
    if not radius <= min(network.levels[1:], default=radius):
        raise InputError(
            f"Poisson radius {radius} exceeds level 1's {network.levels[1]}"
        )
    return replace(network, levels=(radius, *network.levels[1:]))


def limits_at(network: Network, limits: Limits, radius: float) -> Limits:
    """Capacities to expect at another finest Poisson disk radius.

    A power of the ratio of the radii squared for each. The powers are measured, at
    radii .015, .02 and .03 on 20,000 samples of a procedural shape: points go less than
    with the square, for the samples run out. A guess: whoever uses it still compares
    demands.
    """
    growth = (network.levels[0] / radius) ** 2
    powers = {"columns": 0.65, "candidates": -0.3, "words": -0.3, "edges": -1.0}
    power = {f"level_0.{p}": n for p, n in (powers | {"points": 0.8}).items()}
    power |= _search_powers("level_1", 0, 0) | {"level_1.points": 0.1}
    for conv in (*network.encoder, network.query):
        power |= _search_powers(conv.name, conv.source, conv.target)
    return limits_for(
        {name: int(n * growth ** power.get(name, 0)) for name, n in limits.sizes}, 1.0
    )


def _search_powers(name: str, source: int, target: int) -> dict[str, float]:
    """How the demands of a search go with the points of level 0 at its ends."""
    senders, receivers = float(source == 0), float(target == 0)
    near = 0.75 * senders + 0.35 * receivers
    return {
        f"{name}.columns": 0.25 * receivers,
        f"{name}.candidates": near,
        f"{name}.words": near,
        f"{name}.edges": 0.85 * (senders + receivers),
        f"{name}.pairs": 1.6 * senders + 0.8 * receivers,
    }

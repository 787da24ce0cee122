"""From a cloud and a G-buffer to an image: f_3D once, f_2D for the pixels in sight.

A pixel is a point, so the same two functions give values at points of a cloud. Both are
host-level: they hold no more than a block of queries at a time, and where a capacity is
too small they raise it and try again; the limits that sufficed come back for reuse.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from ginn_jax.architecture import Network
from ginn_jax.errors import InputError
from ginn_jax.geometry import (
    Demands,
    Limits,
    build_geometry,
    build_query_field,
    exceeded,
    limits_for,
    raise_limits,
)
from ginn_jax.mcconv import Oriented
from ginn_jax.neighbors import bucket, pad_rows
from ginn_jax.network import Encoder, Shader, Variables
from ginn_jax.voxels import VoxelGrid

BLOCK = 1 << 15
SLACK = 1.25


class Encoded(NamedTuple):
    """What f_2D needs of a cloud: its finest level, searchable, with codes."""

    points: Oriented
    grid: VoxelGrid
    area: Array | None
    codes: Float[Array, "N K"]


def encode(
    network: Network,
    limits: Limits,
    variables: Variables,
    cloud: Oriented,
    key: Key[Array, ""],
) -> tuple[Encoded, Demands]:
    """f_3D with all its geometry."""
    geometry, demands = build_geometry(network, limits, cloud, key=key)
    codes: Any = Encoder(network, train=False).apply(
        variables["encoder"], geometry.levels[0].normal, geometry
    )
    encoded = Encoded(geometry.levels[0], geometry.grid, geometry.area, codes)
    return encoded, demands


def shade(
    network: Network,
    limits: Limits,
    variables: Variables,
    encoded: Encoded,
    queries: Oriented,
) -> tuple[Float[Array, "M"], Demands]:
    """f_2D with its search, for one block of queries."""
    field, demands = build_query_field(
        network, limits, encoded.points, encoded.grid, encoded.area, queries
    )
    values: Any = Shader(network, train=False).apply(
        variables["shader"], encoded.codes, queries.normal, queries.mask, field
    )
    return values, demands


_encode = jax.jit(encode, static_argnums=(0, 1))
_shade = jax.jit(shade, static_argnums=(0, 1))


def encode_cloud(
    network: Network,
    limits: Limits,
    variables: Variables,
    position: Float[np.ndarray, "N 3"],
    normal: Float[np.ndarray, "N 3"],
    *,
    key: Key[Array, ""],
) -> tuple[Encoded, Limits]:
    """Codes of a cloud, and the limits that sufficed.

    Raises:
        InputError: an empty cloud, or one that is not finite.
    """
    if not len(position):
        raise InputError("the cloud is empty: sample at least one point")
    if not (np.isfinite(position).all() and np.isfinite(normal).all()):
        raise InputError("the cloud holds non-finite numbers: remove those points")
    rows = bucket(len(position))
    padded, mask = pad_rows(np.asarray(position, np.float32), rows)
    turned, _ = pad_rows(np.asarray(normal, np.float32), rows)
    cloud = Oriented(padded, turned, mask)
    while True:
        deep = _without(limits, network.query.name)
        encoded, demands = _encode(network, deep, variables, cloud, key)
        short = exceeded(limits, demands)
        if not short:
            return encoded, limits
        limits = raise_limits(limits, short, SLACK)


def _only(limits: Limits, conv: str) -> Limits:
    """The limits of one convolution: others must not make it compile again."""
    return Limits(tuple(s for s in limits.sizes if s[0].startswith(f"{conv}.")))


def _without(limits: Limits, conv: str) -> Limits:
    """The limits of everything else."""
    return Limits(tuple(s for s in limits.sizes if not s[0].startswith(f"{conv}.")))


def shade_points(
    network: Network,
    limits: Limits,
    variables: Variables,
    encoded: Encoded,
    position: Float[np.ndarray, "M 3"],
    normal: Float[np.ndarray, "M 3"],
) -> tuple[Float[np.ndarray, "M"], Limits]:
    """Values at any points, in blocks over all devices; the limits that sufficed."""
    copies = [jax.device_put((variables, encoded), d) for d in jax.devices()]
    while True:
        parts, demands = [], []
        flat = _only(limits, network.query.name)
        for number, first in enumerate(range(0, len(position), BLOCK)):
            block = slice(first, first + BLOCK)
            padded, mask = pad_rows(np.asarray(position[block], np.float32), BLOCK)
            turned, _ = pad_rows(np.asarray(normal[block], np.float32), BLOCK)
            values, demand = _shade(
                network,
                flat,
                *copies[number % len(copies)],
                Oriented(padded, turned, mask),
            )
            parts.append(values)
            demands.append(demand)
        if not parts:
            return np.zeros(0, np.float32), limits
        short: dict[str, int] = {}
        for demand in demands:
            for name, need in exceeded(limits, demand).items():
                short[name] = max(need, short.get(name, 0))
        if not short:
            return np.concatenate([np.asarray(p) for p in parts])[
                : len(position)
            ], limits
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
) -> tuple[Float[np.ndarray, "H W"], Limits]:
    """An image of openness in [0, 1]; only the pixels in `mask` are computed."""
    values, limits = shade_points(
        network, limits, variables, encoded, position[mask], normal[mask]
    )
    image = np.full(mask.shape, background, np.float32)
    image[mask] = as_openness(values)
    return image, limits


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
    if not radius <= network.levels[1]:
        raise InputError(
            f"Poisson radius {radius} exceeds level 1's {network.levels[1]}"
        )
    return replace(network, levels=(radius, *network.levels[1:]))


def limits_at(network: Network, limits: Limits, radius: float) -> Limits:
    """Capacities to expect at another finest Poisson disk radius.

    Points go with the inverse square of the radius, pairs within the finest level with
    the square of that. A guess: whoever uses it still compares demands.
    """
    growth = (network.levels[0] / radius) ** 2
    power = {"level_0.points": 1, "level_1.candidates": 2, "level_1.edges": 2}
    for conv in (*network.encoder, network.query):
        ends = (conv.source == 0) + (conv.target == 0)
        power |= {f"{conv.name}.{p}": ends for p in ("candidates", "edges", "pairs")}
    return limits_for(
        {name: int(n * growth ** power.get(name, 0)) for name, n in limits.sizes}, 1.0
    )

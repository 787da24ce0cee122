"""f_3D of a cloud once, f_2D at any points: on the host, sizing themselves.

Where a capacity is too small they measure what is needed and try again; the limits that
sufficed come back for reuse. In lanes neither needs any; several threads may call them,
where one runs at a time.
"""

from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from ginn_jax.architecture import Network
from ginn_jax.block_shading import searchable, shade_blocks
from ginn_jax.blocks import everywhere, pad_channels, pad_points
from ginn_jax.checks import channels_alike, numbers_of, unit_rows, within_reach
from ginn_jax.dataset import center_of, relative_to
from ginn_jax.errors import InputError
from ginn_jax.example import numbers_asked
from ginn_jax.given import check_kept, check_queries, check_weights
from ginn_jax.lane_encoding import encode_in_lanes, encodes_in_lanes
from ginn_jax.lane_shading import lanes_for, shade_in_lanes
from ginn_jax.limits import (
    SLACK,
    Demands,
    Limits,
    measure_limits,
    say_raised,
    with_room,
    without,
)
from ginn_jax.neighbors import bucket
from ginn_jax.network import Variables
from ginn_jax.receptive_field import Oriented
from ginn_jax.searches import check_limits, uniform_limits, warn_of_gaps
from ginn_jax.shading import Encoded, cloud_demands, encode

encode_whole = jax.jit(encode, static_argnums=(0, 1))
_cloud_demands = jax.jit(cloud_demands, static_argnums=(0, 1))


def encode_cloud(
    network: Network,
    limits: Limits,
    variables: Variables,
    position: Float[np.ndarray, "N 3"],
    normal: Float[np.ndarray, "N 3"],
    material: Float[np.ndarray, "C N A"] | None = None,
    light: Float[np.ndarray, "C N L"] | None = None,
    kept_before: Bool[Any, "L R"] | None = None,
    *,
    key: Key[Array, ""],
) -> tuple[Encoded, Limits]:
    """Codes of a cloud, and the limits that sufficed.

    Where f_3D runs in lanes they stay in NumPy's memory and in no grid, and need no
    limits: `block_shading.searchable` readies them for `shading.shade`. Else they are
    on all devices.

    In an animation, samples that move with their surface, give what the frame before
    `kept` (`nothing_kept` before the first): levels then change as little as they can,
    and the picture flickers less.

    Raises:
        InputError: an empty cloud, or one that is not finite or reaches beyond 1e18;
            normals that are not of unit length; material or light that the network
            does not take, or in other channels than each other; light below 0;
            `kept_before` of another cloud; or limits or weights of another network.
    """
    unit_rows(position, normal, "the cloud")
    within_reach("the cloud", position)
    if not len(position):
        raise InputError("the cloud is empty: sample at least one point")
    numbers_of("material", material, network.materials, len(position))
    numbers_of("light", light, network.lights, len(position), least=0.0)
    channels_alike(material, light)
    check_limits(network, limits)
    rows = bucket(len(position))
    check_kept(kept_before, (len(network.levels), rows))
    check_weights(network, variables)
    center = center_of(position)
    if encodes_in_lanes(network):
        place, mask = relative_to(center, position), np.ones(len(position), bool)
        whole = Oriented(place, np.asarray(normal, np.float32), mask)
        given = whole, as_float(material), as_float(light), kept_before
        encoded = encode_in_lanes(network, variables, *given, key=key)
        kept = encoded.kept
        if not lanes_for(network):
            encoded = everywhere(searchable(network, encoded._replace(kept=None)))
        return encoded._replace(center=center, kept=kept), limits
    cloud = pad_points(center, position, normal, rows)
    more = pad_channels(material, rows), pad_channels(light, rows)

    def attempt(limits: Limits) -> tuple[Encoded, list[Demands]]:
        deep = without(limits, network.query.name)
        made, demands = encode_whole(
            network, deep, variables, cloud, *more, kept_before, key
        )
        return made, [demands]

    measure = partial(cloud_limits, network, cloud, kept_before, key=key)
    encoded, sufficed, _ = with_room(limits, attempt, measure)
    say_raised(limits, sufficed)
    # What f_2D needs is copied to all devices once, not for every image.
    shared = everywhere(encoded._replace(kept=None))
    return shared._replace(center=center, kept=encoded.kept), sufficed


def as_float(numbers: Any) -> Float[np.ndarray, "..."] | None:
    """In NumPy's memory, in single precision."""
    return None if numbers is None else np.asarray(numbers, np.float32)


def nothing_kept(network: Network, points: int) -> Bool[np.ndarray, "L R"]:
    """What was kept before the first frame of a cloud of so many points."""
    return np.zeros((len(network.levels), bucket(points)), bool)


def cloud_limits(
    network: Network,
    cloud: Oriented,
    kept_before: Bool[Any, "L R"] | None = None,
    *,
    key: Key[Array, ""],
) -> Limits:
    """Limits that hold what f_3D of a cloud needs, measured with ample ones."""
    ample = uniform_limits(network, 16 * cloud.mask.shape[0])

    def probe(limits: Limits, _: int) -> Demands:
        deep = without(limits, network.query.name)
        return jax.device_get(_cloud_demands(network, deep, cloud, kept_before, key))

    return measure_limits(ample, probe, 1, SLACK)


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
    """Values at any points, in any order; limits for the same again.

    With light they have a last axis of channels. `material` and `light` of the points
    themselves are needed only where the network asks for all.

    Raises:
        InputError: as `encode_cloud`, but for no points at all, which have no values;
            or limits, weights or codes of another network.
    """
    check_limits(network, limits)
    check_queries(network, variables, encoded, position, normal, material, light)
    asked = numbers_asked(network, material, light)
    ends = variables, encoded, position, normal, *asked
    if not lanes_for(network):
        return shade_blocks(network, limits, *ends)
    shaded = shade_in_lanes(network, *ends)
    warn_of_gaps(network.query, shaded.pairs, len(position))
    return shaded.values, limits

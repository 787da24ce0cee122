"""What a training step computes from its clouds before any parameter enters.

Clouds are turned, thinned at random and by Poisson disk sampling, and searched; the
points that thinning leaves over are asked for their shading and carry the loss.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from ginn_jax.architecture import Network
from ginn_jax.dataset import (
    ShadedPoints,
    oriented,
    rotate_about_up,
    safe_inverse,
    side_by_side,
    unit_light,
)
from ginn_jax.facets import facet_means, smooth_queries
from ginn_jax.geometry import Geometry, build_geometry, build_query_field
from ginn_jax.limits import Demands, Limits
from ginn_jax.ranges import compact
from ginn_jax.receptive_field import Field, Oriented, input_count
from ginn_jax.voxels import VoxelGrid, morton_order


class Asked(NamedTuple):
    """Points as the network takes them: attributes, and light in the cloud's unit."""

    attributes: Float[Array, "N A"]
    light: Float[Array, "N L"] | None


class Example(NamedTuple):
    """The geometry of a batch's share and the queries that carry the loss.

    `given` are the points of level 0, `asked` the queries; `target` is in units of the
    mean light of its cloud.
    """

    geometry: Geometry
    given: Asked
    field: Field
    queries: Oriented
    asked: Asked
    target: Float[Array, "M"]


def thin_and_search(
    network: Network,
    limits: Limits,
    batch: ShadedPoints,
    points: int,
    queries: int,
    sparsest: float,
    *,
    key: Key[Array, ""],
) -> tuple[Example, Demands]:
    """Turn, thin and search a batch [B, N], of whose clouds `points` are taken.

    The network is given a share of those, between `sparsest` and all; it is asked for
    others.
    """
    clouds = batch.position.shape[0]
    turn_key, window_key, share_key, disk_key = jax.random.split(key, 4)
    window = jax.random.randint(window_key, (), 0, batch.position.shape[1], jnp.int32)
    batch = jax.tree.map(lambda a: jnp.roll(a, -window, axis=1)[:, :points], batch)
    turn_keys = jax.random.split(turn_key, clouds)
    batch = jax.vmap(lambda c, k: rotate_about_up(c, key=k))(batch, turn_keys)
    cloud = side_by_side(jax.vmap(in_unit_light)(batch))
    mask = jnp.ones(cloud.target.shape, bool)
    order = morton_order(cloud.position, mask)
    cloud = jax.tree.map(lambda a: a[order], cloud)
    known = oriented(cloud)._replace(mask=given_share(mask, sparsest, key=share_key))
    geometry, demands = build_geometry(network, limits, known, key=disk_key)
    rows, real = left_over(geometry, mask, clouds * queries)
    asking = Oriented(cloud.position[rows], cloud.normal[rows], real)
    asking, facets, near = smooth_queries(network, limits, geometry.around, asking)
    finest, grid, area = geometry.levels[0], geometry.grid, geometry.area
    field, more = build_query_field(network, limits, finest, grid, area, asking)
    own = numbers(cloud, geometry.finest, finest.mask, geometry.facets)
    given = points_asked(finest, *own)
    asked = queries_asked(network, asking, *numbers(cloud, rows, real, facets))
    example = Example(geometry, given, field, asking, asked, cloud.target[rows])
    return example, demands | near | more


def blank_example(network: Network) -> Example:
    """One point, one query and one edge of everything: what parameters need to begin.

    Neither their shapes nor their values depend on any cloud.
    """
    place, row = jnp.zeros((1, 3)), jnp.zeros(1, jnp.int32)
    point = Oriented(place, place, jnp.ones(1, bool))
    inputs = jnp.zeros((input_count(network.oriented), 1))
    field = Field(row, row, inputs, jnp.zeros(1), jnp.int32(1))
    fields = {conv.name: field for conv in network.encoder}
    # Of what is searched, parameters know nothing.
    grid = VoxelGrid(place, row, row, row, place[0], place[0], jnp.zeros(3, jnp.int32))
    levels = (point,) * len(network.levels)
    material, light = (
        jnp.zeros((1, width)) if width else None
        for width in (network.materials, network.lights)
    )
    return Example(
        Geometry(levels, row, fields, None, grid),
        points_asked(point, material, light),
        field,
        point,
        queries_asked(network, point, material, light),
        jnp.zeros(1),
    )


def given_share(
    mask: Bool[Array, "N"], sparsest: float, *, key: Key[Array, ""]
) -> Bool[Array, "N"]:
    """A share of the points drawn evenly between `sparsest` and all of them.

    Of clouds that are always as dense a network learns nothing of others; and of all
    that a Poisson disk drops some point that it keeps is near.
    """
    if sparsest == 1.0:
        return mask
    share_key, point_key = jax.random.split(key)
    share = jax.random.uniform(share_key, minval=sparsest)
    return mask & (jax.random.uniform(point_key, mask.shape) < share)


def in_unit_light(cloud: ShadedPoints) -> ShadedPoints:
    """Light and target in units of the cloud's mean light."""
    if cloud.light is None:
        return cloud
    light, scale = unit_light(cloud.light, jnp.ones(cloud.target.shape, bool))
    return cloud._replace(light=light, target=cloud.target * safe_inverse(scale))


def numbers(
    cloud: ShadedPoints,
    rows: Int[Array, "M"],
    mask: Bool[Array, "M"],
    facets: Field | None = None,
) -> tuple[Array | None, Array | None]:
    """Material and light of some rows, zero where masked; the light as the mean over
    the samples around, if `facets` are given."""
    material, light = (
        None if a is None else a[rows] for a in (cloud.material, cloud.light)
    )
    material, light = real_rows((material, light), mask)
    if facets is not None and light is not None and cloud.light is not None:
        light = facet_means(facets, cloud.light, light)
    return material, light


def real_rows(
    columns: tuple[Array | None, Array | None], mask: Bool[Array, "M"]
) -> tuple[Array | None, ...]:
    """What there is, zero where masked."""
    return tuple(
        None if a is None else jnp.where(mask[:, None], a, 0.0) for a in columns
    )


def points_asked(
    points: Oriented, material: Array | None, light: Array | None
) -> Asked:
    """Points as the network takes them."""
    if material is None:
        return Asked(points.normal, light)
    return Asked(jnp.concatenate([points.normal, material], axis=1), light)


def queries_asked(
    network: Network, queries: Oriented, material: Array | None, light: Array | None
) -> Asked:
    """What f_2D is told of the queries themselves; of masked ones nothing."""
    normal = jnp.where(queries.mask[:, None], queries.normal, 0.0)
    if network.asks == "normal":
        return Asked(normal, None)
    return points_asked(queries._replace(normal=normal), material, light)


def numbers_asked(network: Network, material: Any, light: Any) -> tuple[Any, Any]:
    """Material and light of queries as far as f_2D sees them: both, or None."""
    return (material, light) if network.asks == "all" else (None, None)


def left_over(
    geometry: Geometry, mask: Bool[Array, "N"], queries: int
) -> tuple[Int[Array, "M"], Bool[Array, "M"]]:
    """Rows that are not in level 0, `queries` of them at even steps."""
    finest = jnp.where(geometry.levels[0].mask, geometry.finest, mask.size)
    free, _, total = compact(mask.at[finest].set(False, mode="drop"), mask.size)
    number = jnp.arange(queries, dtype=jnp.int32)
    step = jnp.maximum(total.astype(jnp.float32) / queries, 1.0)
    place = ((number.astype(jnp.float32) + 0.5) * step).astype(jnp.int32)
    return free[jnp.minimum(place, mask.size - 1)], number < total

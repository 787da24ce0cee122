"""Everything about a cloud that no parameter enters: levels, edges, weights.

Every search has capacities, collected in one `Limits`, and reports its demand under the
same name.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key

from ginn_jax.architecture import Conv, Network
from ginn_jax.candidates import PACKET
from ginn_jax.density import kde_weight
from ginn_jax.facets import Around, facet_field, smooth_normals
from ginn_jax.hierarchy import same_side
from ginn_jax.levels import build_levels, grid_of, with_normals
from ginn_jax.limits import Demands, Limits
from ginn_jax.packets import Edges
from ginn_jax.receptive_field import (
    Field,
    Oriented,
    kernel_inputs,
    point_area,
    surface_weight,
    window,
)
from ginn_jax.searches import area_search, needs_areas, search, transposed
from ginn_jax.voxels import VoxelGrid


class Geometry(NamedTuple):
    """What f_3D and f_2D need of a cloud.

    levels  the hierarchy, finest first; `finest` are its points' rows in the cloud
    fields  the receptive field of each convolution of f_3D
    area    the area each finest point stands for, where senders are so weighted
    grid    the finest level, ready for f_2D's search
    facets  the samples around each finest point, where facets are smoothed
    around  the cloud, ready to be searched for those around queries
    kept    which points of the cloud each level holds, by name
    """

    levels: tuple[Oriented, ...]
    finest: Int[Array, "N"]
    fields: dict[str, Field]
    area: Array | None
    grid: VoxelGrid
    facets: Field | None = None
    around: Around | None = None
    kept: Bool[Array, "L N"] | None = None


def turn_edges(edges: Edges, senders: int, receivers: int) -> Edges:
    """The same pairs the other way round; receivers are then in no order."""
    real = edges.receiver < receivers
    return Edges(
        jnp.where(real, edges.receiver, 0),
        jnp.where(real, edges.sender, senders),
        edges.demand,
    )


def receptive_field(
    network: Network,
    conv: Conv,
    senders: Oriented,
    receivers: Oriented,
    edges: Edges,
    area: Array | None,
    taper: float = 0.0,
) -> Field:
    """Kernel inputs and weights of every edge; `area` is of the senders."""
    radius = jnp.float32(conv.radius)
    inputs = kernel_inputs(senders, receivers, edges, radius, network.oriented)
    count = receivers.mask.shape[0]
    if area is None:
        given = senders.position, edges, count, radius, conv.bandwidth
        weight = kde_weight(*given)
    else:
        weight = surface_weight(area, edges, count, radius)
    if taper:
        weight = weight * window(inputs, taper)
    real = edges.demand.edges
    return Field(edges.sender, edges.receiver, inputs, weight, real)


def build_geometry(
    network: Network,
    limits: Limits,
    cloud: Oriented,
    names: Int[Array, "N"] | None = None,
    kept_before: Bool[Array, "L N"] | None = None,
    *,
    key: Key[Array, ""],
) -> tuple[Geometry, Demands]:
    """All of f_3D's geometry; wrong where a demand exceeds its limit.

    `names` and `kept_before`: see `build_levels`.
    """
    (levels, rows, kept), (grids, found), demands = build_levels(
        network, limits, cloud, names, kept_before, key=key
    )
    facets, around = None, None
    if network.smooth:
        around = Around(cloud, grid_of(network, grids, -1, cloud))
        facets, more = facet_field(network, limits, around, levels[0])
        levels = with_normals(levels, smooth_normals(facets, around, levels[0]), rows)
        demands |= more
    finest = levels[0]
    for conv in reversed(network.encoder):
        if conv.name in found:
            continue
        receivers = levels[conv.target]
        twin = transposed(network, conv)
        if twin in found:
            count = levels[conv.source].mask.shape[0]
            found[conv.name] = turn_edges(found[twin], receivers.mask.shape[0], count)
            continue
        grid = grid_of(network, grids, conv.source, levels[conv.source])
        found[conv.name], more = search(
            conv, limits, grid, receivers, taper=network.taper
        )
        demands |= more
    areas = _level_areas(network, levels, found)
    if needs_areas(network):
        conv = area_search(network)
        edges, more = search(conv, limits, grid_of(network, grids, 0, finest), finest)
        areas[0] = _areas(network, finest, edges, conv.radius)
        demands |= more
    fields = {}
    for conv in network.encoder:
        ends = levels[conv.source], levels[conv.target]
        given = *ends, found[conv.name], areas.get(conv.source), network.taper
        fields[conv.name] = receptive_field(network, conv, *given)
    grid = grid_of(network, grids, 0, finest)
    known = levels, rows[0], fields, areas.get(0), grid
    return Geometry(*known, facets, around, kept), demands


def _level_areas(
    network: Network, levels: Sequence[Oriented], found: dict[str, Edges]
) -> dict[int, Array]:
    """Point areas of each level, from the convolution within it."""
    if network.density == "kde":
        return {}
    within = {c.source: c for c in network.encoder if c.source == c.target}
    return {
        i: _areas(network, levels[i], found[c.name], c.radius)
        for i, c in within.items()
    }


def _areas(network: Network, points: Oriented, edges: Edges, radius: float) -> Array:
    """The area that each point stands for, of its own side if the network tells."""
    counted = same_side(points.normal, edges) if network.sided else None
    ends = points.position, points.mask, edges
    return point_area(*ends, jnp.float32(radius), counted)


def build_query_field(
    network: Network,
    limits: Limits,
    finest: Oriented,
    grid: VoxelGrid,
    area: Array | None,
    queries: Oriented,
    packet: int = PACKET,
) -> tuple[Field, Demands]:
    """The field of f_2D: from the finest level, its grid and areas, to the queries."""
    edges, demands = search(network.query, limits, grid, queries, packet)
    ends = finest, queries, edges, area
    return receptive_field(network, network.query, *ends), demands

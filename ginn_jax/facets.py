"""Facets smoothed: normals and light as means over the samples of the surface around.

A mesh of few faces has a normal and an irradiance of its own on each, and both jump
between them. What leaves a medium does not: it is a mean over all light that entered
near by. Networks learn that from objects whose facets are finer than their points; of a
coarser mesh they would draw the facets.

Near samples count more than far ones, by one minus the squared distance over the
radius, and those that face alike more than others, by the squared cosine; those that
face away do not count.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ginn_jax.architecture import QUERY, Network
from ginn_jax.candidates import PACKET
from ginn_jax.limits import Demands, Limits
from ginn_jax.mcconv import weighted_sum
from ginn_jax.receptive_field import Field, Oriented, kernel_inputs
from ginn_jax.searches import facet_searches, search

# What a point's own counts for: all where no sample is around it, else next to nothing.
OWN = 1e-3


class Around(NamedTuple):
    """The samples of a cloud and the light on them; `grid`: a `VoxelGrid` where JAX
    searches them, else None."""

    points: Oriented
    grid: Any
    light: Float[Any, "C N L"] | None = None


def facet_field(
    network: Network,
    limits: Limits,
    around: Around,
    receivers: Oriented,
    target: int = 0,
    packet: int = PACKET,
) -> tuple[Field, Demands]:
    """The samples around each receiver, of level 0 or queries, and what they weigh."""
    conv = next(c for c in facet_searches(network) if c.target == target)
    edges, demands = search(conv, limits, around.grid, receivers, packet)
    ends = around.points, receivers, edges, jnp.float32(conv.radius)
    inputs = kernel_inputs(*ends, oriented=True)
    near, alike = (jnp.maximum(a, 0.0) for a in (1 - inputs[6], inputs[5]))
    weight = near * alike**2
    count = edges.demand.edges
    return Field(edges.sender, edges.receiver, inputs[:0], weight, count), demands


def facet_means(
    field: Field, samples: Float[Array, "N K"], own: Float[Array, "M K"]
) -> Float[Array, "M K"]:
    """The mean of what the samples around each receiver have, and of its `own`."""
    both = jnp.pad(samples, ((0, 0), (0, 1)), constant_values=1.0)
    total = weighted_sum(field.weight[None], both, field, own.shape[0])
    return (total[:, :-1] + OWN * own) / (total[:, -1:] + OWN)


def smooth_normals(
    field: Field, around: Around, receivers: Oriented
) -> Float[Array, "M 3"]:
    """Unit normals of the receivers; none is lost, for all that count face its way."""
    mean = facet_means(field, around.points.normal, receivers.normal)
    squared = jnp.sum(mean**2, axis=1, keepdims=True)
    return mean / jnp.sqrt(jnp.where(receivers.mask[:, None], squared, 1.0))


def smooth_light(
    field: Field, samples: Float[Array, "C N L"], own: Float[Array, "C M L"]
) -> Float[Array, "C M L"]:
    """The light on the receivers, all channels at once."""
    flat = (jnp.moveaxis(a, 0, 1).reshape(a.shape[1], -1) for a in (samples, own))
    mean = facet_means(field, *flat)
    return jnp.moveaxis(mean.reshape(own.shape[1], -1, own.shape[2]), 1, 0)


def smooth_queries(
    network: Network,
    limits: Limits,
    around: Around | None,
    queries: Oriented,
    packet: int = PACKET,
) -> tuple[Oriented, Field | None, Demands]:
    """Queries with smooth normals and the samples around them, where facets are
    smoothed."""
    if around is None:
        return queries, None, {}
    given = network, limits, around, queries
    field, demands = facet_field(*given, target=QUERY, packet=packet)
    normal = smooth_normals(field, around, queries)
    return queries._replace(normal=normal), field, demands

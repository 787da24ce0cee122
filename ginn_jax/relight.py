"""Relighting: the geometry, the kernels and the gates of a scene, kept for any light.

A network that is linear in light, on a scene that does not move, is one linear map from
the light at the points to the light at the queries. What it takes to apply that map is
computed once: hierarchy, neighbours, kernel values and gates.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from ginn_jax.architecture import Network
from ginn_jax.errors import InputError
from ginn_jax.example import points_asked, queries_asked
from ginn_jax.geometry import (
    Demands,
    Limits,
    build_geometry,
    build_query_field,
    exceeded,
    raise_limits,
)
from ginn_jax.image import BLOCK, SLACK, only, pad_channels, take_rows
from ginn_jax.lit_clouds import LitCloud, network_numbers
from ginn_jax.mcconv import apply_stored, stored_kernel
from ginn_jax.neighbors import bucket, pad_rows
from ginn_jax.network import GATES, Code, Encoder, Shader, Variables
from ginn_jax.process import ALONE
from ginn_jax.receptive_field import Field, Oriented, in_coherent_order
from ginn_jax.voxels import VoxelGrid


class Layer(NamedTuple):
    """A convolution of light, and the gated linear map before it if there is one."""

    field: Field
    stored: Float[Array, "K E"]
    gate: Float[Array, "C N K"] | None
    mix: Float[Array, "V K"] | None


class ScenePlan(NamedTuple):
    """f_3D for any light. `rows` are those of level 0 in the cloud."""

    layers: dict[str, Layer]
    gate: Float[Array, "C N K"]
    mix: Float[Array, "V K"]
    rows: Int[Array, "N"]
    free: Float[Array, "C N K"]
    points: Oriented
    grid: VoxelGrid
    area: Array | None


class QueryPlan(NamedTuple):
    """f_2D of one block of queries for any light; `order` is how they were sorted."""

    layer: Layer
    gate: Float[Array, "C M K"]
    mix: Float[Array, "V K"]
    order: Int[Array, "M"]


class Relightable(NamedTuple):
    """A cloud and queries, ready for any light; host-level, blocks over devices."""

    scene: ScenePlan
    blocks: tuple[QueryPlan, ...]


def plan_scene(
    network: Network,
    limits: Limits,
    variables: Variables,
    cloud: Oriented,
    material: Float[Array, "C N A"],
    key: Key[Array, ""],
) -> tuple[ScenePlan, Demands]:
    """All of f_3D that does not depend on the light."""
    cloud, order = in_coherent_order(cloud)
    geometry, demands = build_geometry(network, limits, cloud, key=key)
    finest = geometry.levels[0]
    rows = order[geometry.finest]
    dark = jnp.zeros((finest.mask.size, network.lights))

    def gates(material: Float[Array, "N A"]) -> tuple[Array, Any]:
        given = points_asked(finest, *take_rows((material, None), rows, finest.mask))
        encoder = Encoder(network, train=False)
        attributes = given._replace(light=dark)
        code, kept = encoder.apply(
            variables["encoder"], *attributes, geometry, mutable=[GATES]
        )
        return code.free, kept[GATES]

    free, kept = jax.vmap(gates)(material)
    weights = variables["encoder"]["params"]
    layers = {
        name: _layer(field, weights[name], kept[name])
        for name, field in geometry.fields.items()
    }
    gate, mix = _gate(kept["latent_light"], weights["latent_light"])
    ends = rows, free, finest, geometry.grid, geometry.area
    return ScenePlan(layers, gate, mix, *ends), demands


def _layer(field: Field, weights: Any, kept: Any) -> Layer:
    """What a convolution of light takes; without `kept` no gate comes before it."""
    kernels = weights["kernel"].b3.size
    if kept is None:
        return Layer(field, stored_kernel(weights["kernel"], kernels // 2, field), None, None)
    gate, mix = _gate(kept["Gate_0"], weights["Gate_0"])
    first = kernels - mix.shape[1]
    return Layer(field, stored_kernel(weights["kernel"], first, field), gate, mix)


def _gate(kept: Any, weights: Any) -> tuple[Array, Array]:
    return kept["gate"][0], weights["light"]["kernel"]


def plan_queries(
    network: Network,
    limits: Limits,
    variables: Variables,
    scene: ScenePlan,
    queries: Oriented,
    material: Float[Array, "C M A"],
) -> tuple[QueryPlan, Demands]:
    """All of f_2D, for one block of queries, that does not depend on the light."""
    queries, order = in_coherent_order(queries)
    ends = scene.points, scene.grid, scene.area
    field, demands = build_query_field(network, limits, *ends, queries)
    dark = jnp.zeros((queries.mask.size, network.lights))
    senders = jnp.zeros((scene.points.mask.size, scene.mix.shape[1]))

    def gates(free: Array, material: Array) -> Any:
        numbers = take_rows((material, dark), order, queries.mask)
        asked = queries_asked(network, queries, *numbers)
        given = Code(free, senders), *asked, queries.mask, field
        shader = Shader(network, train=False)
        return shader.apply(variables["shader"], *given, mutable=[GATES])[1][GATES]

    kept = jax.vmap(gates)(scene.free, material)
    weights = variables["shader"]["params"]
    layer = _layer(field, weights[network.query.name], None)
    gate, mix = _gate(kept["out_light"], weights["out_light"])
    return QueryPlan(layer, gate, mix, order), demands


def light_codes(
    network: Network, plan: ScenePlan, light: Float[Array, "C N L"]
) -> Float[Array, "C N K"]:
    """f_3D of a light at the points of the cloud."""
    x = jnp.where(plan.points.mask[:, None], light[:, plan.rows], 0.0)
    done: dict[str, Array] = {}
    for conv in network.encoder:
        layer = plan.layers[conv.name]
        receivers = _receivers(network, plan, conv.name)
        x = _apply(layer, x, receivers)
        if conv.skip is not None:
            x = jnp.concatenate([done[conv.skip], x], axis=-1)
        done[conv.name] = x
    return plan.gate * (x @ plan.mix)

"""Relighting: the geometry, the kernels and the gates of a scene, kept for any light.

A network that is linear in light, on a scene that does not move, is one linear map from
the light at the points to the light at the queries. What it takes to apply that map is
computed once: hierarchy, neighbours, kernel values and gates.
"""

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
    levels: tuple[Oriented, ...]
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
        mine, _ = take_rows((material, None), rows, finest.mask)
        given = points_asked(finest, mine, dark)
        encoder = Encoder(network, train=False)
        code, kept = encoder.apply(
            variables["encoder"], *given, geometry, mutable=[GATES]
        )
        return code.free, kept[GATES]

    free, kept = jax.vmap(gates)(material)
    weights = variables["encoder"]["params"]
    layers = {
        name: _layer(field, weights[name], kept[name])
        for name, field in geometry.fields.items()
    }
    gate, mix = _gate(kept["latent_light"], weights["latent_light"])
    ends = rows, free, geometry.levels, geometry.grid, geometry.area
    return ScenePlan(layers, gate, mix, *ends), demands


def _layer(field: Field, weights: Any, kept: Any) -> Layer:
    """What a convolution of light takes; without `kept` no gate comes before it."""
    kernel = weights["kernel"]
    # Free features come first; as many of the light follow.
    stored = stored_kernel(kernel, kernel.b3.size // 2, field)
    if kept is None:
        return Layer(field, stored, None, None)
    return Layer(field, stored, *_gate(kept["Gate_0"], weights["Gate_0"]))


def _gate(kept: Any, weights: Any) -> tuple[Array, Array]:
    return kept["value"][0], weights["light"]["kernel"]


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
    ends = scene.levels[0], scene.grid, scene.area
    field, demands = build_query_field(network, limits, *ends, queries)
    dark = jnp.zeros((queries.mask.size, network.lights))
    senders = jnp.zeros((scene.levels[0].mask.size, scene.mix.shape[1]))

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
    mask = plan.levels[0].mask[:, None]
    x = jnp.where(mask, light[:, plan.rows], 0.0)
    done: dict[str, Array] = {}
    for conv in network.encoder:
        x = _apply(plan.layers[conv.name], x, plan.levels[conv.target].mask.size)
        if conv.skip is not None:
            x = jnp.concatenate([done[conv.skip], x], axis=-1)
        done[conv.name] = x
    return plan.gate * (x @ plan.mix)


def _apply(
    layer: Layer, light: Float[Array, "C N V"], receivers: int
) -> Float[Array, "C M K"]:
    """Gate, mix and convolve all channels of a light at once."""
    if layer.gate is not None and layer.mix is not None:
        light = layer.gate * (light @ layer.mix)
    channels, _, width = light.shape
    rows = jnp.moveaxis(light, 0, 1).reshape(-1, channels * width)
    found = apply_stored(layer.stored, rows, layer.field, receivers)
    return jnp.moveaxis(found.reshape(receivers, channels, width), 1, 0)


def light_queries(
    plan: QueryPlan,
    codes: Float[Array, "C N K"],
    light: Float[Array, "C M L"] | None,
) -> Float[Array, "C M"]:
    """f_2D of one block of queries from the codes of a light."""
    x = _apply(plan.layer, codes, plan.order.size)
    if light is not None:
        x = jnp.concatenate([x, light[:, plan.order]], axis=-1)
    values = jnp.sum(plan.gate * (x @ plan.mix), axis=-1)
    return jnp.zeros_like(values).at[:, plan.order].set(values)


_plan_scene = jax.jit(plan_scene, static_argnums=(0, 1))
_plan_queries = jax.jit(plan_queries, static_argnums=(0, 1))
_light_codes = jax.jit(light_codes, static_argnums=0, compiler_options=ALONE)
_light_queries = jax.jit(light_queries, compiler_options=ALONE)


def prepare_relighting(
    network: Network,
    limits: Limits,
    variables: Variables,
    cloud: LitCloud,
    queries: LitCloud,
    *,
    key: Key[Array, ""],
) -> tuple[Relightable, Limits]:
    """A cloud and queries made ready for any light; the limits that sufficed.

    Raises:
        InputError: a network that is not linear in light.
    """
    if not network.linear:
        raise InputError("this network is not linear in light: shade it anew instead")
    rows = bucket(len(cloud.position))
    points, material = _padded(cloud, slice(None), rows)
    while True:
        scene, demands = _plan_scene(network, limits, variables, points, material, key)
        if not (short := exceeded(limits, demands)):
            break
        limits = raise_limits(limits, short, SLACK)
    size = min(BLOCK, bucket(len(queries.position)))
    while True:
        flat = only(limits, network.query.name)
        blocks, short = [], {}
        for number, first in enumerate(range(0, len(queries.position), size)):
            block = _padded(queries, slice(first, first + size), size)
            plan, demands = _plan_queries(network, flat, variables, scene, *block)
            device = jax.devices()[number % len(jax.devices())]
            blocks.append(jax.device_put(plan, device))
            short |= exceeded(limits, jax.device_get(demands))
        if not short:
            return Relightable(scene, tuple(blocks)), limits
        limits = raise_limits(limits, short, SLACK)


def _padded(cloud: LitCloud, rows: slice, size: int) -> tuple[Oriented, Any]:
    """Some rows of a cloud as an encoder takes them, padded to `size`."""
    position, mask = pad_rows(np.asarray(cloud.position[rows], np.float32), size)
    normal, _ = pad_rows(np.asarray(cloud.normal[rows], np.float32), size)
    material = network_numbers(cloud)[0][:, rows]
    return Oriented(position, normal, mask), pad_channels(material, size)


def relight(
    network: Network, ready: Relightable, cloud: LitCloud, queries: LitCloud
) -> Float[np.ndarray, "M 3"]:
    """Values at the queries under the light that `cloud` and `queries` now carry.

    Geometry and material must be those that were prepared.
    """
    rows = bucket(len(cloud.position))
    light = pad_channels(network_numbers(cloud)[1], rows)
    codes = _light_codes(network, ready.scene, light)
    copies = [jax.device_put(codes, device) for device in jax.devices()]
    beams = network_numbers(queries)[1] if network.asks == "all" else None
    size, parts = min(BLOCK, bucket(len(queries.position))), []
    for number, plan in enumerate(ready.blocks):
        rows = slice(number * size, (number + 1) * size)
        own = None if beams is None else pad_channels(beams[:, rows], size)
        parts.append(_light_queries(plan, copies[number % len(copies)], own))
    values = np.concatenate([np.asarray(part) for part in parts], axis=1)
    return np.maximum(values[:, : len(queries.position)].T, 0.0)

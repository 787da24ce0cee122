"""Relighting: what does not depend on the light, kept for any light.

Of a scene that does not move, hierarchy, neighbours and the values of all kernels stay;
for another light only features are gathered, weighted and added up anew.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from ginn_jax.architecture import Network
from ginn_jax.blocks import (
    block_size,
    channels_in_turns,
    everywhere,
    for_each_block,
    in_rows,
    in_turns,
    pad_channels,
    pad_points,
)
from ginn_jax.checks import unit_rows
from ginn_jax.dataset import center_of
from ginn_jax.geometry import Geometry, build_geometry
from ginn_jax.inference import cloud_limits, query_limits
from ginn_jax.limits import (
    Demands,
    Limits,
    in_fitting_room,
    only,
    say_raised,
    without,
)
from ginn_jax.lit_clouds import LitCloud, network_numbers
from ginn_jax.mcconv import stored_kernel
from ginn_jax.neighbors import bucket
from ginn_jax.network import STORED, Code, Variables
from ginn_jax.process import ALONE
from ginn_jax.receptive_field import Oriented, in_coherent_order
from ginn_jax.shading import (
    Asking,
    Searched,
    encode_channels,
    search_queries,
    shade_channels,
)


class ScenePlan(NamedTuple):
    """f_3D for any light: geometry, kernel values, and how the cloud was sorted."""

    geometry: Geometry
    stored: dict[str, Any]
    order: Int[Array, "N"]
    mask: Bool[Array, "N"]


class QueryPlan(NamedTuple):
    """f_2D of one block of queries for any light: geometry and kernel values."""

    asking: Asking
    stored: dict[str, Any]


class Relightable(NamedTuple):
    """A cloud and queries, ready for any light; a turn has a block on every device."""

    scene: ScenePlan
    turns: tuple[QueryPlan, ...]


def plan_scene(
    network: Network,
    limits: Limits,
    variables: Variables,
    cloud: Oriented,
    key: Key[Array, ""],
) -> tuple[ScenePlan, Demands]:
    """All of f_3D that does not depend on the light."""
    mask = cloud.mask
    cloud, order = in_coherent_order(cloud)
    geometry, demands = build_geometry(network, limits, cloud, order, key=key)
    weights = variables["encoder"]["params"]
    stored = {
        name: {"kernel": stored_kernel(weights[name]["kernel"], field)}
        for name, field in geometry.fields.items()
    }
    return ScenePlan(geometry, stored, order, mask), demands


def plan_queries(
    network: Network,
    limits: Limits,
    variables: Variables,
    searched: Searched,
    queries: Oriented,
) -> tuple[QueryPlan, Demands]:
    """All of f_2D, for one block of queries, that does not depend on the light."""
    queries, order = in_coherent_order(queries)
    asking, demands = search_queries(network, limits, searched, queries, order)
    name, weights = network.query.name, variables["shader"]["params"]
    stored = {}
    if not network.splat:
        stored[name] = {"kernel": stored_kernel(weights[name]["kernel"], asking.field)}
    return QueryPlan(asking, stored), demands


def encode_planned(
    network: Network,
    variables: Variables,
    plan: ScenePlan,
    material: Float[Array, "C N A"],
    light: Float[Array, "C N L"],
) -> tuple[Code, Float[Array, "C"], Float[Array, "C N L"] | None]:
    """f_3D of a light, its unit and, where facets are smoothed, all of it in order."""
    ready = {"encoder": variables["encoder"] | {STORED: plan.stored}}
    ends = plan.geometry, plan.order, plan.mask
    code, scale = encode_channels(network, ready, *ends, material, light)
    assert scale is not None
    return code, scale, light[:, plan.order] if plan.geometry.around else None


def shade_planned(
    network: Network,
    variables: Variables,
    plan: QueryPlan,
    code: Code,
    scale: Float[Array, "C"],
    around: Float[Array, "C N L"] | None,
    material: Float[Array, "C M A"] | None,
    light: Float[Array, "C M L"] | None,
) -> Float[Array, "C M"]:
    """f_2D of a light at one block of queries."""
    ready = {"shader": variables["shader"] | {STORED: plan.stored}}
    lit = code, scale, around
    return shade_channels(network, ready, plan.asking, *lit, material, light)


_plan_scene = jax.jit(plan_scene, static_argnums=(0, 1))
_encode_planned = jax.jit(encode_planned, static_argnums=0)


@partial(jax.jit, static_argnums=(0, 1), compiler_options=ALONE)
def _plan_turn(
    network: Network, limits: Limits, shared: Any, turn: Oriented
) -> tuple[QueryPlan, Demands]:
    """`plan_queries` of a block on every device; `shared`: weights, what to search."""

    def plan(shared: Any, block: Oriented) -> tuple[QueryPlan, Demands]:
        variables, searched = shared
        return plan_queries(network, limits, variables, searched, block)

    return for_each_block(plan, shared, turn)


@partial(jax.jit, static_argnums=0, compiler_options=ALONE)
def _shade_turn(network: Network, shared: Any, turn: Any) -> Float[Array, "D C R"]:
    """`shade_planned` of a block on every device; `shared`: weights, codes, light."""

    def shade(shared: Any, block: Any) -> Float[Array, "C R"]:
        (variables, lit), (plan, *numbers) = shared, block
        return shade_planned(network, variables, plan, *lit, *numbers)

    return for_each_block(shade, shared, turn)


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

    Raises `InputError` for points that are not finite or normals not of unit length.
    """
    unit_rows(cloud.position, cloud.normal, "the cloud")
    unit_rows(queries.position, queries.normal, "queries")
    center = center_of(cloud.position)
    rows = bucket(len(cloud.position))
    points = pad_points(center, cloud.position, cloud.normal, rows)
    size = block_size(len(queries.position), lit=True)
    turns = in_turns(center, queries.position, queries.normal, size)

    def plan_points(limits: Limits) -> tuple[ScenePlan, list[Demands]]:
        deep = without(limits, network.query.name)
        plan, demands = _plan_scene(network, deep, variables, points, key)
        return plan, [demands]

    measure = partial(cloud_limits, network, points, key=key)
    scene, sufficed = in_fitting_room(limits, plan_points, measure)

    geometry = scene.geometry
    searched = geometry.levels[0], geometry.grid, geometry.area, geometry.around
    shared = everywhere((variables, searched))

    def plan_turns(limits: Limits) -> tuple[list[QueryPlan], list[Demands]]:
        flat = only(limits, network.query.name)
        made = [_plan_turn(network, flat, shared, turn) for turn in turns]
        return [plan for plan, _ in made], [demands for _, demands in made]

    measure = partial(query_limits, network, searched, turns)
    plans, sufficed = in_fitting_room(sufficed, plan_turns, measure)
    say_raised(limits, sufficed)
    return Relightable(scene, tuple(plans)), sufficed


def relight(
    network: Network,
    variables: Variables,
    ready: Relightable,
    cloud: LitCloud,
    queries: LitCloud,
) -> Float[np.ndarray, "M 3"]:
    """Values at the queries under the light that `cloud` and `queries` now carry.

    Positions and normals must be those that were prepared; material may change.
    """
    rows = bucket(len(cloud.position))
    numbers = (pad_channels(a, rows) for a in network_numbers(cloud))
    lit = _encode_planned(network, variables, ready.scene, *numbers)
    shared = everywhere(({"shader": variables["shader"]}, lit))
    size = block_size(len(queries.position), lit=True)
    asked = network_numbers(queries) if network.asks == "all" else (None, None)
    own = (channels_in_turns(a, size, len(ready.turns)) for a in asked)
    turns = zip(ready.turns, *own, strict=True)
    values = in_rows([_shade_turn(network, shared, turn) for turn in turns])
    return np.maximum(values[: len(queries.position)], 0.0)

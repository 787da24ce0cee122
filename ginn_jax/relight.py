"""Relighting: what does not depend on the light, kept for any light.

Of a scene that does not move, hierarchy, neighbours and the values of all kernels stay;
for another light only features are gathered, weighted and added up anew.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from ginn_jax.architecture import Network
from ginn_jax.block_shading import query_limits
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
from ginn_jax.checks import numbers_of, unit_rows, within_reach
from ginn_jax.dataset import center_of
from ginn_jax.errors import InputError
from ginn_jax.given import check_weights
from ginn_jax.inference import cloud_limits
from ginn_jax.limits import (
    Demands,
    Limits,
    in_fitting_room,
    only,
    say_raised,
    without,
)
from ginn_jax.lit_clouds import LitCloud, network_numbers
from ginn_jax.neighbors import bucket
from ginn_jax.network import Variables
from ginn_jax.plans import (
    QueryPlan,
    ScenePlan,
    encode_planned,
    plan_queries,
    plan_scene,
    shade_planned,
)
from ginn_jax.process import ALONE
from ginn_jax.receptive_field import Oriented
from ginn_jax.searches import check_limits


class Relightable(NamedTuple):
    """A cloud and queries, ready for any light; a turn has a block on every device."""

    scene: ScenePlan
    turns: tuple[QueryPlan, ...]


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

    Raises:
        InputError: an empty cloud, points that are not finite or reach beyond 1e18,
            normals not of unit length, a network that takes no light, or limits or
            weights of another network.
    """
    if not network.lights:
        raise InputError("the network takes no light: give one of gi or sss")
    if not len(cloud.position):
        raise InputError("the cloud is empty: sample at least one point")
    unit_rows(cloud.position, cloud.normal, "the cloud")
    unit_rows(queries.position, queries.normal, "queries")
    within_reach("the cloud", cloud.position)
    within_reach("queries", queries.position)
    check_limits(network, limits)
    check_weights(network, variables)
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

    Raises:
        InputError: another number of points, or material or light as `encode_cloud`.
    """
    check_prepared("the cloud", cloud, ready.scene.mask)
    given, count = network_numbers(cloud), len(cloud.position)
    numbers_of("material", given[0], network.materials, count)
    numbers_of("light", given[1], network.lights, count, least=0.0)
    numbers = (pad_channels(a, bucket(count)) for a in given)
    lit = _encode_planned(network, variables, ready.scene, *numbers)
    shared = everywhere(({"shader": variables["shader"]}, lit))
    check_prepared("queries", queries, *(t.asking.queries.mask for t in ready.turns))
    size = block_size(len(queries.position), lit=True)
    asked: tuple[Any, Any] = None, None
    if network.asks == "all":
        asked = network_numbers(queries)
        count = len(queries.position)
        numbers_of("material of queries", asked[0], network.materials, count)
        numbers_of("light of queries", asked[1], network.lights, count, least=0.0)
    own = (channels_in_turns(a, size, len(ready.turns)) for a in asked)
    turns = zip(ready.turns, *own, strict=True)
    values = [_shade_turn(network, shared, turn) for turn in turns]
    if not values:
        return np.zeros((0, 3), np.float32)
    return np.maximum(in_rows(values)[: len(queries.position)], 0.0)


def check_prepared(what: str, points: LitCloud, *masks: Bool[Array, "_ *_"]) -> None:
    """Raise `InputError` unless these are as many points as were prepared."""
    prepared = sum(int(np.sum(mask)) for mask in masks)
    if len(points.position) != prepared:
        raise InputError(
            f"{what} has {len(points.position)} points, {prepared} were prepared: "
            "prepare them anew"
        )

"""What a network computes of a scene that no light changes, and what a light does."""

from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float, Int, Key

from ginn_jax.architecture import Network
from ginn_jax.geometry import Geometry, build_geometry
from ginn_jax.limits import Demands, Limits
from ginn_jax.mcconv import stored_kernel
from ginn_jax.network import STORED, Code, Variables
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
    own = {conv.name for conv in network.encoder if not conv.mixes}
    stored = {
        name: {"kernel": stored_kernel(weights[name]["kernel"], field)}
        for name, field in geometry.fields.items()
        if name in own
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
    if not (network.splat or network.query.mixes):
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

"""f_3D of a cloud and f_2D of a block of queries, with all their geometry.

Every colour channel goes through the same network. Geometry and kernels do not depend
on the channel and are computed once.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from ginn_jax.architecture import Network
from ginn_jax.dataset import safe_inverse, unit_light
from ginn_jax.example import points_asked, queries_asked
from ginn_jax.geometry import Geometry, build_geometry, build_query_field
from ginn_jax.limits import Demands, Limits
from ginn_jax.network import Code, Encoder, Shader, Variables
from ginn_jax.receptive_field import Field, Oriented, in_coherent_order
from ginn_jax.voxels import VoxelGrid


class Encoded(NamedTuple):
    """What f_2D needs of a cloud: its finest level, searchable, with codes.

    Where there is light, `code` has a leading axis of channels and `scale` is the mean
    light of each channel; else `scale` is None. `points` are relative to `center`.
    """

    points: Oriented
    grid: VoxelGrid
    area: Array | None
    code: Code
    scale: Float[Array, "C"] | None
    center: Float[Any, "3"] | None = None


def encode(
    network: Network,
    limits: Limits,
    variables: Variables,
    cloud: Oriented,
    material: Float[Array, "C N A"] | None,
    light: Float[Array, "C N L"] | None,
    key: Key[Array, ""],
) -> tuple[Encoded, Demands]:
    """f_3D with all its geometry."""
    mask = cloud.mask
    cloud, order = in_coherent_order(cloud)
    geometry, demands = build_geometry(network, limits, cloud, order, key=key)
    rows = order[geometry.finest]
    code, scale = encode_channels(
        network, variables, geometry, rows, mask, material, light
    )
    ends = geometry.levels[0], geometry.grid, geometry.area
    return Encoded(*ends, code, scale), demands


def cloud_demands(
    network: Network, limits: Limits, cloud: Oriented, key: Key[Array, ""]
) -> Demands:
    """What `encode` needs of every capacity, without f_3D itself."""
    cloud, order = in_coherent_order(cloud)
    return build_geometry(network, limits, cloud, order, key=key)[1]


def encode_channels(
    network: Network,
    variables: Variables,
    geometry: Geometry,
    rows: Int[Array, "K"],
    mask: Bool[Array, "N"],
    material: Float[Array, "C N A"] | None,
    light: Float[Array, "C N L"] | None,
) -> tuple[Code, Float[Array, "C"] | None]:
    """f_3D of every channel, and its unit of light; `rows` of the cloud are level 0."""
    finest = geometry.levels[0]

    def channel(material: Array | None, light: Array | None) -> tuple[Code, Any]:
        scale = None
        if light is not None:
            light, scale = unit_light(light, mask)
        given = points_asked(finest, *take_rows((material, light), rows, finest.mask))
        encoder = Encoder(network, train=False)
        code: Any = encoder.apply(variables["encoder"], *given, geometry)
        return code, scale

    return per_channel(channel, material, light)


def shade(
    network: Network,
    limits: Limits,
    variables: Variables,
    encoded: Encoded,
    queries: Oriented,
    material: Float[Array, "C M A"] | None = None,
    light: Float[Array, "C M L"] | None = None,
    *,
    coherent: bool = False,
) -> tuple[Float[Array, "*C M"], Demands]:
    """f_2D with its search, for one block of queries in any order.

    Where they come `coherent`, neighbours together, sorting them is left out.
    """
    order = None
    if not coherent:
        queries, order = in_coherent_order(queries)
    finest = encoded.points, encoded.grid, encoded.area
    given = network, limits, *finest, queries
    field, demands = build_query_field(*given, dense=coherent)
    lit = encoded.code, encoded.scale
    numbers = material, light
    values = shade_channels(network, variables, field, queries, order, *lit, *numbers)
    return values, demands


def query_demands(
    network: Network,
    limits: Limits,
    finest: tuple[Oriented, VoxelGrid, Array | None],
    queries: Oriented,
    coherent: bool = False,
) -> Demands:
    """What `shade` needs of every capacity, without f_2D itself."""
    queries = queries if coherent else in_coherent_order(queries)[0]
    return build_query_field(network, limits, *finest, queries, dense=coherent)[1]


def shade_channels(
    network: Network,
    variables: Variables,
    field: Field,
    queries: Oriented,
    order: Int[Array, "M"] | None,
    code: Code,
    scale: Float[Array, "C"] | None,
    material: Float[Array, "C M A"] | None,
    light: Float[Array, "C M L"] | None,
) -> Float[Array, "*C M"]:
    """f_2D of every channel; `order`: the rows that sorted queries came from."""

    def channel(
        code: Code, scale: Array | None, material: Array | None, light: Array | None
    ) -> Float[Array, "M"]:
        if light is not None and scale is not None:
            light = light * safe_inverse(scale)
        numbers = take_rows((material, light), order, queries.mask)
        asked = queries_asked(network, queries, *numbers)
        shader = Shader(network, train=False)
        values: Any = shader.apply(
            variables["shader"], code, *asked, queries.mask, field
        )
        if order is not None:
            values = jnp.zeros_like(values).at[order].set(values)
        return values if scale is None else values * scale

    material, light = numbers_asked(network, material, light)
    return per_channel(channel, code, scale, material, light)


def numbers_asked(network: Network, material: Any, light: Any) -> tuple[Any, Any]:
    """Material and light of queries as far as f_2D sees them: both, or None."""
    return (material, light) if network.asks == "all" else (None, None)


def per_channel(function: Any, *arrays: Any) -> Any:
    """`function` for every channel.

    Without light (the second argument is None) there is one channel and no axis of it.
    """
    return function(*arrays) if arrays[1] is None else jax.vmap(function)(*arrays)


def take_rows(
    columns: tuple[Array | None, Array | None],
    rows: Int[Array, "M"] | None,
    mask: Bool[Array, "M"],
) -> tuple[Array | None, ...]:
    """Rows of what there is, or all in their order, zero where masked."""
    taken = (a if a is None or rows is None else a[rows] for a in columns)
    return tuple(None if a is None else jnp.where(mask[:, None], a, 0.0) for a in taken)

"""f_3D of a cloud and f_2D of a block of queries, with all their geometry.

Every colour channel goes through the same network. Geometry and kernels do not depend
on the channel and are computed once.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from ginn_jax.architecture import Network
from ginn_jax.candidates import DENSE_PACKET, PACKET
from ginn_jax.dataset import safe_inverse, unit_light
from ginn_jax.example import numbers_asked, points_asked, queries_asked, real_rows
from ginn_jax.facets import Around, smooth_light, smooth_queries
from ginn_jax.geometry import Geometry, build_geometry, build_query_field
from ginn_jax.limits import Demands, Limits
from ginn_jax.network import Code, Encoder, Shader, Variables
from ginn_jax.receptive_field import Field, Oriented, in_coherent_order

# The finest level, its grid and the areas of its points; the samples around queries.
Searched = tuple[Oriented, Any, Array | None, Around | None]


class Asking(NamedTuple):
    """Queries with their fields; `order` are the rows they came from, if sorted."""

    queries: Oriented
    order: Int[Array, "M"] | None
    field: Field
    facets: Field | None


class Encoded(NamedTuple):
    """What f_2D needs of a cloud: its finest level, with codes.

    `grid` is a `VoxelGrid` where JAX made them and searches it, else None.

    Where there is light, `code` has a leading axis of channels and `scale` is the mean
    light of each channel; else `scale` is None. `points` are relative to `center`.
    Where facets are smoothed, `around` are the samples that the queries' are means of.
    `kept` are the samples that each level keeps, by their rows in the cloud.
    """

    points: Oriented
    grid: Any
    area: Float[Any, "N"] | None
    code: Code
    scale: Float[Any, "C"] | None
    center: Float[Any, "3"] | None = None
    around: Around | None = None
    kept: Bool[Any, "L N"] | None = None

    def searched(self) -> Searched:
        """What the searches of f_2D look into."""
        around = self.around
        around = around and around._replace(light=None)
        return self.points, self.grid, self.area, around


def encode(
    network: Network,
    limits: Limits,
    variables: Variables,
    cloud: Oriented,
    material: Float[Array, "C N A"] | None,
    light: Float[Array, "C N L"] | None,
    kept_before: Bool[Array, "L N"] | None,
    key: Key[Array, ""],
) -> tuple[Encoded, Demands]:
    """f_3D with all its geometry; `kept_before` is the `kept` of the frame before."""
    mask = cloud.mask
    cloud, order = in_coherent_order(cloud)
    geometry, demands = build_geometry(
        network, limits, cloud, order, kept_before, key=key
    )
    code, scale = encode_channels(
        network, variables, geometry, order, mask, material, light
    )
    around = geometry.around
    if around is not None and light is not None:
        around = around._replace(light=light[:, order])
    ends = geometry.levels[0], geometry.grid, geometry.area, code, scale
    return Encoded(*ends, around=around, kept=geometry.kept), demands


def cloud_demands(
    network: Network,
    limits: Limits,
    cloud: Oriented,
    kept_before: Bool[Array, "L N"] | None,
    key: Key[Array, ""],
) -> Demands:
    """What `encode` needs of every capacity, without f_3D itself."""
    cloud, order = in_coherent_order(cloud)
    ends = cloud, order, kept_before
    return build_geometry(network, limits, *ends, key=key)[1]


def encode_channels(
    network: Network,
    variables: Variables,
    geometry: Geometry,
    order: Int[Array, "N"],
    mask: Bool[Array, "N"],
    material: Float[Array, "C N A"] | None,
    light: Float[Array, "C N L"] | None,
) -> tuple[Code, Float[Array, "C"] | None]:
    """f_3D of every channel, and its unit of light.

    `order` are the rows of the cloud, whose `mask` says which are real, in the order of
    the geometry.
    """
    finest, rows = geometry.levels[0], order[geometry.finest]
    smoothed = take_rows(light, rows)
    if geometry.facets is not None and light is not None:
        smoothed = smooth_light(geometry.facets, light[:, order], light[:, rows])

    def channel(
        material: Array | None, light: Array | None, smoothed: Array | None
    ) -> tuple[Code, Any]:
        scale = None
        if light is not None and smoothed is not None:
            _, scale = unit_light(light, mask)
            smoothed = smoothed * safe_inverse(scale)
        given = points_asked(finest, *real_rows((material, smoothed), finest.mask))
        encoder = Encoder(network, train=False)
        code: Any = encoder.apply(variables["encoder"], *given, geometry)
        return code, scale

    return per_channel(channel, take_rows(material, rows), light, smoothed)


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
    ends = encoded.searched(), queries
    asking, demands = search_queries(network, limits, *ends, order, coherent)
    lit = encoded.code, encoded.scale
    around = None if encoded.around is None else encoded.around.light
    given = network, variables, asking, *lit, around
    return shade_channels(*given, material, light), demands


def search_queries(
    network: Network,
    limits: Limits,
    searched: Searched,
    queries: Oriented,
    order: Int[Array, "M"] | None = None,
    dense: bool = False,
) -> tuple[Asking, Demands]:
    """All of f_2D's geometry; `order`: the rows that sorted queries came from.

    `dense` queries, pixels in coherent order, are searched for in larger packets.
    """
    packet = DENSE_PACKET if dense else PACKET
    points, grid, area, around = searched
    queries, facets, more = smooth_queries(network, limits, around, queries, packet)
    given = network, limits, points, grid, area, queries
    field, demands = build_query_field(*given, packet)
    return Asking(queries, order, field, facets), demands | more


def query_demands(
    network: Network,
    limits: Limits,
    searched: Searched,
    queries: Oriented,
    coherent: bool = False,
) -> Demands:
    """What `shade` needs of every capacity, without f_2D itself."""
    queries = queries if coherent else in_coherent_order(queries)[0]
    return search_queries(network, limits, searched, queries, dense=coherent)[1]


def shade_channels(
    network: Network,
    variables: Variables,
    asking: Asking,
    code: Code,
    scale: Float[Array, "C"] | None,
    around: Float[Array, "C N L"] | None,
    material: Float[Array, "C M A"] | None,
    light: Float[Array, "C M L"] | None,
) -> Float[Array, "*C M"]:
    """f_2D of every channel; `around` is the light of the samples around."""
    queries, order, field, facets = asking
    material, light = (
        take_rows(a, order) for a in numbers_asked(network, material, light)
    )
    if facets is not None and around is not None and light is not None:
        light = smooth_light(facets, around, light)

    def channel(
        code: Code, scale: Array | None, material: Array | None, light: Array | None
    ) -> Float[Array, "M"]:
        if light is not None and scale is not None:
            light = light * safe_inverse(scale)
        numbers = real_rows((material, light), queries.mask)
        asked = queries_asked(network, queries, *numbers)
        shader = Shader(network, train=False)
        # Running moments do not ask which points are real.
        senders = jnp.ones(code.free.shape[0], bool)
        values: Any = shader.apply(
            variables["shader"], code, *asked, queries.mask, field, senders
        )
        if order is not None:
            values = jnp.zeros_like(values).at[order].set(values)
        return values if scale is None else values * scale

    return per_channel(channel, code, scale, material, light)


def per_channel(function: Any, *arrays: Any) -> Any:
    """`function` for every channel.

    Without light (the second argument is None) there is one channel and no axis of it.
    """
    return function(*arrays) if arrays[1] is None else jax.vmap(function)(*arrays)


def take_rows(
    numbers: Float[Array, "C N A"] | None, rows: Int[Array, "M"] | None
) -> Float[Array, "C M A"] | None:
    """Rows of what there is, or all in their order."""
    return numbers if numbers is None or rows is None else numbers[:, rows]

"""f_2D in lanes: search, kernel, sum and output of a query in one loop, on a CPU.

The values are those of `shading.shade` but for rounding, at two to three times the
speed, and compiled in a fraction of a second. They have no gradient.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ginn_jax.architecture import Network
from ginn_jax.checks import LARGEST
from ginn_jax.lane_fields import (
    LONGEST,
    Query,
    Sum,
    edge_products,
    field_sum,
    field_tables,
    lanes_usable,
    read_rows,
    safe_inverses,
    smoothed,
)
from ginn_jax.lane_layers import dot, head
from ginn_jax.lanes import Lane, Lanes
from ginn_jax.network import Variables
from ginn_jax.renderer import use_drjit
from ginn_jax.shading import Encoded


class Shaded(NamedTuple):
    """Values of queries, with light in a last axis of channels; how many pairs of a
    query and a point of the cloud that took; and whether the queries should be checked.
    """

    values: Float[np.ndarray, "M *C"]
    pairs: int
    doubtful: bool


def lanes_for(network: Network) -> bool:
    """Whether that f_2D runs in lanes here: on a CPU with a libLLVM, unless it splats,
    or has the paper's density for each pair, batch norms or very wide layers."""
    plain = network.query.before == "raw" and not network.query.mixes
    simple = network.density == "surface" and network.norm != "batch"
    possible = plain and simple and not network.splat
    return possible and _products(network) <= LONGEST and lanes_usable()


def _products(network: Network) -> int:
    """About how many multiplications the program has: every weight stands in it."""
    linear = network.beams or (network.latent if network.linear else 0)
    light = network.lights if network.local or linear else 0
    width = network.latent + linear + light
    colours = 3 if network.lights else 1
    edge = edge_products(network, width, colours)
    seen = 3 + network.materials + network.lights
    row = network.latent + seen + network.head + linear + 2 * light
    return edge + colours * network.head * row


def shade_in_lanes(
    network: Network,
    variables: Variables,
    encoded: Encoded,
    position: Float[np.ndarray, "P 3"],
    normal: Float[np.ndarray, "P 3"],
    material: Float[np.ndarray, "C P A"] | None = None,
    light: Float[np.ndarray, "C P L"] | None = None,
    rows: Int[np.ndarray, "M"] | None = None,
) -> Shaded:
    """f_2D at some rows (default: all) of these points, in any order."""
    dr = use_drjit()
    t = dr.llvm
    count = len(position) if rows is None else len(rows)
    shape = () if encoded.scale is None else encoded.scale.shape
    if count == 0:
        return Shaded(np.zeros((0, *shape), np.float32), 0, False)
    lane = dr.arange(t.UInt32, count)
    if rows is not None:
        lane = dr.gather(t.UInt32, t.UInt32(rows.astype(np.uint32)), lane)
    query = _read_query(dr, lane, encoded, position, normal, material, light)
    values, pairs = _shade(dr, network, variables, encoded, query)
    doubtful = _doubtful(dr, query)
    dr.eval(values, pairs, doubtful)
    found = np.stack([value.numpy() for value in values], axis=-1)
    total, doubt = dr.sum(t.UInt64(pairs)), dr.any(doubtful)
    return Shaded(found.reshape(count, *shape), int(total[0]), bool(doubt))


def _read_query(
    dr: Any,
    lane: Lane,
    encoded: Encoded,
    position: Float[np.ndarray, "P 3"],
    normal: Float[np.ndarray, "P 3"],
    *numbers: Float[np.ndarray, "C P _"] | None,
) -> Query:
    """What is known of the points with these numbers, counted from the centre."""
    t = dr.llvm

    def read(points: np.ndarray) -> Lanes:
        return read_rows(dr, points, lane)

    place = read(np.asarray(position))
    if encoded.center is not None:
        center = (dr.opaque(t.Float64, float(x)) for x in np.asarray(encoded.center))
        place = [t.Float64(x) - c for x, c in zip(place, center, strict=True)]
    place, directed = (
        [t.Float(x) for x in lanes] for lanes in (place, read(np.asarray(normal)))
    )
    material, light = (
        [] if a is None else [[t.Float(x) for x in read(c)] for c in np.asarray(a)]
        for a in numbers
    )
    return Query(place, directed, material, light)


def _doubtful(dr: Any, query: Query) -> Lane:
    """Queries that might be refused: none that should be is not among them."""
    squared = dot(query.normal, query.normal)
    light = [x for lanes in query.light for x in lanes]
    known = [*query.place, *light, *(x for lanes in query.material for x in lanes)]
    sound = dr.abs(squared - 1) < 1.9e-3
    for number in known:
        sound &= dr.abs(number) < LARGEST
    for number in light:
        # By its sign: what is nearly 0 may count as 0.
        sound &= dr.reinterpret_array(dr.llvm.Int32, number) >= 0
    return ~sound


def _shade(
    dr: Any, network: Network, variables: Variables, encoded: Encoded, query: Query
) -> tuple[Lanes, Lane]:
    """The value of every channel, and the number of pairs."""
    params = variables["shader"]["params"]
    scale = [1.0] if encoded.scale is None else np.asarray(encoded.scale).tolist()
    if encoded.around is not None:
        query = smoothed(dr, network, encoded.around, query)
    summed, pairs = _convolved(dr, network, params[network.query.name], encoded, query)
    inverses = safe_inverses(np.array(scale, np.float32)).tolist()
    values = []
    for channel, unit in enumerate(scale):
        inverse = dr.opaque(dr.llvm.Float, inverses[channel])
        light = [x * inverse for x in query.light[channel]] if query.light else []
        own = query.normal + (query.material[channel] if query.material else [])
        free, beams = (part[channel] for part in summed)
        beams = None if encoded.code.light is None else beams
        value = head(dr, network, params, free, beams, own, light)
        values.append(
            value if encoded.scale is None else value * dr.opaque(dr.llvm.Float, unit)
        )
    return values, pairs


def _convolved(
    dr: Any, network: Network, params: Any, encoded: Encoded, query: Query
) -> tuple[tuple[list[Lanes], list[Lanes]], Lane]:
    """Free features and beams of every channel summed around the query, and how many
    points of the cloud are there."""
    channels = _by_channel(encoded)
    free, width = channels[0][0].shape[1], sum(a.shape[1] for a in channels[0])
    radius = network.query.radius
    sum_ = Sum(network.oriented, radius, 0.0, width, len(channels))
    features = [a for parts in channels for a in parts]
    ends = encoded.points, np.asarray(encoded.area)
    (table,) = field_tables(dr, sum_, *ends, [features])
    kernel = [np.asarray(a) for a in params["kernel"]]
    ends = query.place + query.normal
    totals, pairs = field_sum(dr, sum_, kernel, table, ends)
    rows = [totals[i : i + width] for i in range(0, len(totals), width)]
    return ([row[:free] for row in rows], [row[free:] for row in rows]), pairs


def _by_channel(encoded: Encoded) -> list[list[Float[np.ndarray, "N _"]]]:
    """Free features of the points and, if there are, light ones, of each channel."""
    parts = [np.asarray(a) for a in encoded.code if a is not None]
    if encoded.scale is None:
        return [parts]
    return [[a[i] for a in parts] for i in range(len(encoded.scale))]

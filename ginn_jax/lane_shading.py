"""f_2D in lanes: search, kernel, sum and output of a query in one loop, on a CPU.

The values are those of `shading.shade` but for rounding, at two to three times the
speed, and compiled in a fraction of a second. They have no gradient.
"""

import functools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ginn_jax.architecture import Network
from ginn_jax.checks import LARGEST
from ginn_jax.errors import InputError
from ginn_jax.facets import OWN
from ginn_jax.lane_layers import dot, head, perceptron
from ginn_jax.lanes import Lane, Lanes, for_each_near, make_table
from ginn_jax.network import Variables
from ginn_jax.process import LOG, on_cpu
from ginn_jax.receptive_field import pair_inputs
from ginn_jax.renderer import use_drjit
from ginn_jax.shading import Encoded

# Multiplications that Dr.Jit still compiles in seconds.
LONGEST = 1 << 14


class Shaded(NamedTuple):
    """Values of queries, with light in a last axis of channels; how many pairs of a
    query and a point of the cloud that took; and whether the queries should be checked.
    """

    values: Float[np.ndarray, "M *C"]
    pairs: int
    doubtful: bool


class Query(NamedTuple):
    """What is known of the query in each lane; material and light of every channel."""

    place: Lanes
    normal: Lanes
    material: list[Lanes]
    light: list[Lanes]


def lanes_for(network: Network) -> bool:
    """Whether that f_2D runs in lanes here: on a CPU with a libLLVM, unless it splats,
    or has the paper's density for each pair, batch norms or very wide layers."""
    plain = network.query.before == "raw" and not network.query.mixes
    simple = network.density == "surface" and network.norm != "batch"
    possible = plain and simple and not network.splat
    return possible and _products(network) <= LONGEST and _lanes_usable()


def _products(network: Network) -> int:
    """About how many multiplications the program has: every weight stands in it."""
    linear = network.beams or (network.latent if network.linear else 0)
    light = network.lights if network.local or linear else 0
    width = network.latent + linear + light
    group = network.group or width
    kernels = -(-width // group)
    colours = 3 if network.lights else 1
    edge = kernels * network.hidden * (7 + network.hidden + group) + colours * width
    seen = 3 + network.materials + network.lights
    row = network.latent + seen + network.head + linear + 2 * light
    return edge + colours * network.head * row


@functools.cache
def _lanes_usable() -> bool:
    """Whether JAX runs on a CPU here and Dr.Jit finds a libLLVM."""
    if not on_cpu():
        return False
    try:
        use_drjit()
    except InputError as error:
        LOG.warning("f_2D runs in JAX alone, for two to three times as long: %s", error)
        return False
    return True


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
        single = points.dtype == np.float32
        flat = (t.Float if single else t.Float64)(
            np.ascontiguousarray(points, None if single else np.float64).reshape(-1)
        )
        width = points.shape[1]
        return [dr.gather(type(flat), flat, lane * width + i) for i in range(width)]

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
    query = _smoothed(dr, network, encoded, query)
    summed, pairs = _convolved(dr, network, params[network.query.name], encoded, query)
    tiny = float(np.finfo(np.float32).tiny)
    values = []
    for channel, unit in enumerate(scale):
        inverse = dr.opaque(dr.llvm.Float, 1 / unit if unit >= tiny else 0.0)
        light = [x * inverse for x in query.light[channel]] if query.light else []
        own = query.normal + (query.material[channel] if query.material else [])
        free, beams = (part[channel] for part in summed)
        beams = None if encoded.code.light is None else beams
        value = head(dr, network, params, free, beams, own, light)
        values.append(
            value if encoded.scale is None else value * dr.opaque(dr.llvm.Float, unit)
        )
    return values, pairs


def _smoothed(dr: Any, network: Network, encoded: Encoded, query: Query) -> Query:
    """Normal and light as means over the samples around, where facets are smoothed."""
    if encoded.around is None:
        return query
    points, _, light = encoded.around
    position, normal, mask = map(np.asarray, points)
    lit = [] if light is None or not query.light else [*np.asarray(light)]
    columns = [position, normal, *lit]
    table = make_table(dr, position, mask, columns, network.smooth)
    own = query.normal + [x for lanes in query.light for x in lanes]
    ends = query.place + query.normal

    def visit(record: Lanes, totals: Lanes) -> Lanes:
        inputs = pair_inputs(True, ends, record[:6], network.smooth)
        near, alike = (dr.maximum(a, 0) for a in (1 - inputs[6], inputs[5]))
        weight = near * alike**2
        given = [*record[3 : 3 + len(own)], 1.0]
        return [total + weight * x for total, x in zip(totals, given, strict=True)]

    count = len(own) + 1
    (*totals, weight), _ = for_each_near(
        dr, table, network.smooth, query.place, visit, count
    )
    mean = [(a + OWN * b) / (weight + OWN) for a, b in zip(totals, own, strict=True)]
    length = dr.rsqrt(dot(mean[:3], mean[:3]))
    width = network.lights
    light = [mean[i : i + width] for i in range(3, len(mean), width or 1)]
    return query._replace(normal=[x * length for x in mean[:3]], light=light)


def _convolved(
    dr: Any, network: Network, params: Any, encoded: Encoded, query: Query
) -> tuple[tuple[list[Lanes], list[Lanes]], Lane]:
    """Free features and beams of every channel summed around the query, and how many
    points of the cloud are there."""
    radius = network.query.radius
    position, normal, mask = map(np.asarray, encoded.points)
    weight = np.asarray(encoded.area)[:, None] / np.float32(np.pi * radius**2)
    channels = _by_channel(encoded)
    columns = [position, normal, weight, *(a for parts in channels for a in parts)]
    table = make_table(dr, position, mask, columns, radius)
    kernel = [np.asarray(a) for a in params["kernel"]]
    free, width = channels[0][0].shape[1], sum(a.shape[1] for a in channels[0])
    ends = query.place + query.normal

    def visit(record: Lanes, totals: Lanes) -> Lanes:
        inputs = pair_inputs(network.oriented, ends, record[:6], radius)
        values = [v * record[6] for v in perceptron(dr, kernel, inputs, width)]
        given = record[7 : 7 + len(totals)]
        return [
            dr.fma(values[i % width], x, total)
            for i, (total, x) in enumerate(zip(totals, given, strict=True))
        ]

    count = width * len(channels)
    totals, pairs = for_each_near(dr, table, radius, query.place, visit, count)
    rows = [totals[i : i + width] for i in range(0, count, width)]
    return ([row[:free] for row in rows], [row[free:] for row in rows]), pairs


def _by_channel(encoded: Encoded) -> list[list[Float[np.ndarray, "N _"]]]:
    """Free features of the points and, if there are, light ones, of each channel."""
    parts = [np.asarray(a) for a in encoded.code if a is not None]
    if encoded.scale is None:
        return [parts]
    return [[a[i] for a in parts] for i in range(len(encoded.scale))]

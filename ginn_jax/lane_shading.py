"""f_2D in lanes: search, kernel, sum and output of a query in one loop, on a CPU.

The values are those of `shading.shade` but for rounding, at two to three times the
speed, and compiled in a fraction of a second. They have no gradient.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ginn_jax.architecture import Network
from ginn_jax.cells import in_line
from ginn_jax.checks import FAR, LARGEST
from ginn_jax.lane_fields import (
    Query,
    Sum,
    around_table,
    edge_products,
    entries,
    field_sum,
    flat,
    flat_view,
    read_row,
    safe_inverses,
    simple_enough,
    smoothed,
    weighed,
)
from ginn_jax.lane_layers import Constants, as_constants, dot, from_constants, head
from ginn_jax.lanes import (
    Lane,
    Lanes,
    Table,
    in_turn,
    program,
    side_by_side,
    sort_points,
)
from ginn_jax.network import Variables
from ginn_jax.receptive_field import Oriented
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
    possible = plain and not network.splat
    return possible and simple_enough(network, _products(network))


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


@in_turn
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
    count = len(position) if rows is None else len(rows)
    shape = () if encoded.scale is None else encoded.scale.shape
    if count == 0:
        return Shaded(np.zeros((0, *shape), np.float32), 0, False)
    numbers = ([] if a is None else [*np.asarray(a)] for a in (material, light))
    own = [[np.asarray(position), np.asarray(normal)], *numbers]
    asked = [[flat_view(dr, a) for a in arrays] for arrays in own]
    sum_, free, *tables = _tables(dr, network, encoded, light is not None)
    weights = as_constants(variables["shader"]["params"])
    run = program(_shade, network, sum_, free, weights)
    found = run(_lanes_of(dr, count, rows), asked, _units(dr, encoded), *tables)
    values, pairs, doubtful = found
    total, doubt = dr.sum(dr.llvm.UInt64(pairs)), dr.any(doubtful)
    values = np.stack([value.numpy() for value in values], axis=-1)
    return Shaded(values.reshape(count, *shape), int(total[0]), bool(doubt))


def _lanes_of(dr: Any, count: int, rows: Int[np.ndarray, "M"] | None) -> Lane:
    """The row of each lane."""
    if rows is not None:
        return dr.llvm.UInt32(in_line(rows.astype(np.uint32)))
    lane = dr.arange(dr.llvm.UInt32, count)
    dr.make_opaque(lane)
    return lane


def _units(dr: Any, encoded: Encoded) -> tuple[Any, Any, Any]:
    """The centre, the units of light, and what light is multiplied by."""
    center = np.zeros(3) if encoded.center is None else np.asarray(encoded.center)
    scale = np.ones(1) if encoded.scale is None else np.asarray(encoded.scale)
    scale = scale.astype(np.float32)
    center = flat(dr, center.astype(np.float64))
    return center, flat(dr, scale), flat(dr, safe_inverses(scale))


def _tables(
    dr: Any, network: Network, encoded: Encoded, lit: bool
) -> tuple[Sum, int, Lanes, Lanes, Lanes | None]:
    """What is summed, and how many features are free; the finest points, their codes
    and where those of each channel begin, and the samples around, to be searched."""
    codes = [np.asarray(a) for a in encoded.code if a is not None]
    width = sum(a.shape[-1] for a in codes)
    channels = 1 if encoded.scale is None else len(encoded.scale)
    radius, oriented = network.query.radius, network.oriented
    sum_ = Sum(oriented, radius, 0.0, width, channels, channels)
    points = Oriented(*map(np.asarray, encoded.points))
    found = sort_points(points.position, points.mask, radius)
    table = weighed(dr, found, points, np.asarray(encoded.area), radius)
    starts = np.arange(channels, dtype=np.uint32) * np.uint32(len(found.rows))
    records = dr.llvm.Float(side_by_side(codes, found.rows).reshape(-1))
    features = records, dr.llvm.UInt32(in_line(starts))
    around = encoded.around
    near = None if around is None else list(around_table(dr, network, around, lit))
    return sum_, codes[0].shape[-1], list(table), list(features), near


def _read_query(
    dr: Any, network: Network, lane: Lane, asked: list[Lanes], center: Lane
) -> Query:
    """What is known of the points in these rows, counted from the centre."""
    single = dr.llvm.Float
    ends, *numbers = asked
    widths = network.materials, network.lights
    place, normal = (read_row(dr, a, 3, lane) for a in ends)
    exact = zip(map(dr.llvm.Float64, place), entries(dr, center, 3), strict=True)
    return Query(
        [single(x - origin) for x, origin in exact],
        [single(x) for x in normal],
        *(
            [[single(x) for x in read_row(dr, a, width, lane)] for a in arrays]
            for arrays, width in zip(numbers, widths, strict=True)
        ),
    )


def _doubtful(dr: Any, query: Query, center: Lane) -> Lane:
    """Queries that might be refused: none that should be is not among them."""
    squared = dot(query.normal, query.normal)
    light = [x for lanes in query.light for x in lanes]
    known = [*light, *(x for lanes in query.material for x in lanes)]
    sound = dr.abs(squared - 1) < 1.9e-3
    for x, origin in zip(query.place, entries(dr, center, 3), strict=True):
        # Rounding of x is of its own size or the origin's, which is within FAR.
        sound &= dr.abs(x + origin) < 0.99 * FAR
    for number in known:
        sound &= dr.abs(number) < LARGEST
    for number in light:
        # By its sign: what is nearly 0 may count as 0.
        sound &= dr.reinterpret_array(dr.llvm.Int32, number) >= 0
    return ~sound


def _shade(
    dr: Any,
    network: Network,
    sum_: Sum,
    free: int,
    weights: Constants,
    lane: Lane,
    asked: list[Lanes],
    units: tuple[Any, Any, Any],
    table: Lanes,
    features: Lanes,
    around: Lanes | None,
) -> tuple[Lanes, Lane, Lane]:
    """The value of every channel, the number of pairs, and whether to check."""
    params = from_constants(weights)
    query = _read_query(dr, network, lane, asked, units[0])
    doubtful = _doubtful(dr, query, units[0])
    if around is not None:
        query = smoothed(dr, network, Table(*around), query)
    kernel, ends = params[network.query.name]["kernel"], query.place + query.normal
    codes, starts = features
    given = kernel, Table(*table), codes, starts, ends
    totals, pairs = field_sum(dr, sum_, *given)
    shared = (entries(dr, numbers, sum_.channels) for numbers in units[1:])
    values = []
    for channel, (unit, inverse) in enumerate(zip(*shared, strict=True)):
        light = [x * inverse for x in query.light[channel]] if query.light else []
        own = query.normal + (query.material[channel] if query.material else [])
        row = totals[channel * sum_.width : (channel + 1) * sum_.width]
        beams = row[free:] if free < sum_.width else None
        value = head(dr, network, params, row[:free], beams, own, light)
        values.append(value * unit)
    return values, pairs, doubtful

"""f_3D in lanes, on a CPU: Poisson disks, areas and convolutions with a point in each.

The codes are those of `shading.encode` but for rounding. There are no lists of edges,
hence no capacities, and no gradient.
"""

from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from ginn_jax.architecture import Conv, Network
from ginn_jax.facets import Around
from ginn_jax.hierarchy import draw_lots
from ginn_jax.lane_disks import levels_in_lanes
from ginn_jax.lane_fields import (
    Query,
    Sum,
    areas,
    around_table,
    edge_products,
    field_sum,
    field_tables,
    flat,
    read_row,
    safe_inverses,
    simple_enough,
    smoothed,
    write_row,
)
from ginn_jax.lane_layers import Constants, as_constants, from_constants
from ginn_jax.lanes import Lane, Lanes, Table, program
from ginn_jax.neighbors import bucket
from ginn_jax.network import Code, Variables
from ginn_jax.receptive_field import Oriented
from ginn_jax.renderer import use_drjit
from ginn_jax.row_layers import Parts, enter_rows, latent_rows, rows_before
from ginn_jax.searches import area_search, needs_areas
from ginn_jax.shading import Encoded

# Sums of a program; of more it would compile for long. Wide layers have few points.
MOST_SUMS = 96

Numbers = Float[np.ndarray, "_ _ _"] | None
Areas = dict[int, Float[np.ndarray, "_"]]


def encodes_in_lanes(network: Network) -> bool:
    """Whether f_3D of that network runs in lanes here: on a CPU with a libLLVM, unless
    it mixes, or has the paper's density for each pair, batch norms or very wide layers.
    """
    if any(conv.mixes for conv in network.encoder):
        return False
    # In light's width, which is no less than that of any feature; at once.
    widest = [2 * conv.channels + network.beams for conv in network.encoder]
    longest = edge_products(network, max(widest, default=1), 1)
    return simple_enough(network, longest)


def encode_in_lanes(
    network: Network,
    variables: Variables,
    cloud: Oriented,
    material: Numbers = None,
    light: Numbers = None,
    kept_before: Bool[Any, "L R"] | None = None,
    *,
    key: Key[Array, ""],
) -> Encoded:
    """`shading.encode` of a cloud without padding; only names go up to the next bucket.

    Everything is in NumPy's memory and checked by the caller, `kept_before` as there.
    The finest points come in an order of their own, and in no grid.
    """
    dr, count = use_drjit(), len(cloud.mask)
    # Drawn in the background, level after level.
    lots = [_lots(bucket(count), i, key) for i in range(len(network.levels))]
    before = None if kept_before is None else np.asarray(kept_before)
    rows = levels_in_lanes(dr, network, cloud.position, cloud.normal, lots, before)
    # Copied: the caller may write on.
    kept = jax.tree.map(np.array, (cloud, light)) if network.smooth else None
    around = None if kept is None else Around(kept[0], None, kept[1])
    material, given = (_take(a, rows[0]) for a in (material, light))
    if around is not None:
        cloud, given = _smooth(dr, network, around, rows[0], given)
    scale = None
    if light is not None and given is not None:
        scale = (light[..., 0] / np.float32(count)).sum(axis=1)
        given = given * safe_inverses(scale)[:, None, None]
    levels = [Oriented(*(a.take(some, 0) for a in cloud)) for some in rows]
    lanes = [_ends_of(dr, level) for level in levels]
    area = _areas(dr, network, levels, lanes)
    normal = _padded(levels[0].normal)
    own = normal, _padded(material), _padded(given)
    code = _encode(dr, network, variables, levels, lanes, area, own)
    free, beams = (
        None if a is None else np.asarray(a)[:, : len(rows[0])] for a in code
    )
    if scale is None:
        free = np.asarray(free)[0]
    ends = levels[0], None, area[0], Code(free, beams), scale
    return Encoded(*ends, around=around, kept=_named(rows, bucket(count)))


@partial(jax.jit, static_argnums=0)
def _lots(count: int, level: Any, key: Key[Array, ""]) -> Any:
    """The lots of a level, by name, as `build_levels` draws them."""
    return draw_lots(count, key=jax.random.fold_in(key, level))


def _named(rows: list[Int[np.ndarray, "_"]], count: int) -> Bool[np.ndarray, "L R"]:
    """Which names are among the rows of each level."""
    kept = np.zeros((len(rows), count), bool)
    for level, some in zip(kept, rows, strict=True):
        level[some] = True
    return kept


def _take(numbers: Numbers, rows: Int[np.ndarray, "M"]) -> Numbers:
    return None if numbers is None else numbers.take(rows, 1)


def _padded(numbers: Float[np.ndarray, "*C N K"] | None) -> Any:
    """Zero rows up to the next bucket."""
    if numbers is None:
        return None
    missing = bucket(numbers.shape[-2]) - numbers.shape[-2]
    return np.pad(numbers, [(0, 0)] * (numbers.ndim - 2) + [(0, missing), (0, 0)])


def _ends_of(dr: Any, points: Oriented) -> Lanes:
    """Position and normal of a point in each lane."""
    lane = dr.arange(dr.llvm.UInt32, len(points.mask))
    ends = [x for a in points[:2] for x in read_row(dr, flat(dr, a), 3, lane)]
    dr.eval(ends)
    return ends


def _smooth(
    dr: Any,
    network: Network,
    around: Around,
    rows: Int[np.ndarray, "M"],
    light: Numbers,
) -> tuple[Oriented, Numbers]:
    """The cloud with normals of some rows smoothed, and the light on these."""
    position, normal, mask = around.points
    lane = dr.arange(dr.llvm.UInt32, len(rows))
    dr.make_opaque(lane)
    own = [flat(dr, a.take(rows, 0)) for a in (position, normal)]
    lit = [flat(dr, a) for a in ([] if light is None else light)]
    table = around_table(dr, network, around, light is not None)
    found = program(_smoothed, network)(lane, own, lit, list(table))
    turned, *lit = (np.stack([x.numpy() for x in lanes], axis=1) for lanes in found)
    normal = normal.copy()
    normal[rows] = turned
    return Oriented(position, normal, mask), np.stack(lit) if lit else None


def _smoothed(
    dr: Any, network: Network, lane: Lane, own: Lanes, lit: Lanes, table: Lanes
) -> list[Lanes]:
    """Normal and light of every channel."""
    ends = (read_row(dr, a, 3, lane) for a in own)
    light = [read_row(dr, a, network.lights, lane) for a in lit]
    query = smoothed(dr, network, Table(*table), Query(*ends, light=light))
    return [query.normal, *query.light]


def _areas(
    dr: Any, network: Network, levels: list[Oriented], lanes: list[Lanes]
) -> Areas:
    """The area that points stand for, of each level that needs to know."""
    within = [c for c in network.encoder if c.source == c.target]
    within += [area_search(network)] if needs_areas(network) else []
    found = {
        c.source: areas(dr, levels[c.source], lanes[c.source], c.radius, network.sided)
        for c in within
    }
    return {level: lane.numpy() for level, lane in found.items()}


def _encode(
    dr: Any,
    network: Network,
    variables: Variables,
    levels: list[Oriented],
    lanes: list[Lanes],
    area: Areas,
    own: tuple[Any, Any, Any],
) -> Code:
    """The convolutions one after the other, and the code; `own`: normal, material and
    light of the finest points."""
    weights = variables["encoder"]["params"]
    parts: Parts = (enter_rows(network, *own),)
    done: dict[str, Parts] = {}
    for conv in network.encoder:
        x = rows_before(network, conv, weights[conv.name], parts)
        ends = levels[conv.source], area[conv.source], lanes[conv.target]
        kernel = weights[conv.name]["kernel"]
        found = _convolve(dr, network, conv, kernel, *ends, x)
        parts = found if conv.skip is None else (*done[conv.skip], *found)
        done[conv.name] = parts
    return latent_rows(network, weights, parts, own[2])


def _convolve(
    dr: Any,
    network: Network,
    conv: Conv,
    kernel: Any,
    senders: Oriented,
    area: Float[np.ndarray, "N"],
    receivers: Lanes,
    code: Code,
) -> Parts:
    """One convolution of every channel."""
    t, count, rows = dr.llvm, len(senders.mask), dr.width(receivers[0])
    parts = [np.asarray(a)[:, :count] for a in code if a is not None]
    channels, width = len(parts[0]), sum(a.shape[2] for a in parts)
    together = channels if channels * width <= MOST_SUMS else 1
    groups = [
        [a[channel] for channel in range(i, i + together) for a in parts]
        for i in range(0, channels, together)
    ]
    sum_ = Sum(network.oriented, conv.radius, network.taper, width, together)
    convolve = program(_convolved, sum_, as_constants(kernel))
    sums = []
    for table in field_tables(dr, sum_, senders, area, groups):
        blank = dr.zeros(t.Float, bucket(rows) * together * width)
        dr.make_opaque(blank)
        found = convolve(list(table), receivers, blank).numpy()
        sums.append(np.moveaxis(found.reshape(-1, together, width), 1, 0))
    found, free = np.concatenate(sums), parts[0].shape[2]
    return (Code(found[..., :free], found[..., free:] if len(parts) > 1 else None),)


def _convolved(
    dr: Any, sum_: Sum, kernel: Constants, table: Lanes, ends: Lanes, blank: Any
) -> Any:
    """The sums, row after row, written where there is nothing yet."""
    totals, _ = field_sum(dr, sum_, from_constants(kernel), Table(*table), ends)
    write_row(dr, blank, totals, dr.arange(dr.llvm.UInt32, dr.width(ends[0])))
    return blank

"""f_3D in lanes, on a CPU: Poisson disks, areas and convolutions with a point in each.

The codes are those of `shading.encode` but for rounding. There are no lists of edges,
hence no capacities, and no gradient.
"""

from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Int, Key

from ginn_jax.architecture import Network, reach
from ginn_jax.facets import Around
from ginn_jax.hierarchy import draw_lots
from ginn_jax.lane_convolutions import (
    Numbers,
    SortedLevel,
    convolve,
)
from ginn_jax.lane_disks import levels_in_lanes
from ginn_jax.lane_fields import (
    Query,
    areas,
    around_table,
    edge_products,
    flat,
    read_row,
    safe_inverses,
    simple_enough,
    smoothed,
)
from ginn_jax.lane_rows import feature_widths
from ginn_jax.lanes import Lane, Lanes, Table, in_turn, program, sort_points
from ginn_jax.neighbors import bucket
from ginn_jax.network import Code, Variables
from ginn_jax.receptive_field import Oriented
from ginn_jax.renderer import use_drjit
from ginn_jax.searches import area_search, needs_areas
from ginn_jax.shading import Encoded


def encodes_in_lanes(network: Network) -> bool:
    """Whether f_3D of that network runs in lanes here: on a CPU with a libLLVM, unless
    it mixes, or has the paper's density for each pair, batch norms or very wide layers.
    """
    if any(conv.mixes for conv in network.encoder):
        return False
    *widths, _ = feature_widths(network)
    widest = max(map(sum, widths), default=1)
    return simple_enough(network, edge_products(network, widest, 1))


@in_turn
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
    levels = [_level(dr, network, cloud, i, some) for i, some in enumerate(rows)]
    weights = variables["encoder"]["params"]
    free, beams = convolve(dr, network, weights, levels, material, given)
    code = Code(free[0] if scale is None else free, beams)
    known = levels[0].points, None, levels[0].area, code, scale
    return Encoded(*known, around=around, kept=_named(rows, bucket(count)))


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


def _level(
    dr: Any, network: Network, cloud: Oriented, number: int, rows: Int[np.ndarray, "M"]
) -> SortedLevel:
    """A level of these rows of the cloud, sorted for all that is summed over it."""
    points = Oriented(*(a.take(rows, 0) for a in cloud))
    lanes, area, tables = _ends_of(dr, points), None, {}
    ends = points, lanes
    weighing = [area_search(network)] if needs_areas(network) else []
    from_here = [c for c in (*weighing, *network.encoder) if c.source == number]
    # The area first: it is summed while the rest is sorted.
    for conv in sorted(from_here, key=lambda conv: conv.target != number):
        far = reach(conv.radius, network.taper)
        tables[conv.name] = sort_points(points.position, points.mask, far)
        if conv.target == number:
            area = areas(dr, tables[conv.name], *ends, conv.radius, network.sided)
    # To ask for it later would be to wait for all that is under way by then.
    return SortedLevel(points, lanes, None if area is None else area.numpy(), tables)

"""Radius search in a voxel hash of fixed capacity: jit-compatible, nothing dropped.

Points are sorted by cell key. The cells are as wide as the radius across x and y and
finer along z, so the neighbours of a query lie in at most 3 x 3 columns, and in each
column in one contiguous run of the sorted order, found by binary search: no table,
no bucket that could overflow, no hash collision. Runs are expanded to candidates by
a prefix sum, candidates within the radius are compacted to edges by another.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

COLUMNS = 9
TABLE = 1 << 16
LAYERS = (1 << 31) // TABLE - 1
FINENESS = 8
NO_KEY = np.iinfo(np.int32).max
PairFilter = Callable[[Int[Array, "E"], Int[Array, "E"]], Bool[Array, "E"]]


@dataclass(frozen=True)
class EdgeLimit:
    """Capacities of one search: candidates looked at, edges kept."""

    candidates: int
    edges: int


class Demand(NamedTuple):
    """What a search needed. `edges` is a lower bound if `candidates` overflowed."""

    candidates: Int[Array, ""]
    edges: Int[Array, ""]


class VoxelGrid(NamedTuple):
    """Points sorted by column, then height; masked points come last.

    Rows `column_start[c] : column_start[c + 1]` lie in column c = x * shape[1] + y.
    """

    position: Float[Array, "N 3"]
    index: Int[Array, "N"]
    layer: Int[Array, "N"]
    column_start: Int[Array, "T"]
    origin: Float[Array, "3"]
    cell: Float[Array, "3"]
    shape: Int[Array, "3"]


class Runs(NamedTuple):
    """Per query and column, the run [start, start + length) of sorted points."""

    start: Int[Array, "M 9"]
    length: Int[Array, "M 9"]


class Edges(NamedTuple):
    """Pairs closer than the radius, `receiver` ascending; padding has receiver M."""

    sender: Int[Array, "E"]
    receiver: Int[Array, "E"]
    demand: Demand


def prefix_sum(counts: Int[Array, "K"]) -> Int[Array, "K"]:
    """Inclusive prefix sum of small non-negative counts."""
    return jnp.cumsum(counts)


def saturating_sum(counts: Int[Array, "..."]) -> Int[Array, ""]:
    """Sum of counts that stops at the largest int32 instead of wrapping around."""
    wraps = jnp.sum(counts.astype(jnp.float32)) > 2.0**31 - 1024
    return jnp.where(wraps, jnp.int32(NO_KEY), jnp.sum(counts))


def build_grid(
    position: Float[Array, "N 3"], mask: Bool[Array, "N"], radius: Float[Array, ""]
) -> VoxelGrid:
    """Sort points by cell. Cells grow where the cloud has more than `TABLE` columns."""
    origin, extent = _bounds(position, mask)
    cell = _cell_size(extent, radius)
    shape = jnp.floor(extent / cell).astype(jnp.int32) + 1
    x, y, layer = jnp.floor((position - origin) / cell).astype(jnp.int32).T
    column = jnp.where(mask, x * shape[1] + y, TABLE)
    key = jnp.where(mask, column * (LAYERS + 1) + layer, NO_KEY)
    key, index = jax.lax.sort((key, jnp.arange(key.size, dtype=jnp.int32)), num_keys=1)
    count = jnp.zeros(TABLE, jnp.int32).at[column].add(1, mode="drop")
    start = jnp.concatenate([jnp.zeros(1, jnp.int32), prefix_sum(count)])
    return VoxelGrid(position[index], index, layer[index], start, origin, cell, shape)


def _bounds(
    position: Float[Array, "N 3"], mask: Bool[Array, "N"]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Lowest corner and extent of the points that count; zero where none does."""
    far = jnp.float32(jnp.finfo(jnp.float32).max)
    low = jnp.min(jnp.where(mask[:, None], position, far), axis=0)
    high = jnp.max(jnp.where(mask[:, None], position, -far), axis=0)
    occupied = jnp.any(mask)
    return jnp.where(occupied, low, 0.0), jnp.where(occupied, high - low, 0.0)


def _cell_size(
    extent: Float[Array, "3"], radius: Float[Array, ""]
) -> Float[Array, "3"]:
    """Radius across x and y, finer along z, unless the tables would not hold them."""
    width, depth, height = extent
    # 1.0001: rounding must not put two neighbours three columns apart.
    across = jnp.max(
        jnp.stack(
            [
                1.0001 * radius,
                2 * jnp.sqrt(width / TABLE) * jnp.sqrt(depth),
                4 * jnp.maximum(width, depth) / TABLE,
            ]
        )
    )
    along = jnp.maximum(radius / FINENESS, height / (LAYERS - 1))
    return jnp.stack([across, across, along])


def _cell_of(
    grid: VoxelGrid, coordinate: Float[Array, "*K"], axis: int
) -> Int[Array, "*K"]:
    """Cell along one axis; -1 or `shape` where it lies outside. Monotone."""
    cell = jnp.floor((coordinate - grid.origin[axis]) / grid.cell[axis])
    top = grid.shape[axis].astype(jnp.float32)
    return jnp.clip(cell, -1.0, top).astype(jnp.int32)


def find_runs(
    grid: VoxelGrid,
    query: Float[Array, "M 3"],
    query_mask: Bool[Array, "M"],
    radius: Float[Array, ""],
) -> Runs:
    """The 9 runs that hold every point closer than `radius` to each query.

    A column at distance d across x and y is scanned only over z +- sqrt(r^2 - d^2).
    """
    x, y, z = query.T
    column_x, gap_x, inside_x = _columns_beside(grid, x, 0, radius)
    column_y, gap_y, inside_y = _columns_beside(grid, y, 1, radius)
    room = (1.00001 * radius) ** 2 - gap_x[:, None] ** 2 - gap_y[None] ** 2
    valid = inside_x[:, None] & inside_y[None] & (room > 0) & query_mask
    column = jnp.where(valid, column_x[:, None] * grid.shape[1] + column_y[None], 0)
    first = grid.column_start[column]
    last = jnp.where(valid, grid.column_start[column + 1], first)
    half = jnp.sqrt(jnp.maximum(room, 0.0))
    low, high = _cell_of(grid, z - half, 2), _cell_of(grid, z + half, 2)
    start, stop = _narrow(grid.layer, first, last, low, high + 1)
    return Runs(*(a.reshape(COLUMNS, -1).T for a in (start, stop - start)))


def _columns_beside(
    grid: VoxelGrid, coordinate: Float[Array, "M"], axis: int, radius: Float[Array, ""]
) -> tuple[Int[Array, "3 M"], Float[Array, "3 M"], Bool[Array, "3 M"]]:
    """The 3 cells within reach along one axis, the gap to each, and which exist."""
    reach = 1.00001 * radius
    first = _cell_of(grid, coordinate - reach, axis)
    last = _cell_of(grid, coordinate + reach, axis)
    cell = first + jnp.arange(3, dtype=jnp.int32)[:, None]
    inside = (cell >= 0) & (cell < grid.shape[axis]) & (cell <= last)
    wall = grid.origin[axis] + cell.astype(jnp.float32) * grid.cell[axis]
    # A relative slack: walls are rounded differently from the cells of points.
    slack = 1e-5 * (radius + jnp.abs(coordinate) + jnp.abs(grid.origin[axis]))
    outside = jnp.maximum(wall - coordinate, coordinate - wall - grid.cell[axis])
    return cell, jnp.maximum(outside - slack, 0.0), inside


def _narrow(
    layer: Int[Array, "N"],
    first: Int[Array, "*K"],
    last: Int[Array, "*K"],
    low: Int[Array, "*K"],
    high: Int[Array, "*K"],
) -> tuple[Int[Array, "*K"], Int[Array, "*K"]]:
    """Binary search in rows first..last for those with low <= layer < high."""
    steps = 32 - jax.lax.clz(jnp.max(last - first, initial=0))

    def halve(
        _: Int[Array, ""], state: tuple[Int[Array, "*K"], ...]
    ) -> tuple[Array, ...]:
        a, b, c, d = state
        left, right = (a + b) // 2, (c + d) // 2
        up = (a < b) & (layer[left] < low)
        a, b = jnp.where(up, left + 1, a), jnp.where(up, b, left)
        up = (c < d) & (layer[right] < high)
        c, d = jnp.where(up, right + 1, c), jnp.where(up, d, right)
        return a, b, c, d

    start, _, stop, _ = jax.lax.fori_loop(0, steps, halve, (first, last, first, last))
    return start, stop


class Expansion(NamedTuple):
    """Slots of all ranges one after the other: range, its row, and whether real."""

    owner: Int[Array, "K"]
    row: Int[Array, "K"]
    valid: Bool[Array, "K"]


def expand_ranges(
    start: Int[Array, "R"],
    length: Int[Array, "R"],
    capacity: int,
    first: Int[Array, ""] | int = 0,
) -> tuple[Expansion, Int[Array, ""]]:
    """List rows start .. start + length of every range, and how many there are in all.

    `capacity` slots are filled, from slot number `first` of the whole list on.
    """
    stop = prefix_sum(length)
    begin = stop - length
    total = saturating_sum(length)
    earlier = jnp.sum(begin < first, dtype=jnp.int32)
    slot = jnp.where(begin >= first, begin - first, capacity)
    opened = jnp.zeros(capacity, jnp.int32).at[slot].add(1, mode="drop")
    owner = earlier + prefix_sum(opened) - 1
    number = first + jnp.arange(capacity, dtype=jnp.int32)
    return Expansion(owner, number + (start - begin)[owner], number < total), total


def expand_runs(
    runs: Runs, capacity: int, first: Int[Array, ""] | int = 0
) -> tuple[Expansion, Int[Array, ""]]:
    """Candidate pairs of all runs: `owner` is the query, `row` the sorted point."""
    slots, total = expand_ranges(
        runs.start.reshape(-1), runs.length.reshape(-1), capacity, first
    )
    return slots._replace(owner=slots.owner // COLUMNS), total


def compact(
    keep: Bool[Array, "K"], capacity: int
) -> tuple[Int[Array, "E"], Bool[Array, "E"], Int[Array, ""]]:
    """Indices of the True entries in order, which of them are real, and the demand."""
    rank = prefix_sum(keep.astype(jnp.int32))
    slot = jnp.where(keep, rank - 1, capacity)
    index = (
        jnp.zeros(capacity, jnp.int32)
        .at[slot]
        .set(jnp.arange(keep.size, dtype=jnp.int32), mode="drop", unique_indices=True)
    )
    total = rank[-1] if keep.size else jnp.int32(0)
    return index, jnp.arange(capacity, dtype=jnp.int32) < total, total


def radius_edges(
    grid: VoxelGrid,
    query: Float[Array, "M 3"],
    query_mask: Bool[Array, "M"],
    radius: Float[Array, ""],
    limit: EdgeLimit,
    pair_filter: PairFilter | None = None,
) -> Edges:
    """Every (point, query) pair closer than `radius`, sorted by query.

    `radius` must not exceed the one the grid was built for. `pair_filter(sender,
    receiver)` may drop pairs. Where `demand` exceeds `limit`, edges are missing.
    """
    runs = find_runs(grid, query, query_mask, radius)
    (receiver, row, valid), candidates = expand_runs(runs, limit.candidates)
    offset = query[receiver] - grid.position[row]
    keep = valid & (jnp.sum(offset**2, axis=-1) < radius**2)
    if pair_filter is not None:
        keep &= pair_filter(grid.index[row], receiver)
    slot, real, edges = compact(keep, limit.edges)
    sender = jnp.where(real, grid.index[row[slot]], 0)
    receiver = jnp.where(real, receiver[slot], query.shape[0])
    return Edges(sender, receiver, Demand(candidates, edges))

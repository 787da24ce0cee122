"""Points in a voxel grid of fixed tables.

Points are sorted by column (a cell across x and y) and in a column by layer along z, so
the points of a box are one contiguous run of rows in each column under it, found by
binary search: no bucket that could overflow, no hash collision.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from ginn_jax.process import on_cpu
from ginn_jax.ranges import prefix_sum

# Columns: at most as many as points, but for few points.
TABLE, FEWEST = (1 << 16) - 1, 1 << 12
LAYERS = 1 << 15
FINENESS = 8
FINE_ENOUGH = 6


class VoxelGrid(NamedTuple):
    """Points sorted by column, then layer; masked points come last.

    Rows `column_start[c] : column_start[c + 1]` lie in column c = x * shape[1] + y.
    """

    position: Float[Array, "N 3"]
    index: Int[Array, "N"]
    layer: Int[Array, "N"]
    column_start: Int[Array, "T"]
    origin: Float[Array, "3"]
    rate: Float[Array, "3"]
    shape: Int[Array, "3"]


def build_grid(
    position: Float[Array, "N 3"], mask: Bool[Array, "N"], cell: Float[Array, ""]
) -> VoxelGrid:
    """Sort points into columns `cell` wide; wider where the cloud has too many."""
    origin, extent = _bounds(position, mask)
    table = min(max(position.shape[0], FEWEST), TABLE)
    # Points, border and queries have to be rounded alike, or a pair is lost between
    # cells. Of a division XLA makes now one, now a product with the inverse.
    rate = jax.lax.optimization_barrier(1.0 / _cell_size(extent, cell, table))
    shape = jnp.floor(extent * rate).astype(jnp.int32) + 1
    x, y, layer = jnp.floor((position - origin) * rate).astype(jnp.int32).T
    column = jnp.where(mask, x * shape[1] + y, table).astype(jnp.uint32)
    order = stable_order(jnp.where(mask, layer, 0).astype(jnp.uint32), 16)
    order = order[stable_order(column[order], 16)]
    count = jnp.zeros(table, jnp.int32).at[column].add(1, mode="drop")
    start = jnp.concatenate([jnp.zeros(1, jnp.int32), prefix_sum(count)])
    return VoxelGrid(position[order], order, layer[order], start, origin, rate, shape)


def stable_order(key: UInt32[Array, "N"], bits: int) -> Int[Array, "N"]:
    """Rows in ascending order of a key of so many bits, equal keys in order of row.

    Key and row in one word where they fit: XLA sorts a single array several times
    faster than two.
    """
    rows = jnp.arange(key.size, dtype=jnp.int32)
    below = max(key.size - 1, 1).bit_length()
    if bits + below > 32:
        return jax.lax.sort((key, rows), num_keys=1)[1]
    packed = jax.lax.sort((key << below) | rows.astype(jnp.uint32))
    return (packed & jnp.uint32((1 << below) - 1)).astype(jnp.int32)


def morton_order(
    position: Float[Array, "N 3"], mask: Bool[Array, "N"]
) -> Int[Array, "N"]:
    """Rows along a space-filling curve, masked ones last: neighbours come together."""
    room = 31 - max(position.shape[0] - 1, 1).bit_length()
    # One sort has room for so many bits; a large cloud wants finer cells than that.
    bits = room // 3 if room // 3 >= FINE_ENOUGH else min(2 * room // 3, 10)
    code = morton_code(position, mask, bits)
    if 3 * bits <= room:
        return stable_order(code, room)
    order = stable_order(code & jnp.uint32((1 << room) - 1), room)
    return order[stable_order(code[order] >> room, 3 * bits + 1 - room)]


def morton_code(
    position: Float[Array, "N 3"], mask: Bool[Array, "N"], bits: int
) -> UInt32[Array, "N"]:
    """Places along a curve through 2^bits cells an axis; masked points are beyond."""
    origin, extent = _bounds(position, mask)
    side = jnp.max(extent) / (1 << bits)
    cell = jnp.floor((position - origin) / jnp.where(side > 0, side, 1.0))
    cell = jnp.clip(cell, 0, (1 << bits) - 1).astype(jnp.uint32)
    code = jnp.zeros(position.shape[0], jnp.uint32)
    for bit in range(bits):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return jnp.where(mask, code, jnp.uint32(1 << (3 * bits)))


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
    extent: Float[Array, "3"], cell: Float[Array, ""], table: int
) -> Float[Array, "3"]:
    """`cell` across x and y, finer along z, unless the tables would not hold them."""
    width, depth, height = extent
    across = jnp.max(
        jnp.stack(
            [
                cell,
                2.01 * jnp.sqrt(width / table) * jnp.sqrt(depth),
                4.01 * jnp.maximum(width, depth) / table,
            ]
        )
    )
    along = jnp.maximum(cell / FINENESS, height / (LAYERS - 1))
    return jnp.stack([across, across, along])


def cell_of(
    grid: VoxelGrid, coordinate: Float[Array, "*K"], axis: int
) -> Int[Array, "*K"]:
    """Cell along one axis; -1 or `shape` where it lies outside. Monotone."""
    cell = jnp.floor((coordinate - grid.origin[axis]) * grid.rate[axis])
    top = grid.shape[axis].astype(jnp.float32)
    return jnp.clip(cell, -1.0, top).astype(jnp.int32)


def narrow_runs(
    layer: Int[Array, "N"],
    first: Int[Array, "*K"],
    last: Int[Array, "*K"],
    low: Int[Array, "*K"],
    high: Int[Array, "*K"],
) -> tuple[Int[Array, "*K"], Int[Array, "*K"]]:
    """Binary search in rows first..last for those with low <= layer < high.

    On CPU no more steps than these runs need, on a GPU as many as any may: it would
    wait for the host to say how many.
    """
    steps = layer.shape[0].bit_length()
    if on_cpu():
        steps = 32 - jax.lax.clz(jnp.max(last - first, initial=0))

    def halve(
        _: Int[Array, ""], state: tuple[Int[Array, "*K"], ...]
    ) -> tuple[Array, ...]:
        a, b, c, d = state
        left, right = (a + b) >> 1, (c + d) >> 1
        up = (a < b) & (layer[left] < low)
        a, b = jnp.where(up, left + 1, a), jnp.where(up, b, left)
        up = (c < d) & (layer[right] < high)
        c, d = jnp.where(up, right + 1, c), jnp.where(up, d, right)
        return a, b, c, d

    start, _, stop, _ = jax.lax.fori_loop(0, steps, halve, (first, last, first, last))
    return start, stop

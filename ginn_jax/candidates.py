"""Which points queries may be near: packets of queries share one list of candidates.

Those are the points in the grid columns and layers within the radius of the packet's
bounding box. Queries may come in any order: a packet that is spread out costs time,
never an edge. `voxels.morton_order` keeps packets small.

A packet is of 32 queries, of 128 where they lie much closer together than the radius
reaches, as an image's pixels do: fewer lists, hardly longer ones.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ginn_jax.ranges import Slots, fill, range_slots, saturating_sum, tiles_holding
from ginn_jax.voxels import VoxelGrid, cell_of, narrow_runs

PACKET, DENSE_PACKET = 32, 128
WORD = 32


class Columns(NamedTuple):
    """The block of grid columns under every packet, and the box it may reach into."""

    low: Float[Array, "P 3"]
    high: Float[Array, "P 3"]
    first: Int[Array, "P 2"]
    shape: Int[Array, "P 2"]


class Candidates(NamedTuple):
    """Rows of the grid that each packet reaches: `row[start : start + count]`."""

    row: Int[Array, "C"]
    start: Int[Array, "P"]
    count: Int[Array, "P"]


def packet_columns(
    grid: VoxelGrid,
    query: Float[Array, "M 3"],
    mask: Bool[Array, "M"],
    radius: Float[Array, ""],
    packet: int = PACKET,
) -> tuple[Columns, Int[Array, ""]]:
    """The columns that each packet has to look into, and how many in all."""
    far = jnp.float32(jnp.finfo(jnp.float32).max)
    reach = 1.00001 * radius
    low = _of_packets(jnp.minimum, jnp.where(mask[:, None], query, far), packet)
    high = _of_packets(jnp.maximum, jnp.where(mask[:, None], query, -far), packet)
    empty = low[:, :1] > high[:, :1]
    low = jnp.where(empty, 0.0, low) - reach
    high = jnp.where(empty, 0.0, high) + reach
    first = jnp.stack(
        [jnp.maximum(cell_of(grid, low[:, a], a), 0) for a in (0, 1)], axis=1
    )
    last = [
        jnp.minimum(cell_of(grid, high[:, a], a), grid.shape[a] - 1) for a in (0, 1)
    ]
    shape = jnp.maximum(jnp.stack(last, axis=1) - first + 1, 0)
    shape = jnp.where(empty, 0, shape)
    total = saturating_sum(shape[:, 0] * shape[:, 1])
    return Columns(low, high, first, shape), total


def _of_packets(
    extreme: Callable[[Array, Array], Array], query: Float[Array, "M 3"], packet: int
) -> Float[Array, "P 3"]:
    """The extreme of each packet by halving: XLA's own reduction is scalar on CPU."""
    lanes = query.T.reshape(3, -1, packet)
    while lanes.shape[2] > 1:
        lanes = extreme(*jnp.split(lanes, 2, axis=2))
    return lanes[:, :, 0].T


def packet_candidates(
    grid: VoxelGrid,
    under: Columns,
    columns: int,
    candidates: int,
) -> tuple[Candidates, Int[Array, ""]]:
    """Points in the columns and layers that each packet reaches; how many in all."""
    slots = range_slots(under.shape[:, 0] * under.shape[:, 1], columns)
    begin = under.first[:, 0] * grid.shape[1] + under.first[:, 1]
    floor, top = (cell_of(grid, end[:, 2], 2) for end in (under.low, under.high))
    packets = begin, jnp.maximum(under.shape[:, 1], 1), floor, top + 1
    run = partial(_column_run, grid, packets, slots)
    start, length = fill(run, slots.total, columns)
    runs = range_slots(length, candidates, slots.total)
    # The columns of a packet lie side by side, and so do their candidates.
    first = jnp.append(runs.begin, runs.total)[jnp.minimum(slots.begin, columns)]
    shift = start - runs.begin
    row = fill(lambda k: k + shift[runs.owner[k]], runs.total, candidates)
    count = jnp.diff(first, append=runs.total)
    return Candidates(row, first, count), runs.total


def _column_run(
    grid: VoxelGrid,
    packets: tuple[Int[Array, "P"], ...],
    slots: Slots,
    slot: Int[Array, "T"],
) -> tuple[Int[Array, "T"], Int[Array, "T"]]:
    """First row and number of the points that packets reach in one column each.

    `packets` are each one's first column, columns across y, first layer and the layer
    after its last.
    """
    packet = slots.owner[slot]
    begin, deep, floor, top = (of_packet[packet] for of_packet in packets)
    number = slot - slots.begin[packet]
    # Integer division is slow; as numbers are small against 2^22 this one is exact.
    x = (number.astype(jnp.float32) + 0.5) / deep.astype(jnp.float32)
    column = begin + number + x.astype(jnp.int32) * (grid.shape[1] - deep)
    real = slot < slots.total
    column = jnp.where(real, column, 0)
    first = grid.column_start[column]
    last = jnp.where(real, grid.column_start[column + 1], first)
    start, stop = narrow_runs(grid.layer, first, last, floor, top)
    return start, stop - start


def count_words(near: Candidates) -> Int[Array, ""]:
    """How many lists of 32 candidates there are."""
    return jnp.sum(tiles_holding(near.count, WORD), dtype=jnp.int32)

"""Radius search by packets of queries: jit-compatible, fixed capacity, nothing dropped.

Packets of 32 consecutive queries share one list of candidates, the points in the grid
columns and layers within the radius of the packet's bounding box. What is left for the
single query is a dense test against 32 candidates at a time, whose outcome is one word
of bits; edges are listed by counting and selecting bits. So the cost is that of the
edges, not of the candidates.
Queries may come in any order: a packet that is spread out costs time, never an edge.
`voxels.morton_order` keeps packets small.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from ginn_jax.voxels import (
    Expansion,
    VoxelGrid,
    cell_of,
    expand_ranges,
    narrow_runs,
    prefix_sum,
    saturating_sum,
)

PACKET = 32
WORD = 32
TILE = 512
PairFilter = Callable[[Int[Array, "..."], Int[Array, "..."]], Bool[Array, "..."]]


@dataclass(frozen=True)
class EdgeLimit:
    """Capacities of one search.

    columns     grid columns under the packets
    candidates  points that packets reach
    words       lists of 32 candidates
    edges       pairs closer than the radius
    """

    columns: int
    candidates: int
    words: int
    edges: int


class Demand(NamedTuple):
    """What a search needed; a lower bound where an earlier stage overflowed."""

    columns: Int[Array, ""]
    candidates: Int[Array, ""]
    words: Int[Array, ""]
    edges: Int[Array, ""]


class Edges(NamedTuple):
    """Pairs closer than the radius, `receiver` ascending; padding has receiver M."""

    sender: Int[Array, "E"]
    receiver: Int[Array, "E"]
    demand: Demand


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


class Words(NamedTuple):
    """Bit b of `word[l, q]`: query `query[l, q]` is near the list's candidate b.

    One list is 32 candidates of one packet. `order` are the rows of the flat words by
    query, and under a query by list; padding comes last.
    """

    word: UInt32[Array, "L 32"]
    query: Int[Array, "L 32"]
    first: Int[Array, "L"]
    order: Int[Array, "W"]


def radius_edges(
    grid: VoxelGrid,
    query: Float[Array, "M 3"],
    mask: Bool[Array, "M"],
    radius: Float[Array, ""],
    limit: EdgeLimit,
    pair_filter: PairFilter | None = None,
) -> Edges:
    """Every (point, query) pair closer than `radius`, sorted by query.

    `pair_filter(sender, receiver)` may drop pairs; it sees broadcast index arrays.
    Where `demand` exceeds `limit`, edges are missing.
    """
    count = query.shape[0]
    padding = -count % PACKET
    query = jnp.pad(query, ((0, padding), (0, 0)))
    mask = jnp.pad(mask, (0, padding))
    under, columns = packet_columns(grid, query, mask, radius)
    near, candidates = packet_candidates(grid, under, limit.columns, limit.candidates)
    words = packet_words(grid, query, mask, radius, near, limit.words, pair_filter)
    (row, receiver, real), edges = list_bits(words, near, limit.edges)
    sender = jnp.where(real, grid.index[row], 0)
    receiver = jnp.where(real, receiver, count)
    demand = Demand(columns, candidates, count_words(near), edges)
    return Edges(sender, receiver, demand)


def packet_columns(
    grid: VoxelGrid,
    query: Float[Array, "M 3"],
    mask: Bool[Array, "M"],
    radius: Float[Array, ""],
) -> tuple[Columns, Int[Array, ""]]:
    """The columns that each packet has to look into, and how many in all."""
    far = jnp.float32(jnp.finfo(jnp.float32).max)
    reach = 1.00001 * radius
    low = _of_packets(jnp.minimum, jnp.where(mask[:, None], query, far))
    high = _of_packets(jnp.maximum, jnp.where(mask[:, None], query, -far))
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
    extreme: Callable[[Array, Array], Array], query: Float[Array, "M 3"]
) -> Float[Array, "P 3"]:
    """The extreme of each packet by halving: XLA's own reduction is scalar on CPU."""
    lanes = query.T.reshape(3, -1, PACKET)
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
    area = under.shape[:, 0] * under.shape[:, 1]
    slots, _ = expand_ranges(jnp.zeros_like(area), area, columns)
    packet = slots.owner
    deep = jnp.maximum(under.shape[packet, 1], 1)
    x, y = under.first[packet].T + jnp.stack([slots.row // deep, slots.row % deep])
    column = jnp.where(slots.valid, x * grid.shape[1] + y, 0)
    first = grid.column_start[column]
    last = jnp.where(slots.valid, grid.column_start[column + 1], first)
    floor, top = (cell_of(grid, e[packet, 2], 2) for e in (under.low, under.high))
    start, stop = narrow_runs(grid.layer, first, last, floor, top + 1)
    count = jnp.zeros(area.size, jnp.int32)
    count = count.at[packet].add(stop - start, indices_are_sorted=True)
    found, total = expand_ranges(start, stop - start, candidates)
    return Candidates(found.row, prefix_sum(count) - count, count), total


def count_words(near: Candidates) -> Int[Array, ""]:
    """How many lists of 32 candidates there are."""
    return jnp.sum(-(-near.count // WORD), dtype=jnp.int32)


def packet_words(
    grid: VoxelGrid,
    query: Float[Array, "M 3"],
    mask: Bool[Array, "M"],
    radius: Float[Array, ""],
    near: Candidates,
    capacity: int,
    pair_filter: PairFilter | None = None,
    number: Int[Array, "M"] | None = None,
) -> Words:
    """The outcome of testing every query against the candidates of its packet.

    `number` are the queries' own numbers, a permutation, if they are not in order.
    """
    lists = -(-near.count // WORD)
    chunk, total = expand_ranges(jnp.zeros_like(lists), lists, capacity)
    first = near.start[chunk.owner] + WORD * chunk.row
    left = jnp.where(chunk.valid, near.count[chunk.owner] - WORD * chunk.row, 0)
    point, bit = grid.position.T, jnp.arange(WORD, dtype=jnp.int32)
    lane = jnp.where(mask, query.T, jnp.nan).reshape(3, -1, PACKET)

    def test(*lists: Int[Array, "T"]) -> UInt32[Array, "T 32"]:
        packet, first, left = lists
        place = first[:, None] + bit
        row = near.row[jnp.minimum(place, near.row.size - 1)]
        real = (bit < left[:, None]) & (place < near.row.size)
        hit = jnp.float32(0)
        for axis in range(3):
            place = jnp.where(real, point[axis][row], jnp.nan)
            hit += (lane[axis][packet][:, :, None] - place[:, None, :]) ** 2
        hit = hit < radius**2
        if pair_filter is not None:
            own = packet[:, None] * PACKET + jnp.arange(PACKET, dtype=jnp.int32)
            hit &= pair_filter(grid.index[row][:, None, :], own[:, :, None])
        # A sum, so that XLA does not compute a word anew for each edge that looks.
        flags = jnp.uint32(1) << bit.astype(jnp.uint32)
        word = jnp.where(hit, flags, jnp.uint32(0))
        return jnp.sum(word, axis=-1, dtype=jnp.uint32)

    word = _in_tiles(test, (chunk.owner, first, left), total)
    if number is None:
        order = _order_in_packets(chunk, lists)
        number = jnp.arange(query.shape[0], dtype=jnp.int32)
    else:
        order = _order_by_number(chunk, lists, number)
    return Words(word, number.reshape(-1, PACKET)[chunk.owner], first, order)


def _in_tiles(
    test: Callable[..., UInt32[Array, "T 32"]],
    lists: tuple[Int[Array, "L"], ...],
    count: Int[Array, ""],
) -> UInt32[Array, "L 32"]:
    """`test` of the first `count` lists, on CPU in tiles that fit a core's cache."""
    rows = lists[0].shape[0]
    size = min(TILE, rows) if jax.default_backend() == "cpu" else rows

    def fill(tile: Int[Array, ""], word: UInt32[Array, "L 32"]) -> Array:
        start = jnp.minimum(tile * size, rows - size)
        some = [jax.lax.dynamic_slice_in_dim(a, start, size) for a in lists]
        return jax.lax.dynamic_update_slice_in_dim(word, test(*some), start, axis=0)

    nothing = jnp.zeros((rows, PACKET), jnp.uint32)
    tiles = (jnp.minimum(count, rows) + size - 1) // size
    return jax.lax.fori_loop(0, tiles, fill, nothing)


def _order_in_packets(chunk: Expansion, lists: Int[Array, "P"]) -> Int[Array, "W"]:
    """Rows of the words with those of a query side by side, so that its edges will be.

    The words of a packet lie [list, query] and are wanted [query, list].
    """
    capacity = chunk.owner.shape[0]
    begin = prefix_sum(lists) - lists
    width = jnp.clip(capacity - begin, 1, jnp.maximum(lists, 1))
    begin, width = (a[chunk.owner][:, None] for a in (begin, width))
    place = jnp.arange(capacity * PACKET, dtype=jnp.int32).reshape(-1, PACKET)
    inside = place - begin * PACKET
    # Integer division is slow; what rounding spoils is put right.
    query = (inside.astype(jnp.float32) / width.astype(jnp.float32)).astype(jnp.int32)
    query -= (query * width > inside).astype(jnp.int32)
    query += ((query + 1) * width <= inside).astype(jnp.int32)
    order = (begin + inside - query * width) * PACKET + query
    return jnp.where(chunk.valid[:, None], order, place).reshape(-1)


def _order_by_number(
    chunk: Expansion, lists: Int[Array, "P"], number: Int[Array, "M"]
) -> Int[Array, "W"]:
    """The same where queries are numbered otherwise than they lie."""
    rows = chunk.owner.shape[0] * PACKET
    query_lists = jnp.repeat(lists, PACKET)
    begin = jnp.zeros_like(query_lists).at[number].set(query_lists)
    begin = (prefix_sum(begin) - begin)[number]
    place = begin.reshape(-1, PACKET)[chunk.owner] + chunk.row[:, None]
    place = jnp.where(chunk.valid[:, None], place, rows).reshape(-1)
    order = jnp.full(rows, rows - 1, jnp.int32)
    return order.at[place].set(jnp.arange(rows, dtype=jnp.int32), mode="drop")


def list_bits(
    words: Words, near: Candidates, capacity: int
) -> tuple[tuple[Int[Array, "E"], Int[Array, "E"], Bool[Array, "E"]], Int[Array, ""]]:
    """Row, query and validity of every set bit, and how many there are."""
    flat = words.word.reshape(-1)
    hits = jax.lax.population_count(flat[words.order]).astype(jnp.int32)
    slots, total = expand_ranges(jnp.zeros_like(hits), hits, capacity)
    place = words.order[slots.owner]
    bit = select_bit(flat[place], slots.row)
    row = jnp.where(slots.valid, words.first[place // PACKET] + bit, 0)
    return (near.row[row], words.query.reshape(-1)[place], slots.valid), total


def select_bit(word: UInt32[Array, "*E"], rank: Int[Array, "*E"]) -> Int[Array, "*E"]:
    """Place of the set bit that has `rank` set bits below it, by halving."""
    place = jnp.zeros_like(rank)
    for width in (16, 8, 4, 2, 1):
        below = word & jnp.uint32((1 << width) - 1)
        ones = jax.lax.population_count(below).astype(jnp.int32)
        upper = rank >= ones
        rank = jnp.where(upper, rank - ones, rank)
        word = jnp.where(upper, word >> width, word)
        place += jnp.where(upper, width, 0)
    return place

"""Radius search by packets of queries: jit-compatible, fixed capacity, nothing dropped.

Packets of consecutive queries share one list of `candidates`. What is left for the
single query is a dense test against 32 of them at a time, whose outcome is one word of
bits; edges are listed by counting and selecting bits. So the cost is that of the edges,
not of the candidates.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from ginn_jax.candidates import (
    PACKET,
    WORD,
    Candidates,
    count_words,
    packet_candidates,
    packet_columns,
)
from ginn_jax.ranges import Slots, fill, prefix_sum, range_slots, tiles_holding
from ginn_jax.voxels import VoxelGrid

# Words that are computed at a time.
TILE = 1 << 14
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


class Words(NamedTuple):
    """Bit b of `word[l, q]`: query `query[slots.owner[l], q]` is near candidate b of l.

    One list is 32 candidates, from `first` on, of one packet of Q queries. `order` are
    the rows of the flat words by query, and under a query by list; padding comes last.
    """

    word: UInt32[Array, "L Q"]
    query: Int[Array, "P Q"]
    slots: Slots
    first: Int[Array, "L"]
    order: Int[Array, "W"]


def radius_edges(
    grid: VoxelGrid,
    query: Float[Array, "M 3"],
    mask: Bool[Array, "M"],
    radius: Float[Array, ""],
    limit: EdgeLimit,
    pair_filter: PairFilter | None = None,
    packet: int = PACKET,
) -> Edges:
    """Every (point, query) pair closer than `radius`, sorted by query.

    `pair_filter(sender, receiver)` may drop pairs; it sees broadcast index arrays.
    `packet` is how many queries share a list, a power of two.
    Where `demand` exceeds `limit`, edges are missing.
    """
    count = query.shape[0]
    padding = -count % packet
    query = jnp.pad(query, ((0, padding), (0, 0)))
    mask = jnp.pad(mask, (0, padding))
    under, columns = packet_columns(grid, query, mask, radius, packet)
    near, candidates = packet_candidates(grid, under, limit.columns, limit.candidates)
    words = packet_words(grid, query, mask, radius, near, limit.words, pair_filter)
    # Of the candidates, fewer than the edges: what an edge names is looked up once.
    near = near._replace(row=grid.index[near.row])
    (sender, receiver, real), edges = list_bits(words, near, limit.edges)
    sender = jnp.where(real, sender, 0)
    receiver = jnp.where(real, receiver, count)
    demand = Demand(columns, candidates, count_words(near), edges)
    return Edges(sender, receiver, demand)


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
    lists = tiles_holding(near.count, WORD)
    slots = range_slots(lists, capacity)
    packet = query.shape[0] // lists.shape[0]
    point, bit = grid.position.T, jnp.arange(WORD, dtype=jnp.int32)
    lane = jnp.where(mask, query.T, jnp.nan).reshape(3, -1, packet)

    def test(chunk: Int[Array, "T"]) -> tuple[UInt32[Array, "T Q"], Int[Array, "T"]]:
        owner = slots.owner[chunk]
        skipped = WORD * (chunk - slots.begin[owner])
        first, left = near.start[owner] + skipped, near.count[owner] - skipped
        place = first[:, None] + bit
        row = near.row[jnp.minimum(place, near.row.size - 1)]
        real = (bit < left[:, None]) & (place < near.row.size)
        real &= (chunk < slots.total)[:, None]
        hit = jnp.float32(0)
        for axis in range(3):
            place = jnp.where(real, point[axis][row], jnp.nan)
            hit += (lane[axis][owner][:, :, None] - place[:, None, :]) ** 2
        hit = hit < radius**2
        if pair_filter is not None:
            own = owner[:, None] * packet + jnp.arange(packet, dtype=jnp.int32)
            hit &= pair_filter(grid.index[row][:, None, :], own[:, :, None])
        # A sum, so that XLA does not compute a word anew for each edge that looks.
        flags = jnp.uint32(1) << bit.astype(jnp.uint32)
        word = jnp.where(hit, flags, jnp.uint32(0))
        return jnp.sum(word, axis=-1, dtype=jnp.uint32), first

    word, first = fill(test, slots.total, capacity, TILE // packet)
    if number is None:
        order = _order_in_packets(slots, lists, packet)
        number = jnp.arange(query.shape[0], dtype=jnp.int32)
    else:
        order = _order_by_number(slots, lists, number, packet)
    return Words(word, number.reshape(-1, packet), slots, first, order)


def _order_in_packets(
    slots: Slots, lists: Int[Array, "P"], packet: int
) -> Int[Array, "W"]:
    """Rows of the words with those of a query side by side, so that its edges will be.

    The words of a packet lie [list, query] and are wanted [query, list].
    """
    capacity = slots.owner.shape[0]
    width = jnp.clip(capacity - slots.begin, 1, jnp.maximum(lists, 1))
    lane = jnp.arange(packet, dtype=jnp.int32)

    def rows(chunk: Int[Array, "T"]) -> Int[Array, "T Q"]:
        owner = slots.owner[chunk]
        first, across = (a[owner][:, None] for a in (slots.begin, width))
        place = chunk[:, None] * packet + lane
        inside = place - first * packet
        # Integer division is slow; what rounding spoils is put right.
        query = inside.astype(jnp.float32) / across.astype(jnp.float32)
        query = query.astype(jnp.int32)
        query -= (query * across > inside).astype(jnp.int32)
        query += ((query + 1) * across <= inside).astype(jnp.int32)
        order = (first + inside - query * across) * packet + query
        return jnp.where((chunk < slots.total)[:, None], order, place)

    return fill(rows, slots.total, capacity, TILE // packet).reshape(-1)


def _order_by_number(
    slots: Slots, lists: Int[Array, "P"], number: Int[Array, "M"], packet: int
) -> Int[Array, "W"]:
    """The same where queries are numbered otherwise than they lie."""
    chunk = jnp.arange(slots.owner.shape[0], dtype=jnp.int32)
    rows = chunk.size * packet
    query_lists = jnp.repeat(lists, packet)
    begin = jnp.zeros_like(query_lists).at[number].set(query_lists)
    begin = (prefix_sum(begin) - begin)[number]
    own = chunk - slots.begin[slots.owner]
    place = begin.reshape(-1, packet)[slots.owner] + own[:, None]
    place = jnp.where((chunk < slots.total)[:, None], place, rows).reshape(-1)
    order = jnp.full(rows, rows - 1, jnp.int32)
    return order.at[place].set(jnp.arange(rows, dtype=jnp.int32), mode="drop")


def list_bits(
    words: Words, near: Candidates, capacity: int
) -> tuple[tuple[Int[Array, "E"], Int[Array, "E"], Bool[Array, "E"]], Int[Array, ""]]:
    """What `near.row` says, query and validity of each set bit; how many there are."""
    flat, packet = words.word.reshape(-1), words.word.shape[1]
    count = jnp.minimum(words.slots.total, words.word.shape[0]) * packet
    hits = fill(
        lambda k: jax.lax.population_count(flat[words.order[k]]).astype(jnp.int32),
        count,
        flat.size,
    )
    slots = range_slots(hits, capacity, count)
    query = words.query[words.slots.owner].reshape(-1)

    def pick(slot: Int[Array, "T"]) -> tuple[Int[Array, "T"], Int[Array, "T"]]:
        rank = slots.owner[slot]
        place = words.order[rank]
        bit = select_bit(flat[place], slot - slots.begin[rank])
        row = words.first[jax.lax.div(place, jnp.int32(packet))] + bit
        return near.row[jnp.where(slot < slots.total, row, 0)], query[place]

    valid = jnp.arange(capacity, dtype=jnp.int32) < slots.total
    return (*fill(pick, slots.total, capacity), valid), slots.total


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

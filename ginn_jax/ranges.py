"""Lists of variable length in fixed capacities: prefix sums, ranges, compaction.

Ranges of rows are expanded to one list by prefix sums, in a capacity that the caller
chose. On CPU lists are made tile by tile, as many as hold real rows: capacity costs
memory, not time, and a tile fits a core's cache. On a GPU everything is one tile.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ginn_jax.process import on_cpu

TILE = 1 << 13
Made = TypeVar("Made")


def tile_rows(capacity: int, most: int = TILE) -> int:
    """Rows of a tile: everything at once where there is no cache to fit."""
    return min(most, capacity) if on_cpu() else capacity


def tiles_holding(rows: Int[Array, "*K"], size: int) -> Int[Array, "*K"]:
    """Tiles of that size that hold so many rows, for any number of them.

    A quotient of Python's rounds down and is a dozen operations; this one is four.
    """
    size = max(size, 1)
    whole = jax.lax.div(rows, jnp.int32(size))
    return whole + (rows > whole * size).astype(jnp.int32)


def over_tiles(
    body: Callable[[Int[Array, ""], Made], Made],
    rows: Int[Array, ""],
    capacity: int,
    size: int,
    state: Made,
) -> Made:
    """`body(tile, state)` for every tile of that size that holds some of the rows.

    On a GPU the one tile that holds all is taken without asking how many there are: it
    would wait for the host before every turn of a loop.
    """
    if 0 < capacity <= size and not on_cpu():
        return body(jnp.int32(0), state)
    tiles = tiles_holding(jnp.minimum(rows, capacity), size)
    return jax.lax.fori_loop(0, tiles, body, state)


def fill(
    make: Callable[[Int[Array, "T"]], Made],
    count: Int[Array, ""],
    capacity: int,
    most: int = TILE,
) -> Made:
    """What `make` says of the rows 0 .. `count`, at most `most` of them at a time.

    `make` maps row numbers to arrays with a row for each. Rows from `count` on hold
    what `make` says of them or zeros.
    """
    size = tile_rows(capacity, most)
    rows = jnp.arange(size, dtype=jnp.int32)
    zeros = jax.tree.map(
        lambda a: jnp.zeros((capacity, *a.shape[1:]), a.dtype),
        jax.eval_shape(make, rows),
    )

    def add(tile: Int[Array, ""], made: Made) -> Made:
        start = jnp.minimum(tile * size, capacity - size)
        some = make(start + rows)
        return jax.tree.map(
            lambda a, b: jax.lax.dynamic_update_slice_in_dim(a, b, start, 0), made, some
        )

    return over_tiles(add, count, capacity, size, zeros)


def prefix_sum(counts: Int[Array, "K"]) -> Int[Array, "K"]:
    """Inclusive prefix sum of small non-negative counts."""
    return jax.lax.platform_dependent(
        counts,
        cpu=_running_sum,
        default=lambda counts: jnp.cumsum(counts, dtype=jnp.int32),
    )


def _running_sum(counts: Int[Array, "K"]) -> Int[Array, "K"]:
    """One sum after the other: on CPU five times as fast as XLA's tree.

    Unrolled by 16 or more XLA splits the loop's body, which is fifty times as slow.
    """
    return jax.lax.scan(
        lambda total, n: (total + n,) * 2, jnp.int32(0), counts, unroll=4
    )[1]


def saturating_sum(counts: Int[Array, "..."]) -> Int[Array, ""]:
    """Sum of counts that stops at the largest int32 instead of wrapping around."""
    wraps = jnp.sum(counts, dtype=jnp.float32) > 2.0**31 - 1024
    total = jnp.sum(counts, dtype=jnp.int32)
    return jnp.where(wraps, jnp.int32(2**31 - 1), total)


class Slots(NamedTuple):
    """Slots of all ranges one after the other: whose they are, which are real.

    Slots that are not real still name some range. `begin` are the ranges' first slots,
    the end of all for those that are not listed.
    """

    owner: Int[Array, "K"]
    begin: Int[Array, "R"]
    total: Int[Array, ""]


def range_slots(
    length: Int[Array, "R"], capacity: int, ranges: Int[Array, ""] | None = None
) -> Slots:
    """Slots for ranges that long, the first `ranges` of them or all."""
    count, size = length.shape[0], tile_rows(length.shape[0])
    listed = jnp.minimum(count if ranges is None else ranges, jnp.int32(count))
    is_listed = jnp.arange(count, dtype=jnp.int32) < listed
    length = jnp.where(is_listed, length, 0)
    padded = jnp.pad(length, (0, -count % max(size, 1)))

    def open_slots(tile: Int[Array, ""], state: tuple[Array, ...]) -> tuple[Array, ...]:
        begin, opened, used, least = state
        some = jax.lax.dynamic_slice_in_dim(padded, tile * size, size)
        stop = used + prefix_sum(some)
        real = tile * size + jnp.arange(size, dtype=jnp.int32) < listed
        place = jnp.where(real, stop - some, capacity)
        begin = jax.lax.dynamic_update_slice_in_dim(
            begin, stop - some, tile * size, axis=0
        )
        opened = opened.at[place].add(1, mode="drop")
        # Of sums that leave int32, the first wraps to below zero.
        return begin, opened, stop[-1], jnp.minimum(least, jnp.min(stop, initial=0))

    zero = jnp.int32(0)
    nothing = jnp.zeros_like(padded), jnp.zeros(capacity, jnp.int32), zero, zero
    begin, opened, used, least = over_tiles(open_slots, listed, count, size, nothing)
    total = jnp.where(least < 0, jnp.int32(2**31 - 1), used)
    # Tiles that are not taken leave zeros, but what is not listed begins at the end.
    begin = jnp.where(is_listed, begin[:count], total)
    return Slots(_sum_tiles(opened, total) - 1, begin, total)


def _sum_tiles(counts: Int[Array, "K"], count: Int[Array, ""]) -> Int[Array, "K"]:
    """Inclusive prefix sum of the first `count`, whatever for the others."""
    size = tile_rows(counts.shape[0])
    padded = jnp.pad(counts, (0, -counts.shape[0] % max(size, 1)))

    def add(tile: Int[Array, ""], state: tuple[Array, Array]) -> tuple[Array, Array]:
        summed, total = state
        some = jax.lax.dynamic_slice_in_dim(padded, tile * size, size)
        some = total + prefix_sum(some)
        summed = jax.lax.dynamic_update_slice_in_dim(summed, some, tile * size, axis=0)
        return summed, some[-1]

    nothing = jnp.zeros_like(padded), jnp.int32(0)
    summed, _ = over_tiles(add, count, counts.shape[0], size, nothing)
    return summed[: counts.shape[0]]


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

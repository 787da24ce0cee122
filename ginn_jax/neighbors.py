"""Radius search on the host: any sizes, exact pairs, no capacity to choose."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from ginn_jax.candidates import (
    PACKET,
    WORD,
    Candidates,
    count_words,
    packet_candidates,
    packet_columns,
)
from ginn_jax.checks import FAR, real_array, within_reach
from ginn_jax.errors import InputError
from ginn_jax.outlying import Parts, bounds_of, set_apart
from ginn_jax.packets import Words, list_bits, packet_words
from ginn_jax.pairs import Pairs, decide, in_order, join
from ginn_jax.process import ALONE, available_cores
from ginn_jax.voxels import VoxelGrid, build_grid, morton_code

QUERY_BLOCK = 1 << 17
WORD_BLOCK = 1 << 16
# So many points lie so close that queries of a block, in no order, are far apart.
MANY = 1 << 17
# Points that are counted from elsewhere at a time.
RUN = 1 << 12


def find_neighbors(
    points: Float[np.ndarray, "N 3"],
    queries: Float[np.ndarray, "M 3"],
    radius: float,
) -> tuple[Int[np.ndarray, "E"], Int[np.ndarray, "E"]]:
    """Host-level search: (query_index, point_index) of all pairs closer than `radius`.

    Sorted by query. Sizes itself: every stage gets the capacity that the one before it
    counted, and queries are taken in blocks, near ones together where points are many.
    Pairs within rounding of the radius are decided in float64.

    Raises:
        InputError: a shape other than [n, 3], a non-finite number, a radius <= 0; or
            numbers whose squares float32 does not hold.
    """
    points, queries = as_points("points", points), as_rows("queries", queries)
    if np.ndim(real_array("radius", radius)) or not 1 / FAR <= radius <= FAR:
        raise InputError(f"radius is {radius}: give a number above 0, 1e-18 to 1e18")
    if not (len(points) and len(queries)):
        as_points("queries", queries)  # refused all the same
        return np.zeros(0, np.int32), np.zeros(0, np.int32)
    low, high = bounds_of(points)
    parts = set_apart(points, (low, high), queries, radius)
    if parts is not None:
        return _search_apart(points, queries, radius, parts)
    center = 0.5 * (low + high)
    if len(points) > MANY:
        near = offsets_from(center, as_points("queries", queries))
        order = _along_curve(*pad_rows(near, bucket(len(near))))[: len(near)]
        pairs = _search(points, queries.take(order, axis=0), radius, center)
        return in_order(*pairs, order)
    return _search(points, queries, radius, center)


def _search_apart(
    points: Float[np.ndarray, "N 3"],
    queries: Shaped[np.ndarray, "M 3"],
    radius: float,
    parts: Parts,
) -> tuple[Int[np.ndarray, "E"], Int[np.ndarray, "E"]]:
    """`find_neighbors` of either half by itself."""
    pairs = []
    for asked, near in parts:
        query, point = find_neighbors(points[near], queries[asked], radius)
        rows = asked.astype(np.int32), near.astype(np.int32)
        pairs.append((rows[0][query], rows[1][point]))
    query, point = map(np.concatenate, zip(*pairs, strict=True))
    order = np.argsort(query, kind="stable")
    return query[order], point[order]


def _search(
    points: Float[np.ndarray, "N 3"],
    queries: Shaped[np.ndarray, "M 3"],
    radius: float,
    center: Float[np.ndarray, "3"],
) -> tuple[Int[np.ndarray, "E"], Int[np.ndarray, "E"]]:
    """`find_neighbors` block by block, coordinates counted from `center`."""
    near_points = offsets_from(center, points)
    padded, mask = pad_rows(near_points, bucket(len(points)))
    grid = _build_grid(padded, mask, np.float32(radius))
    # Twice the rounding of the largest coordinate, for three axes and both ends.
    rounding = 2e-6 * radius + 8 * np.finfo(np.float32).eps * np.abs(near_points).max()
    certain, reach = max(radius - 2 * rounding, 0.0), radius + rounding
    shell = np.array([certain, reach], np.float32)

    def search(first: int) -> list[tuple[Pairs, Int[np.ndarray, "K"]]]:
        block = as_points("queries", queries[first : first + QUERY_BLOCK])
        found = _search_block(grid, offsets_from(center, block), shell, first)
        return [decide(pairs, points, queries, radius) for pairs in found]

    with ThreadPoolExecutor(available_cores()) as pool:
        blocks = pool.map(search, range(0, len(queries), QUERY_BLOCK))
        return join([part for block in blocks for part in block], pool)


def offsets_from(
    center: Float[np.ndarray, "3"], points: Shaped[np.ndarray, "*N 3"]
) -> Float[np.ndarray, "*N 3"]:
    """Coordinates counted from there in float32, the difference taken in float64.

    Some at a time: NumPy is slow where it has to repeat three numbers.
    """
    flat = points.reshape(-1)
    middle = np.tile(np.asarray(center, np.float64), min(len(flat) // 3, RUN))
    near = np.empty(flat.shape, np.float32)
    for first in range(0, len(flat), 3 * RUN):
        part = flat[first : first + 3 * RUN]
        kept = near[first : first + 3 * RUN]
        np.subtract(part, middle[: len(part)], out=kept, casting="same_kind")
    return near.reshape(points.shape)


def as_rows(name: str, points: Any) -> Shaped[np.ndarray, "N 3"]:
    """The points in their own type, or `InputError` if they are not [N, 3]."""
    points = real_array(name, points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name} has shape {points.shape}: give an array [N, 3]")
    return points


def as_points(name: str, points: Any) -> Float[np.ndarray, "N 3"]:
    """The points in float64, or `InputError` if they are not [N, 3] and finite."""
    points = as_rows(name, points).astype(np.float64, copy=False)
    farthest = max(-points.min(initial=0.0), points.max(initial=0.0))
    if not np.isfinite(farthest):
        raise InputError(f"{name} holds non-finite coordinates: remove those rows")
    within_reach(name, farthest)
    return points


def bucket(count: int) -> int:
    """The next of 64, 96, 128, 192, ...: few shapes, so few compilations."""
    power = max(6, (max(count, 1) - 1).bit_length())
    return 3 << (power - 2) if count <= 3 << (power - 2) else 1 << power


def pad_rows(array: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """The array with zero rows appended up to `rows`, and the mask of the real ones."""
    mask = np.arange(rows) < len(array)
    if rows == len(array):
        return array, mask
    missing = [(0, rows - len(array))] + [(0, 0)] * (array.ndim - 1)
    return np.pad(array, missing), mask


def _search_block(
    grid: VoxelGrid,
    queries: Float[np.ndarray, "M 3"],
    shell: Float[np.ndarray, "2"],
    first: int,
) -> Iterator[Pairs]:
    """The pairs of a block of queries; one with too much to list is taken in parts.

    Nearer than the inner radius of the `shell` they are certain.
    """
    rows = -(-bucket(len(queries)) // PACKET) * PACKET
    padded, mask = pad_rows(queries, rows)
    order = _along_curve(padded, mask)
    turned = padded.take(order, axis=0), mask, order  # padding stays last
    under, columns = _columns(grid, *turned[:2], shell[1])
    size = bucket(8 * rows)
    near, need = _candidates(grid, under, bucket(int(columns)), size)
    lists, many = -(-int(need) // WORD), len(queries) > PACKET
    if lists <= WORD_BLOCK or not many:  # else there are so many lists at least
        if int(need) > size:
            size = bucket(int(need))
            near, _ = _candidates(grid, under, bucket(int(columns)), size)
        lists = int(count_words(near))
    if lists > WORD_BLOCK and many:
        # As many as will do, all of one size: each other size is compiled anew.
        parts = 1 << (lists // WORD_BLOCK).bit_length()
        each = max(-(-len(queries) // parts), PACKET)
        for begin in range(0, len(queries), each):
            part = queries[begin : begin + each]
            yield from _search_block(grid, part, shell, first + begin)
        return
    words, edges = _words(grid, *turned, shell[1], near, bucket(lists))
    count = int(edges)
    pairs = _list(grid, padded, shell[0], near, words, first, bucket(count))
    yield Pairs(*(np.asarray(column)[:count] for column in pairs))


def _along_curve(
    query: Float[np.ndarray, "M 3"], mask: Bool[np.ndarray, "M"]
) -> Int[np.ndarray, "M"]:
    """`voxels.morton_order`, sorted by NumPy: several times as fast as by XLA."""
    code = np.asarray(_code(query, mask, 10)).astype(np.uint64) << np.uint64(32)
    code |= np.arange(len(query), dtype=np.uint64)
    code.sort()
    return code.astype(np.uint32).astype(np.int32)


@partial(jax.jit, static_argnames="capacity", compiler_options=ALONE)
def _words(
    grid: VoxelGrid,
    query: Float[Array, "M 3"],
    mask: Bool[Array, "M"],
    number: Int[Array, "M"],
    radius: Float[Array, ""],
    near: Candidates,
    capacity: int,
) -> tuple[Words, Int[Array, ""]]:
    words = packet_words(grid, query, mask, radius, near, capacity, number=number)
    return words, jnp.sum(jax.lax.population_count(words.word).astype(jnp.int32))


@partial(jax.jit, static_argnames="capacity", compiler_options=ALONE)
def _list(
    grid: VoxelGrid,
    query: Float[Array, "M 3"],
    certain: Float[Array, ""],
    near: Candidates,
    words: Words,
    first: Int[Array, ""],
    capacity: int,
) -> tuple[Int[Array, "E"], Int[Array, "E"], Bool[Array, "E"]]:
    """`Pairs` of queries by number, from `first` on."""
    (row, receiver, _), _ = list_bits(words, near, capacity)
    offset = query[receiver] - grid.position[row]
    doubtful = jnp.sum(offset**2, axis=-1) >= certain**2
    return first + receiver, grid.index[row], doubtful


# Blocks have a thread on every core.
_jit = partial(jax.jit, compiler_options=ALONE)
_build_grid = _jit(build_grid)
_code = _jit(morton_code, static_argnums=2)
_columns = _jit(packet_columns)
_candidates = _jit(packet_candidates, static_argnums=(2, 3))

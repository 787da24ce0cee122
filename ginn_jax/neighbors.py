"""Radius search on the host: any sizes, exact pairs, no capacity to choose."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ginn_jax.candidates import (
    PACKET,
    Candidates,
    count_words,
    packet_candidates,
    packet_columns,
)
from ginn_jax.checks import real_array
from ginn_jax.errors import InputError
from ginn_jax.packets import Words, list_bits, packet_words
from ginn_jax.process import available_cores
from ginn_jax.voxels import VoxelGrid, build_grid, morton_order

QUERY_BLOCK = 1 << 17
WORD_BLOCK = 1 << 16
# Squares of lengths from 1 / FAR to FAR are normal numbers in float32.
FAR = 1e18


class Pairs(NamedTuple):
    """Pairs of some queries, sorted by query."""

    query: Int[np.ndarray, "E"]
    point: Int[np.ndarray, "E"]
    squared: Float[np.ndarray, "E"]


def find_neighbors(
    points: Float[np.ndarray, "N 3"],
    queries: Float[np.ndarray, "M 3"],
    radius: float,
) -> tuple[Int[np.ndarray, "E"], Int[np.ndarray, "E"]]:
    """Host-level search: (query_index, point_index) of all pairs closer than `radius`.

    Sorted by query. Sizes itself: every stage gets the capacity that the one before it
    counted, and queries are taken in blocks. Pairs within rounding of the radius are
    decided in float64.

    Raises:
        InputError: a shape other than [n, 3], a non-finite number, a radius <= 0; or
            numbers whose squares float32 does not hold.
    """
    points, queries = as_points("points", points), as_points("queries", queries)
    if np.ndim(real_array("radius", radius)) or not 1 / FAR <= radius <= FAR:
        raise InputError(f"radius is {radius}: give a number above 0, 1e-18 to 1e18")
    if not (len(points) and len(queries)):
        return np.zeros(0, np.int32), np.zeros(0, np.int32)
    center = 0.5 * (points.min(0) + points.max(0))
    near_points = np.asarray(points - center, np.float32)
    padded, mask = pad_rows(near_points, bucket(len(points)))
    grid = _build_grid(padded, mask, np.float32(radius))
    # Twice the rounding of the largest coordinate, for three axes and both ends.
    rounding = 2e-6 * radius + 8 * np.finfo(np.float32).eps * np.abs(near_points).max()
    reach = np.float32(radius + rounding)
    certain = max(float(radius - 2 * rounding), 0.0) ** 2

    def search(first: int) -> list[Pairs]:
        block = queries[first : first + QUERY_BLOCK]
        near = np.asarray(block - center, np.float32)
        found = _search_block(grid, near, reach, first)
        return [_decide(pairs, points, queries, radius, certain) for pairs in found]

    with ThreadPoolExecutor(available_cores()) as pool:
        blocks = pool.map(search, range(0, len(queries), QUERY_BLOCK))
        parts = [pairs for block in blocks for pairs in block]
    query_index, point_index = (
        np.concatenate([pairs[column] for pairs in parts]) for column in (0, 1)
    )
    return query_index, point_index


def as_points(name: str, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """The points in float64, or `InputError` if they are not [N, 3] and finite."""
    points = real_array(name, points).astype(np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name} has shape {points.shape}: give an array [N, 3]")
    if not np.isfinite(points).all():
        raise InputError(f"{name} holds non-finite coordinates: remove those rows")
    if points.size and np.abs(points).max() > FAR:
        raise InputError(f"{name} holds coordinates beyond {FAR:g}: scale them down")
    return points


def bucket(count: int) -> int:
    """The next of 64, 96, 128, 192, ...: few shapes, so few compilations."""
    power = max(6, (max(count, 1) - 1).bit_length())
    return 3 << (power - 2) if count <= 3 << (power - 2) else 1 << power


def pad_rows(array: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """The array with zero rows appended up to `rows`, and the mask of the real ones."""
    missing = [(0, rows - len(array))] + [(0, 0)] * (array.ndim - 1)
    return np.pad(array, missing), np.arange(rows) < len(array)


def _search_block(
    grid: VoxelGrid, queries: Float[np.ndarray, "M 3"], radius: np.float32, first: int
) -> Iterator[Pairs]:
    """The pairs of a block of queries; a block with too much to list is halved."""
    rows = -(-bucket(len(queries)) // PACKET) * PACKET
    padded, mask = pad_rows(queries, rows)
    turned = _turn(padded, mask)
    under, columns = _columns(grid, *turned[:2], radius)
    size = bucket(4 * rows)
    near, need = _candidates(grid, under, bucket(int(columns)), size)
    if int(need) > size:
        size = bucket(int(need))
        near, need = _candidates(grid, under, bucket(int(columns)), size)
    lists = int(count_words(near))
    if lists > WORD_BLOCK and len(queries) > PACKET:
        half = len(queries) // 2
        yield from _search_block(grid, queries[:half], radius, first)
        yield from _search_block(grid, queries[half:], radius, first + half)
        return
    words, edges = _words(grid, *turned, radius, near, bucket(lists))
    count = int(edges)
    pairs = _list(grid, padded, near, words, bucket(count))
    receiver, sender, squared = (np.asarray(a)[:count] for a in pairs)
    yield Pairs(first + receiver, sender, squared)


def _decide(
    pairs: Pairs,
    points: Float[np.ndarray, "N 3"],
    queries: Float[np.ndarray, "M 3"],
    radius: float,
    certain: float,
) -> Pairs:
    """Without the pairs that float64 finds to be as far apart as the radius."""
    doubtful = np.flatnonzero(pairs.squared > certain)
    offset = points[pairs.point[doubtful]] - queries[pairs.query[doubtful]]
    wrong = doubtful[np.sum(offset**2, axis=-1) >= radius**2]
    if not len(wrong):
        return pairs
    return Pairs(*(np.delete(column, wrong) for column in pairs))


@jax.jit
def _turn(
    query: Float[Array, "M 3"], mask: Bool[Array, "M"]
) -> tuple[Float[Array, "M 3"], Bool[Array, "M"], Int[Array, "M"]]:
    """Queries along a space-filling curve, which of them are real, their numbers."""
    order = morton_order(query, mask)
    return query[order], mask[order], order


@partial(jax.jit, static_argnames="capacity")
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


@partial(jax.jit, static_argnames="capacity")
def _list(
    grid: VoxelGrid,
    query: Float[Array, "M 3"],
    near: Candidates,
    words: Words,
    capacity: int,
) -> tuple[Int[Array, "E"], Int[Array, "E"], Float[Array, "E"]]:
    """Query, point and squared distance of every pair; `query` by number."""
    (row, receiver, _), _ = list_bits(words, near, capacity)
    offset = query[receiver] - grid.position[row]
    return receiver, grid.index[row], jnp.sum(offset**2, axis=-1)


_build_grid = jax.jit(build_grid)
_columns = jax.jit(packet_columns)
_candidates = jax.jit(packet_candidates, static_argnums=(2, 3))

"""Radius search on the host: any sizes, exact pairs, no capacity to choose."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ginn_jax.errors import InputError
from ginn_jax.process import available_cores
from ginn_jax.voxels import Runs, VoxelGrid, build_grid, expand_runs, find_runs

QUERY_BLOCK = 1 << 16
CANDIDATE_BLOCK = 1 << 21


def find_neighbors(
    points: Float[np.ndarray, "N 3"],
    queries: Float[np.ndarray, "M 3"],
    radius: float,
) -> tuple[Int[np.ndarray, "E"], Int[np.ndarray, "E"]]:
    """Host-level search: (query_index, point_index) of all pairs closer than `radius`.

    Sorted by query. Sizes itself: one pass counts candidates, queries are then taken in
    blocks of bounded size. Pairs within rounding of the radius are decided in float64.

    Raises:
        InputError: a shape other than [n, 3], a non-finite number, a radius <= 0.
    """
    points, queries = as_points("points", points), as_points("queries", queries)
    if not (np.isfinite(radius) and radius > 0):
        raise InputError(f"radius is {radius}: give a finite number above 0")
    if not (len(points) and len(queries)):
        return np.zeros(0, np.int32), np.zeros(0, np.int32)
    center = 0.5 * (points.min(0) + points.max(0))
    near_points = np.asarray(points - center, np.float32)
    near_queries = np.asarray(queries - center, np.float32)
    # Twice the rounding of the largest coordinate, for three axes and both ends.
    rounding = 2e-6 * radius + 8 * np.finfo(np.float32).eps * np.abs(near_points).max()
    found = _search_blocks(near_points, near_queries, np.float32(radius + rounding))
    query_index, point_index, squared = found
    doubtful = np.flatnonzero(squared > max(radius - 2 * rounding, 0.0) ** 2)
    offset = points[point_index[doubtful]] - queries[query_index[doubtful]]
    wrong = doubtful[np.sum(offset**2, axis=-1) >= radius**2]
    return np.delete(query_index, wrong), np.delete(point_index, wrong)


def as_points(name: str, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """The points in float64, or `InputError` if they are not [N, 3] and finite."""
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name} has shape {points.shape}: give an array [N, 3]")
    if not np.isfinite(points).all():
        raise InputError(f"{name} holds non-finite coordinates: remove those rows")
    return points


def bucket(count: int) -> int:
    """The next of 64, 96, 128, 192, ...: few shapes, so few compilations."""
    power = max(6, (max(count, 1) - 1).bit_length())
    return 3 << (power - 2) if count <= 3 << (power - 2) else 1 << power


def pad_rows(array: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """The array with zero rows appended up to `rows`, and the mask of the real ones."""
    missing = [(0, rows - len(array))] + [(0, 0)] * (array.ndim - 1)
    return np.pad(array, missing), np.arange(rows) < len(array)


Found = tuple[np.ndarray, np.ndarray, np.ndarray]


def _search_blocks(
    points: Float[np.ndarray, "N 3"],
    queries: Float[np.ndarray, "M 3"],
    radius: np.float32,
) -> Found:
    """Query index, point index and squared distance of all pairs within the radius."""
    padded, mask = pad_rows(points, bucket(len(points)))
    grid = _build_grid(padded, mask, radius)

    def search(first: int) -> list[Found]:
        return _search_block(grid, queries[first : first + QUERY_BLOCK], first, radius)

    with ThreadPoolExecutor(available_cores()) as pool:
        blocks = list(pool.map(search, range(0, len(queries), QUERY_BLOCK)))
    columns = zip(*(part for block in blocks for part in block), strict=True)
    query_index, point_index, squared = (np.concatenate(column) for column in columns)
    return query_index, point_index, squared


def _search_block(
    grid: VoxelGrid, queries: Float[np.ndarray, "M 3"], first: int, radius: np.float32
) -> list[Found]:
    """The pairs of a block of queries; a block too dense to number is halved."""
    query, query_mask = pad_rows(queries, bucket(len(queries)))
    runs = _find_runs(grid, query, query_mask, radius)
    total = int(np.sum(np.asarray(runs.length), dtype=np.int64))
    if total > 1 << 30 and len(queries) > 1:
        half = len(queries) // 2
        return [
            *_search_block(grid, queries[:half], first, radius),
            *_search_block(grid, queries[half:], first + half, radius),
        ]
    return [
        (first + receiver, sender, squared)
        for receiver, sender, squared in _test_blocks(grid, query, runs, radius, total)
    ]


def _test_blocks(
    grid: VoxelGrid,
    query: Float[np.ndarray, "M 3"],
    runs: Runs,
    radius: np.float32,
    total: int,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Test candidates block by block; keep receiver, sender, squared distance."""
    capacity = min(CANDIDATE_BLOCK, bucket(total))
    for first in range(0, max(total, 1), capacity):
        tested = _test_candidates(grid, query, runs, np.int32(first), capacity)
        receiver, sender, squared = map(np.asarray, tested)
        keep = np.flatnonzero(squared < radius**2)
        yield receiver[keep], sender[keep], squared[keep]


@partial(jax.jit, static_argnames="capacity")
def _test_candidates(
    grid: VoxelGrid,
    query: Float[Array, "M 3"],
    runs: Runs,
    first: Int[Array, ""],
    capacity: int,
) -> tuple[Int[Array, "K"], Int[Array, "K"], Float[Array, "K"]]:
    """Receiver, sender and squared distance of a block; infinite where padded."""
    (receiver, row, valid), _ = expand_runs(runs, capacity, first)
    squared = jnp.sum((query[receiver] - grid.position[row]) ** 2, axis=-1)
    return receiver, grid.index[row], jnp.where(valid, squared, jnp.inf)


_build_grid = jax.jit(build_grid)
_find_runs = jax.jit(find_runs)

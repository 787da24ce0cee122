"""Other radius searches that return the same pairs, each in its fastest form.

A peer is a function without arguments that makes a search, or raises ImportError where
its package is missing.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import chain

import numpy as np

from ginn_jax.process import available_cores

Pairs = tuple[np.ndarray, np.ndarray]
Search = Callable[[np.ndarray, np.ndarray, float], Pairs]


def kdtree_lists(workers: int) -> Search:
    """SciPy's lists per query, flattened; `workers` -1 takes all cores."""
    from scipy.spatial import cKDTree  # pyright: ignore

    def search(points: np.ndarray, queries: np.ndarray, radius: float) -> Pairs:
        tree = cKDTree(points)
        below = np.nextafter(radius, 0)  # SciPy keeps pairs at the radius itself
        lists = tree.query_ball_point(
            queries, below, workers=workers, return_sorted=False
        )
        counts = np.fromiter(map(len, lists), np.int32, len(lists))
        found = np.fromiter(chain.from_iterable(lists), np.int32, counts.sum())
        return np.repeat(np.arange(len(queries), dtype=np.int32), counts), found

    return search


def kdtree_pairs(workers: int) -> Search:
    """SciPy's sparse distance matrix of two trees, queries split among threads."""
    from scipy.spatial import cKDTree  # pyright: ignore

    def search(points: np.ndarray, queries: np.ndarray, radius: float) -> Pairs:
        tree, below = cKDTree(points, leafsize=8), np.nextafter(radius, 0)

        def part(first: int, some: np.ndarray) -> Pairs:
            other = cKDTree(some, 8, compact_nodes=False, balanced_tree=False)
            found = other.sparse_distance_matrix(tree, below, output_type="ndarray")
            return found["i"] + first, found["j"]

        blocks = np.array_split(queries, workers)
        firsts = np.cumsum([0] + [len(block) for block in blocks[:-1]])
        with ThreadPoolExecutor(workers) as pool:
            columns = zip(*pool.map(part, firsts, blocks), strict=True)
        query, point = (np.concatenate(column) for column in columns)
        return query, point

    return search


def open3d_fixed_radius() -> Search:
    """Open3D's FixedRadiusSearch, on all cores."""
    try:
        from open3d import core  # pyright: ignore
    except OSError as error:  # a system library is missing
        raise ImportError(str(error)) from None

    def search(points: np.ndarray, queries: np.ndarray, radius: float) -> Pairs:
        index = core.nns.NearestNeighborSearch(core.Tensor(points))
        index.fixed_radius_index(radius)
        found = index.fixed_radius_search(core.Tensor(queries), radius, sort=False)
        point, counts = found[0].numpy(), np.diff(found[2].numpy())
        query = np.repeat(np.arange(len(queries), dtype=np.int32), counts)
        return query, point

    return search


def warp_hash_grid() -> Search:
    """Warp's HashGrid on the CPU (one core): pairs are counted, then written."""
    import warp as wp  # pyright: ignore

    wp.config.quiet = True
    wp.init()

    @wp.kernel
    def visit(
        grid: wp.uint64,
        points: wp.array(dtype=wp.vec3),
        queries: wp.array(dtype=wp.vec3),
        radius: float,
        start: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int32),
        found: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        total = wp.int32(0)  # a variable; a plain 0 is a constant to Warp
        for j in wp.hash_grid_query(grid, queries[i], radius):
            if wp.length_sq(queries[i] - points[j]) < radius * radius:
                if found:
                    found[start[i] + total] = j
                total += 1
        count[i] = total

    def search(points: np.ndarray, queries: np.ndarray, radius: float) -> Pairs:
        place, ask = (
            wp.array(a, dtype=wp.vec3, device="cpu") for a in (points, queries)
        )
        sides = [int(min(np.ptp(points[:, a]) / radius + 3, 128)) for a in range(3)]
        grid = wp.HashGrid(*sides, device="cpu")
        grid.build(place, radius)
        count = wp.zeros(len(queries), dtype=wp.int32, device="cpu")
        given = [grid.id, place, ask, radius]
        wp.launch(visit, len(queries), [*given, count, count, None], device="cpu")
        counts = count.numpy().copy()
        start = wp.array(np.cumsum(counts) - counts, dtype=wp.int32, device="cpu")
        found = wp.empty(int(counts.sum()), dtype=wp.int32, device="cpu")
        wp.launch(visit, len(queries), [*given, start, count, found], device="cpu")
        return np.repeat(np.arange(len(queries), dtype=np.int32), counts), found.numpy()

    return search


def jax_md_cell_list() -> Search:
    """JAX MD lists the pairs of one set of points only: no search of this kind."""
    raise ImportError("searches one set of points in itself")


# How to make each search; one whose package is missing raises ImportError.
PEERS: dict[str, Callable[[], Search]] = {
    "cKDTree lists, 1 core": partial(kdtree_lists, 1),
    "cKDTree lists, all cores": partial(kdtree_lists, -1),
    "cKDTree pairs, 1 core": partial(kdtree_pairs, 1),
    "cKDTree pairs, all cores": partial(kdtree_pairs, available_cores()),
    "Open3D FixedRadiusSearch": open3d_fixed_radius,
    "Warp HashGrid": warp_hash_grid,
    "JAX MD cell list": jax_md_cell_list,
}

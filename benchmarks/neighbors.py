"""Radius search: ours against others that return the same pairs.

    python -m benchmarks.neighbors

Every search starts from NumPy arrays, builds its own structure and ends with two NumPy
arrays of indices. Pairs are compared before anything is timed. Peers need not sort
theirs by query; ours do.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.timing import Timing, describe, load, measure
from ginn_jax import report, scenes
from ginn_jax.commandline import require, start
from ginn_jax.errors import InputError
from ginn_jax.mesh import sample_surface
from ginn_jax.neighbors import find_neighbors
from ginn_jax.process import available_cores

OURS = "ginn_jax"
Pairs = tuple[np.ndarray, np.ndarray]
Search = Callable[[np.ndarray, np.ndarray, float], Pairs]


@dataclass(frozen=True)
class Options:
    """Time the search for all neighbours within a radius, ours against its peers."""

    out: Path = Path("runs/neighbors")
    """Folder for metrics.json, report.md and the figure."""
    points: int = 10_000
    """Points to search among."""
    queries: tuple[int, ...] = (262_144, 1_000_000)
    """Points to search for."""
    radii: tuple[float, ...] = (0.05, 0.025)
    """Search radii; the side of the unit cube is 1."""
    repeats: int = 7
    """Timed calls of each search."""
    seed: int = 0
    """Seed of the clouds."""
    quick: bool = False
    """Few queries and repeats: to try things, not for numbers."""


QUICK = {"points": 2000, "queries": (8192,), "radii": (0.05,), "repeats": 2}


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
        total = 0
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


def available() -> tuple[dict[str, Search], list[str]]:
    """Ours and the peers that are installed, and the names of those that are not."""
    searches: dict[str, Search] = {OURS: find_neighbors}
    missing: list[str] = []
    for name, make in PEERS.items():
        try:
            searches[name] = make()
        except ImportError as error:
            missing.append(f"{name} ({error})")
    return searches, missing


def uniform(rng: np.random.Generator, count: int) -> np.ndarray:
    """Uniform in the unit cube."""
    return rng.random((count, 3))


def clusters(rng: np.random.Generator, count: int) -> np.ndarray:
    """Eight Gaussian clusters in the unit cube, the same ones at every call."""
    centre = np.random.default_rng(0).random((8, 3))
    return rng.normal(centre[rng.integers(0, 8, count)], 0.1)


def surface(rng: np.random.Generator, count: int) -> np.ndarray:
    """Uniform on a procedural object and its ground: what the network sees."""
    mesh = scenes.load_object(scenes.procedural_sources(1, 0)[0])
    seed = int(rng.integers(1 << 31))
    return sample_surface(mesh, count, seed=seed).position.astype(np.float64)


CLOUDS = {"uniform": uniform, "clusters": clusters, "surface": surface}


def same_pairs(a: Pairs, b: Pairs, points: int) -> bool:
    """Whether both hold the same pairs, in any order, none twice."""
    ours, theirs = (np.sort(q.astype(np.int64) * points + p) for q, p in (a, b))
    return np.array_equal(ours, theirs) and bool((np.diff(ours) > 0).all())


def same_but_for_rounding(
    a: Pairs, b: Pairs, points: np.ndarray, queries: np.ndarray, radius: float
) -> bool:
    """Whether the pairs are the same but for distances within 1e-5 of the radius."""
    codes = [q.astype(np.int64) * len(points) + p for q, p in (a, b)]
    if len(np.unique(codes[1])) != len(codes[1]):
        return False
    query, point = np.divmod(np.setxor1d(*codes), len(points))
    distance = np.linalg.norm(queries[query] - points[point], axis=1)
    return bool((np.abs(distance / radius - 1) < 1e-5).all())


def compare(options: Options, cloud: str, radius: float, count: int) -> dict[str, Any]:
    """Check that all searches agree on a cloud, then time them."""
    rng = np.random.default_rng(options.seed)
    points, queries = (CLOUDS[cloud](rng, n) for n in (options.points, count))
    searches, _ = available()
    expected = find_neighbors(points, queries, radius)
    for name, search in searches.items():
        found = search(points, queries, radius)
        if not same_but_for_rounding(expected, found, points, queries, radius):
            raise AssertionError(f"{name} found other pairs: {cloud}, r = {radius}")
    calls = {n: partial(s, points, queries, radius) for n, s in searches.items()}
    return {
        "cloud": cloud,
        "queries": count,
        "radius": radius,
        "pairs": len(expected[0]),
        "timings": measure(calls, options.repeats),
    }


def best_ratio(timings: dict[str, Timing]) -> float:
    """How many times as long as ours the best peer takes."""
    peers = [t.median for name, t in timings.items() if name != OURS]
    return min(peers, default=float("nan")) / timings[OURS].median


def main(options: Options) -> dict[str, Any]:
    """Compare on every cloud and radius; returns what metrics.json holds."""
    require(options, {"points": 1, "repeats": 1, "seed": 0})
    if not all(0 < radius < np.inf for radius in options.radii):
        raise InputError(f"--radii {options.radii}: give numbers above 0")
    begin = time.perf_counter()
    cases = [
        compare(options, c, r, n)
        for n in options.queries
        for r in options.radii
        for c in CLOUDS
    ]
    names, missing = list(cases[0]["timings"]), available()[1]
    rows = [
        [f"{c['cloud']}, r = {c['radius']}", c["queries"], c["pairs"]]
        + [str(c["timings"][name]) for name in names]
        + [best_ratio(c["timings"])]
        for c in cases
    ]
    table = report.markdown_table(
        ["cloud", "queries", "pairs", *names, "best peer / ours"], rows
    )
    text = f"""# Neighbour search

{options.points} points; median of {options.repeats} calls
± half the interquartile range; all searches return the same pairs.
Missing peers: {", ".join(missing) or "none"}.

{describe()}

{table}
![times](neighbors.png)
"""
    for case in cases:
        case["ratio"] = best_ratio(case["timings"])
        case["timings"] = {n: t.record() for n, t in case["timings"].items()}
    metrics = {
        "cases": cases,
        "missing": missing,
        "options": asdict(options),
        "environment": report.environment() | {"load": load()},
        "seconds_total": time.perf_counter() - begin,
    }
    report.write_results(options.out, metrics, text)
    draw(options.out / "neighbors.png", cases)
    print(text)
    return metrics


def draw(path: Path, cases: list[dict[str, Any]]) -> None:
    """Bars: milliseconds of every search for every cloud and radius."""
    figure = Figure(figsize=(12, 4), layout="constrained")
    axes, names = figure.add_subplot(), list(cases[0]["timings"])
    for i, name in enumerate(names):
        heights = [1e3 * case["timings"][name]["median"] for case in cases]
        places = np.arange(len(cases)) + (i - len(names) / 2) * 0.8 / len(names)
        axes.bar(places, heights, 0.8 / len(names), align="edge", label=name)
    axes.set_xticks(
        range(len(cases)),
        [f"{c['cloud']}\n{c['radius']}\n{c['queries'] // 1000}k" for c in cases],
    )
    axes.set(ylabel="ms")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    start(Options, main, QUICK)

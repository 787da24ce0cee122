"""Radius search: ours against others that return the same pairs.

    python -m benchmarks.neighbors

Every search starts from NumPy arrays, builds its own structure and ends with two NumPy
arrays of indices. Pairs are compared before anything is timed. Peers need not sort
theirs by query; ours do.
"""

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.peers import PEERS, Pairs, Search
from benchmarks.timing import Timing, circumstances, describe, measure
from ginn_jax import objects, report
from ginn_jax.commandline import require, require_positive, require_some, start
from ginn_jax.neighbors import find_neighbors
from ginn_jax.samples import sample_surface

OURS = "ginn_jax"


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
    mesh = objects.load_object(objects.procedural_sources(1, 0)[0])
    seed = int(rng.integers(1 << 31))
    return sample_surface(mesh, count, seed=seed).position.astype(np.float64)


CLOUDS = {"uniform": uniform, "clusters": clusters, "surface": surface}


def same_but_for_rounding(
    a: Pairs, b: Pairs, points: np.ndarray, queries: np.ndarray, radius: float
) -> bool:
    """Whether the pairs are the same but for distances within 1e-5 of the radius."""
    one, other = (np.sort(q.astype(np.int64) * len(points) + p) for q, p in (a, b))
    if (other[1:] == other[:-1]).any():  # a pair twice
        return False
    if np.array_equal(one, other):
        return True
    differing = np.setxor1d(one, other, assume_unique=True)
    query, point = np.divmod(differing, len(points))
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
    timings = measure(calls, options.repeats)
    told = ", ".join(f"{name} {timing}" for name, timing in timings.items())
    print(f"{cloud}, {count} queries, r = {radius}: {told}", flush=True)
    return {
        "cloud": cloud,
        "queries": count,
        "radius": radius,
        "pairs": len(expected[0]),
        "timings": timings,
    }


def best_ratio(timings: dict[str, Timing]) -> float:
    """How many times as long as ours the best peer takes."""
    peers = [t.median for name, t in timings.items() if name != OURS]
    return min(peers, default=float("nan")) / timings[OURS].median


def main(options: Options) -> dict[str, Any]:
    """Compare on every cloud and radius; returns what metrics.json holds."""
    require(options, {"points": 1, "queries": 1, "repeats": 1, "seed": 0})
    require_positive(options, "radii")
    require_some(options, "queries", "radii")
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
    } | circumstances(options, begin)
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

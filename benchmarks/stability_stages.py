"""Each stage in float32, and how far its result is from float64's."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.stability_cases import Case, many_points
from ginn_jax import hierarchy
from ginn_jax.density import kde_weight
from ginn_jax.errors import InputError
from ginn_jax.kernels import init_kernel
from ginn_jax.mcconv import mc_conv
from ginn_jax.neighbors import find_neighbors
from ginn_jax.packets import EdgeLimit, radius_edges
from ginn_jax.receptive_field import (
    Field,
    Oriented,
    kernel_inputs,
    point_area,
    surface_weight,
)
from ginn_jax.voxels import build_grid

RADIUS = 0.15
ROOM = EdgeLimit(1 << 15, 1 << 16, 1 << 12, 1 << 20)
KEY = 3
Row = dict[str, Any]


def error(found: Any, exact: Any) -> tuple[float, int]:
    """Largest difference of any array, relative to its largest number; non-finites."""
    worst, bad = 0.0, 0
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(exact), strict=True):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        finite = np.isfinite(a) & np.isfinite(b)
        bad += int((~finite).sum())
        if finite.any() and (gap := np.abs(a - b)[finite].max()) > 0:
            worst = max(worst, float(gap / max(np.abs(b[finite]).max(), 1e-300)))
    return worst, bad


@contextmanager
def double() -> Iterator[None]:
    """Float64, compiled in half the time: only the result matters."""
    jax.config.update("jax_disable_most_optimizations", True)
    try:
        with jax.enable_x64(True):
            yield
    finally:
        jax.config.update("jax_disable_most_optimizations", False)


def in_double(tree: Any) -> Any:
    """Floats in float64; call it, and use the result, where x64 is enabled."""
    return jax.tree.map(
        lambda a: np.asarray(a, np.float64) if a.dtype == np.float32 else np.asarray(a),
        tree,
    )


def row(
    stage: str, case: str, call: Callable[[], Any], exact: Callable[..., Any]
) -> Row:
    """One line of the table; the time is that of a second call."""
    try:
        call()
        begin = time.perf_counter()
        found = jax.block_until_ready(call())
    except InputError as refusal:
        return {"stage": stage, "case": case, "note": f"refused: {refusal}"}
    seconds = time.perf_counter() - begin
    worst, bad = exact(found)
    return {
        "stage": stage,
        "case": case,
        "error": worst,
        "bad": bad,
        "ms": 1e3 * seconds,
    }


# Search and Poisson disk


def search_row(case: Case) -> Row:
    """`find_neighbors` against brute force."""
    points, radius = case.position[: case.count], case.scale * RADIUS

    def exact(found: Any) -> tuple[float, int]:
        near = [
            (np.sum((points - q) ** 2, axis=1) < radius**2).nonzero()[0] for q in points
        ]
        wanted = np.zeros((len(points), len(points)), bool)
        for i, row in enumerate(near):
            wanted[i, row] = True
        listed = np.zeros_like(wanted)
        listed[found] = True
        return int((wanted != listed).sum()) / max(int(wanted.sum()), 1), 0

    return row(
        "search", case.name, lambda: find_neighbors(points, points, radius), exact
    )


def disk_row(case: Case) -> Row:
    """`poisson_disk` against dart throwing, one point after the other."""
    points, radius = case.position[: case.count], case.scale * RADIUS
    key = jax.random.key(KEY)

    def exact(found: Any) -> tuple[float, int]:
        lots = np.asarray(hierarchy.draw_lots(len(points), key=key))
        kept: list[int] = []
        for i in np.argsort(lots, kind="stable"):
            if (np.sum((points[kept] - points[i]) ** 2, axis=1) >= radius**2).all():
                kept.append(int(i))
        return len(set(kept) ^ set(found.tolist())) / len(kept), 0

    def call() -> Any:
        return hierarchy.poisson_disk(points, radius, key=key)

    return row("Poisson disk", case.name, call, exact)


# One layer


@jax.jit
def layer(points: Oriented, radius: Any, features: Any, kernel: Any) -> Any:
    """Areas, densities and a convolution with its gradients."""
    position, count = points.position, points.position.shape[0]
    grid = build_grid(position, points.mask, radius)
    edges = radius_edges(grid, position, points.mask, radius, ROOM)
    area = point_area(position, points.mask, edges, radius)
    kde = kde_weight(position, edges, count, radius, 0.25)
    inputs = kernel_inputs(points, points, edges, radius, True)
    weight = surface_weight(area, edges, count, radius)
    field = Field(edges.sender, edges.receiver, inputs, weight, edges.demand.edges)

    def total(kernel: Any, features: Any) -> Any:
        found = mc_conv(kernel, features, field, count)
        return jnp.sum(jnp.sin(found)), found

    slopes, found = jax.grad(total, (0, 1), has_aux=True)(kernel, features)
    density = jax.ops.segment_sum(kde, edges.receiver, count)
    return area, density, found, slopes


def layer_rows(case: Case) -> list[Row]:
    """Weights, convolution and gradient against the same in float64."""
    rng = np.random.default_rng(0)
    width = 4
    kernel = jax.tree.map(
        np.asarray, init_kernel(7, width, 8, width, key=jax.random.key(0))
    )
    features = rng.normal(size=(len(case.position), width)).astype(np.float32)
    given = oriented(case), np.float32(case.scale * RADIUS), features, kernel
    with double():
        exact = jax.device_get(layer(*in_double(given)))
    names = ("surface weight", "kde weight", "convolution", "its gradient")

    def run() -> Any:
        return jax.device_get(layer(*given))

    return [
        row(name, case.name, run, lambda found, i=i: error(found[i], exact[i]))
        for i, name in enumerate(names)
    ]


def oriented(case: Case) -> Oriented:
    """The cloud as functions under jit take it."""
    mask = np.arange(len(case.position)) < case.count
    return Oriented(
        case.position.astype(np.float32), case.normal.astype(np.float32), mask
    )


# A large cloud


def large_rows(count: int) -> list[Row]:
    """A cloud of many points, searched and thinned; brute force would take days."""
    points, rows = many_points(count), []
    radius = float(np.sqrt(16 / count))
    calls = {
        "search": lambda: find_neighbors(points, points, radius),
        "Poisson disk": lambda: hierarchy.poisson_disk(
            points, radius, key=jax.random.key(0)
        ),
    }
    for stage, call in calls.items():
        made = row(
            stage, f"{count} points", call, partial(check_some, points, radius, stage)
        )
        rows.append(made)
    return rows


def check_some(
    points: np.ndarray, radius: float, stage: str, found: Any
) -> tuple[float, int]:
    """The share of some 200 points whose neighbours are not what brute force finds."""
    tested = range(0, len(points), max(len(points) // 200, 1))
    wrong, kept = 0, set(found.tolist()) if stage != "search" else set()
    for i in tested:
        near = np.flatnonzero(np.sum((points - points[i]) ** 2, axis=1) < radius**2)
        if stage == "search":
            mine = found[1][
                np.searchsorted(found[0], i) : np.searchsorted(found[0], i, "right")
            ]
            wrong += set(mine.tolist()) != set(near.tolist())
        else:
            others = kept.intersection(near.tolist())
            wrong += len(others) < 1 or (i in kept and len(others) > 1)
    return wrong / len(tested), 0

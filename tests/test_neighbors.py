"""Radius search against a double loop, and the promises about capacities."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from oracles import neighbors
from scipy.spatial import cKDTree
from strategies import (
    ALL_PAIRS,
    POINTS,
    QUERIES,
    RADII,
    Cloud,
    clouds,
    coordinates,
    pad,
    padded,
)

from ginn_jax import neighbors as nb
from ginn_jax import packets as pk
from ginn_jax import pairs as found_pairs
from ginn_jax import voxels as vx
from ginn_jax.candidates import PACKET
from ginn_jax.errors import InputError

INT32_MAX = 2**31 - 1

pytestmark = pytest.mark.usefixtures("cheap_compiling")


def found(points, queries, radius):
    receiver, sender = nb.find_neighbors(points, queries, radius)
    assert receiver.dtype == sender.dtype == np.int32
    assert (np.diff(receiver) >= 0).all()
    pairs = list(zip(receiver.tolist(), sender.tolist(), strict=True))
    assert len(set(pairs)) == len(pairs)
    return sorted(pairs)


make_grid = jax.jit(vx.build_grid)
search = jax.jit(pk.radius_edges, static_argnames=("limit", "pair_filter"))


def edges_of(points, queries, radius, limit=ALL_PAIRS, reach=None, pair_filter=None):
    """Edges as NumPy arrays; the grid is made for `reach`, the radius if not given."""
    grid = make_grid(*points, np.float32(reach or radius))
    edges = search(grid, *queries, np.float32(radius), limit, pair_filter)
    return jax.tree.map(np.asarray, edges)


def pairs_of(edges, queries):
    """(query, point) of the real edges, which are sorted, unique, and padded right."""
    sender, receiver, _ = edges
    count = min(int(edges.demand.edges), len(receiver))
    assert (receiver[count:] == len(queries.mask)).all()
    assert (sender[count:] == 0).all()
    assert (np.diff(receiver) >= 0).all()
    pairs = list(zip(receiver[:count].tolist(), sender[:count].tolist(), strict=True))
    assert len(set(pairs)) == len(pairs)
    return set(pairs)


def sandwich(points, queries, radius):
    """The pairs that float32 must find, and those that it may find."""
    (p, point_row), (q, query_row) = points.real(), queries.real()
    radius = float(np.float32(radius))
    return [
        {(query_row[i], point_row[j]) for i, j in neighbors(p, q, radius * slack)}
        for slack in (1 - 1e-6, 1 + 1e-6)
    ]


@pytest.mark.usefixtures("full_compiling")
@given(clouds(), clouds(), RADII, st.sampled_from([0, nb.MANY]))
def test_host_search_equals_brute_force(points, queries, radius, many):
    points, queries = points.astype(np.float64), queries.astype(np.float64)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nb, "MANY", many)  # queries in order of a curve, or as they are
        assert found(points, queries, radius) == neighbors(points, queries, radius)


def test_queries_in_no_order_are_not_searched_one_by_one(monkeypatch):
    """A packet of queries far apart has more to list than one of neighbours."""
    normal = np.random.default_rng(3).normal(size=(6000, 3))
    cloud = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    monkeypatch.setattr(nb, "QUERY_BLOCK", 1000)
    monkeypatch.setattr(nb, "WORD_BLOCK", 300)
    monkeypatch.setattr(nb, "MANY", 5000)
    search, calls = nb._search_block, []
    monkeypatch.setattr(
        nb, "_search_block", lambda *args: calls.append(0) or search(*args)
    )
    nb.find_neighbors(cloud, cloud, 0.02)
    assert len(calls) == 6


@given(
    hnp.arrays(np.float64, (12, 3), elements=st.integers(-5, 5).map(lambda k: k * 0.1)),
    st.sampled_from([0.1, 0.2, 0.3]),
    st.sampled_from([0.0, 1e4]),
    st.sampled_from([0, 1000]),
)
def test_host_search_is_exact_at_the_radius(cloud, radius, shift, few):
    """Distances that differ from the radius by one rounding of float64, or by none."""
    cloud = cloud + shift
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(found_pairs, "FEW", few)  # left out one by one, or all at once
        assert found(cloud, cloud, radius) == neighbors(cloud, cloud, radius)


def test_host_search_tells_apart_what_float32_does_not():
    points = np.array([[0.0, 0, 0], [1e6, 0, 0]])
    queries = np.array([[1e6, 0.01, 0], [1e6 - 0.004, 0, 0]])
    for radius in (0.003, 0.005, 0.02):
        expected = neighbors(points, queries, radius)
        assert found(points, queries, radius) == expected


def test_host_search_accepts_float32_points():
    cloud = np.random.default_rng(0).random((40, 3), np.float32)
    assert found(cloud, cloud, 0.3) == neighbors(cloud, cloud, 0.3)


def test_host_search_takes_queries_in_blocks(monkeypatch):
    """Blocks smaller than the queries and the candidates change nothing."""
    cloud = np.random.default_rng(1).random((120, 3))
    monkeypatch.setattr(nb, "QUERY_BLOCK", 100)
    monkeypatch.setattr(nb, "WORD_BLOCK", 2)
    expected = neighbors(cloud, cloud, 0.3)
    assert found(cloud, cloud, 0.3) == expected


def test_host_search_equals_kd_tree():
    rng = np.random.default_rng(2)
    points, queries = rng.normal(size=(1500, 3)), rng.normal(size=(2500, 3))
    lists = cKDTree(points).query_ball_point(queries, 0.3)
    expected = [(i, j) for i, row in enumerate(lists) for j in sorted(row)]
    assert len(expected) > 9000
    assert found(points, queries, 0.3) == expected


@pytest.mark.parametrize("points", [0, 1])
@pytest.mark.parametrize("queries", [0, 1])
def test_host_search_of_nothing_finds_nothing(points, queries):
    pairs = found(np.zeros((points, 3)), np.zeros((queries, 3)), 0.5)
    assert pairs == [(0, 0)] * (points * queries)


@pytest.mark.parametrize("radius", [0.1, 0.05, 0.3])
def test_jitted_search_finds_what_lies_on_the_far_border(radius):
    """Of a box of whole cells, in which rounding decides about one cell more."""
    for cells in range(1, 120):
        far = np.float32(cells) * np.float32(radius)
        cloud = pad(np.array([[-0.3, 0, 0], [far - np.float32(0.3), far, far]]), POINTS)
        assert pairs_of(edges_of(cloud, cloud, radius), cloud) >= {(0, 0), (1, 1)}


@pytest.mark.usefixtures("full_compiling")
@settings(max_examples=50)
@given(padded(), padded(QUERIES), RADII)
def test_jitted_search_equals_brute_force_but_for_rounding(points, queries, radius):
    edges = edges_of(points, queries, radius)
    sure, possible = sandwich(points, queries, radius)
    assert sure <= pairs_of(edges, queries) <= possible
    assert edges.demand.edges <= PACKET * edges.demand.candidates
    assert edges.demand.candidates <= ALL_PAIRS.candidates


COARSE = coordinates(st.integers(-4, 4).map(lambda k: k / 8))


@given(padded(source=COARSE), st.sampled_from([0.125, 0.25, 0.625]))
def test_jitted_search_excludes_points_at_exactly_the_radius(points, radius):
    """Nothing is rounded here, and many distances are the radius, as 3-4-5 / 8 is."""
    (place, row), edges = points.real(), edges_of(points, points, radius)
    expected = {(row[i], row[j]) for i, j in neighbors(place, place, radius)}
    assert pairs_of(edges, points) == expected


@given(padded(), RADII)
def test_search_of_a_cloud_in_itself_equals_brute_force(points, radius):
    sure, possible = sandwich(points, points, radius)
    assert sure <= pairs_of(edges_of(points, points, radius), points) <= possible


@given(padded(), padded(QUERIES), st.floats(0.01, 1))
def test_a_wide_grid_serves_smaller_radii(points, queries, radius):
    sure, possible = sandwich(points, queries, radius)
    assert sure <= pairs_of(edges_of(points, queries, radius, reach=1.0), queries)
    assert pairs_of(edges_of(points, queries, radius, reach=1.0), queries) <= possible


def test_search_is_complete_where_cells_had_to_grow():
    """More columns than the table holds: 1000 radii wide, with neighbours in pairs."""
    rng = np.random.default_rng(3)
    first = rng.uniform(-5, 5, (POINTS // 2, 3))
    step = rng.normal(size=first.shape)
    second = first + 0.0099 * step / np.linalg.norm(step, axis=1, keepdims=True)
    points = pad(np.concatenate([first, second]).astype(np.float32), POINTS)
    sure, possible = sandwich(points, points, 0.01)
    assert len(sure) >= 2 * POINTS
    assert sure <= pairs_of(edges_of(points, points, 0.01), points) <= possible


@given(padded(), padded(QUERIES), RADII, st.permutations(range(POINTS)))
def test_permuting_points_permutes_edges(points, queries, radius, order):
    order = np.array(order)
    shuffled = Cloud(*(a[order] for a in points))
    pairs = pairs_of(edges_of(shuffled, queries, radius), queries)
    assert {(q, order[p]) for q, p in pairs} == pairs_of(
        edges_of(points, queries, radius), queries
    )


def not_third(sender, receiver):
    return (sender + receiver) % 3 != 0


@given(padded(), padded(QUERIES), RADII)
def test_a_filter_drops_exactly_its_pairs(points, queries, radius):
    some = edges_of(points, queries, radius, pair_filter=not_third)
    kept, pairs = (
        pairs_of(e, queries) for e in (some, edges_of(points, queries, radius))
    )
    assert kept == {(q, p) for q, p in pairs if (q + p) % 3 != 0}


def test_too_few_edges_are_told_exactly():
    rng = np.random.default_rng(4)
    points = pad(rng.random((POINTS, 3)).astype(np.float32), POINTS)
    full = edges_of(points, points, 0.4)
    edges = int(full.demand.edges) - 1
    assert POINTS < edges < ALL_PAIRS.edges
    short = edges_of(points, points, 0.4, replace(ALL_PAIRS, edges=edges))
    assert short.demand == full.demand
    assert len(pairs_of(short, points) & pairs_of(full, points)) == edges


def test_search_tells_of_more_candidates_than_int32_counts():
    """400,000 points in one place looked up from 200,000 queries beside them."""
    points = pad(np.zeros((400_000, 3), np.float32), 400_000)
    queries = pad(np.zeros((200_000, 3), np.float32), 200_000)
    limit = pk.EdgeLimit(8192, 64, 1, 64)
    edges = edges_of(points, queries, 0.1, limit)
    assert int(edges.demand.candidates) == INT32_MAX


@given(st.integers(1, 10**6))
def test_buckets_hold_their_count_and_waste_at_most_half(count):
    size = nb.bucket(count)
    assert size >= count
    assert size <= max(64, 1.5 * count)
    assert nb.bucket(size) == size


def test_a_query_of_a_later_block_is_looked_at(monkeypatch):
    monkeypatch.setattr(nb, "QUERY_BLOCK", 64)
    queries = np.zeros((200, 3))
    queries[190, 1] = np.nan
    for count in (5, 0):
        with pytest.raises(InputError, match="queries holds non-finite"):
            nb.find_neighbors(np.zeros((count, 3)), queries, 0.1)

"""Points far from all others: searched by themselves, and no pair lost or doubled."""

import warnings

import numpy as np
import pytest
from hypothesis import given
from oracles import neighbors
from scipy.spatial import cKDTree
from strategies import RADII, clouds

from ginn_jax import cells, outlying, samples
from ginn_jax import neighbors as nb

pytestmark = pytest.mark.usefixtures("cheap_compiling")


@pytest.mark.usefixtures("far_in_few")
@given(clouds(), clouds(), RADII)
def test_every_pair_is_in_one_half(points, queries, radius):
    points, queries = points.astype(np.float64), queries.astype(np.float64)
    if not (len(points) and len(queries)):
        return
    parts = outlying.set_apart(points, outlying.bounds_of(points), queries, radius)
    if parts is None:
        return
    found = []
    for asked, near in parts:
        pairs = neighbors(points[near], queries[asked], radius)
        found += [(asked[i], near[j]) for i, j in pairs]
    assert sorted(found) == neighbors(points, queries, radius)


@pytest.mark.usefixtures("far_in_few")
@given(clouds(), clouds(), RADII)
def test_search_equals_brute_force(points, queries, radius):
    pairs = np.stack(nb.find_neighbors(points, queries, radius), axis=1).tolist()
    assert (np.diff([i for i, _ in pairs]) >= 0).all()
    assert sorted(map(tuple, pairs)) == neighbors(points, queries, radius)


def test_pairs_across_the_border_are_found(monkeypatch):
    """A chain of points that leads out of a crowd."""
    monkeypatch.setattr(outlying, "WIDE", 0)
    crowd = np.random.default_rng(2).uniform(-0.5, 0.5, (5000, 3))
    chain = np.zeros((120, 3))
    chain[:60, 0] = chain[60:, 1] = 0.3 + 0.2 * np.arange(60)
    points = np.concatenate([crowd, chain])
    bounds = outlying.bounds_of(points)
    assert outlying.set_apart(points, bounds, chain, 0.25) is not None
    pairs = np.stack(nb.find_neighbors(points, chain, 0.25), axis=1).tolist()
    assert sorted(map(tuple, pairs)) == neighbors(points, chain, 0.25)


@pytest.mark.usefixtures("far_in_few")
@given(clouds().filter(len), RADII)
def test_cells_at_the_border_hold_what_lies_beyond(points, radius):
    found = cells.sort_into_cells(points, radius)
    assert 1 / found.rate >= radius
    np.testing.assert_array_equal(np.sort(found.order), np.arange(len(points)))
    place = np.floor((points - found.low) * found.rate)
    place = np.clip(place, 0, found.shape - 1).astype(int)
    number = np.ravel_multi_index(tuple(place.T), found.shape)
    np.testing.assert_array_equal(found.number, number[found.order])
    counts = np.bincount(number, minlength=np.prod(found.shape))
    np.testing.assert_array_equal(np.diff(found.start), counts)


def test_one_far_point_leaves_cells_small():
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (5000, 3)).astype(np.float32)
    alone = cells.sort_into_cells(points, 0.02)
    points[7] = 1e4
    found = cells.sort_into_cells(points, 0.02)
    assert found.rate > 0.5 * alone.rate
    assert np.diff(found.start).max() <= 2 * np.diff(alone.start).max()


@pytest.mark.parametrize("far", [0, 3])
def test_points_that_make_a_scan_small_are_counted(far):
    normal = np.random.default_rng(3).normal(size=(5000, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    position = normal.copy()
    position[:far, 1] += 100
    scan = samples.Samples(position, normal, np.zeros(5000, np.int32))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        samples.fit_unit_box_points(scan)
    assert [str(w.message)[:18] for w in said] == ["3 of 5000 points l"] * (far > 0)


@pytest.mark.parametrize("far_queries", [0, 3])
@pytest.mark.parametrize("far_points", [0, 1, 40])
@pytest.mark.parametrize("far", [30.0, 1e6])
def test_no_box_is_searched_that_is_nearly_empty(
    far, far_points, far_queries, monkeypatch
):
    rng = np.random.default_rng(0)
    points, queries = rng.uniform(-0.5, 0.5, (2, 6000, 3))
    points[:far_points] = far + rng.uniform(-0.5, 0.5, (far_points, 3))
    queries[:far_queries] = points[:far_queries] - 0.004
    queries[:far_queries] -= 2 * far * (far_points == 0)
    search, widths = nb._search, []

    def seen(points, queries, radius, center):
        both = np.concatenate([points, queries])
        widths.append(np.ptp(both, axis=0).max())
        return search(points, queries, radius, center)

    monkeypatch.setattr(nb, "_search", seen)
    query, point = nb.find_neighbors(points, queries, 0.03)
    assert widths
    assert max(widths) < 4
    lists = cKDTree(points).query_ball_point(queries, 0.03)
    expected = [(i, j) for i, row in enumerate(lists) for j in sorted(row)]
    pairs = zip(query.tolist(), point.tolist(), strict=True)
    assert sorted(pairs) == expected
    assert len(expected) > 3000

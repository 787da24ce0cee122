"""Poisson disk sampling against sequential dart throwing."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from disks import Room, build_level
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import dart_throwing, distance
from strategies import ALL_PAIRS, POINTS, RADII, SEEDS, clouds, pad, padded

from ginn_jax import hierarchy as hi
from ginn_jax.errors import InputError
from ginn_jax.voxels import build_grid

pytestmark = pytest.mark.usefixtures("cheap_compiling")

NORMAL = np.arange(3.0 * POINTS, dtype=np.float32).reshape(POINTS, 3)
# On the host each number of conflicts is compiled anew.
FEWER = settings(max_examples=12)
FULL = Room(ALL_PAIRS, POINTS)


@partial(jax.jit, static_argnames=("limit", "sided"))
def build(cloud, normal, radius, seed, limit, sided=False):
    grid = build_grid(*cloud, radius)
    key = jax.random.key(seed)
    position, mask = cloud
    return build_level(
        grid,
        position,
        normal,
        mask,
        radius,
        limit,
        hi.draw_lots(len(position), key=key),
        sided,
    )


def level_of(cloud, radius, seed, limit=FULL):
    normal = np.resize(NORMAL, cloud.position.shape)
    built = build(cloud, normal, np.float32(radius), seed, limit)
    return jax.tree.map(np.asarray, built)


def disk(cloud, radius, seed):
    """Rows of the points kept."""
    level, demand = level_of(cloud, radius, seed)
    assert demand.points == level.mask.sum()
    return level.index[level.mask]


def host_disk(points, radius, seed):
    return hi.poisson_disk(points, radius, key=jax.random.key(seed))


def assert_maximal(points, kept, radius, slack=0.0):
    """Kept points are at least `radius` apart, and no point has room for another."""
    for i, point in enumerate(points):
        near = [distance(point, points[k]) for k in kept if k != i]
        if i in kept:
            assert min(near, default=np.inf) >= radius * (1 - slack)
        else:
            assert min(near) < radius * (1 + slack)


@FEWER
@given(clouds(), RADII, SEEDS)
def test_host_sample_is_maximal_and_spaced(points, radius, seed):
    points = points.astype(np.float64)
    kept = host_disk(points, radius, seed)
    assert kept.dtype == np.int32
    assert len(kept) == 0 or (kept[0] >= 0 and kept[-1] < len(points))
    assert (np.diff(kept) > 0).all()
    assert_maximal(points, set(kept.tolist()), radius)


@pytest.mark.usefixtures("full_compiling")
@FEWER
@given(clouds(), RADII, SEEDS)
def test_host_sample_equals_dart_throwing(points, radius, seed):
    points = points.astype(np.float64)
    lots = hi.draw_lots(POINTS, key=jax.random.key(seed))[: len(points)]
    expected = dart_throwing(points, radius, lots)
    assert host_disk(points, radius, seed).tolist() == expected


@given(padded(), RADII, SEEDS)
def test_jitted_sample_is_maximal_and_keeps_no_masked_point(cloud, radius, seed):
    kept = disk(cloud, radius, seed)
    points, rows = cloud.real()
    assert set(kept) <= set(rows)
    real_kept = {int(np.flatnonzero(rows == k)[0]) for k in kept}
    assert_maximal(points, real_kept, float(np.float32(radius)), 1e-6)


@pytest.mark.usefixtures("full_compiling")
@given(padded(), SEEDS)
def test_jitted_sample_equals_dart_throwing(cloud, seed):
    """Of the points that count, with their own lots; .3 is no distance drawn here."""
    points, rows = cloud.real()
    lots = np.asarray(hi.draw_lots(POINTS, key=jax.random.key(seed)))[rows]
    expected = rows[dart_throwing(points, 0.297, lots)]
    np.testing.assert_array_equal(disk(cloud, 0.297, seed), expected)


@given(padded(), SEEDS, st.integers(0, 2**POINTS - 1))
def test_sided_sample_equals_dart_throwing_of_sides(cloud, seed, sides):
    """Each point looks up or down, a little aslant."""
    up = [1.0 if sides >> i & 1 else -1.0 for i in range(POINTS)]
    normal = np.stack([np.full(POINTS, 0.6), np.zeros(POINTS), up], 1, dtype=np.float32)
    normal *= np.float32([0.5, 1, 0.8])
    level, _ = build(cloud, normal, np.float32(0.297), seed, FULL, sided=True)
    points, rows = cloud.real()
    lots = np.asarray(hi.draw_lots(POINTS, key=jax.random.key(seed)))[rows]
    expected = rows[dart_throwing(points, 0.297, lots, normal[rows])]
    np.testing.assert_array_equal(level.index[level.mask], expected)


@pytest.mark.parametrize("lots", [[5, 5, 5, 5], [3, 2, 2, 3]])
def test_equal_lots_are_thrown_by_index(monkeypatch, lots):
    points = np.array([[0.0, 0, 0], [0.6, 0, 0], [1.2, 0, 0], [1.8, 0, 0]])
    monkeypatch.setattr(hi, "draw_lots", lambda n, key: jnp.array(lots, jnp.uint32))
    expected = dart_throwing(points, 1.0, lots)
    assert host_disk(points, 1.0, 0).tolist() == expected


@given(padded(), RADII, SEEDS)
def test_a_key_gives_one_sample(cloud, radius, seed):
    first, again = disk(cloud, radius, seed), disk(cloud, radius, seed)
    np.testing.assert_array_equal(first, again)


def test_other_keys_give_other_samples():
    cloud = np.random.default_rng(0).random((60, 3))
    samples = {tuple(host_disk(cloud, 0.5, seed).tolist()) for seed in range(8)}
    assert len(samples) == 8


@given(clouds(), RADII, SEEDS)
def test_padding_does_not_change_the_sample(points, radius, seed):
    kept = disk(pad(points, POINTS), radius, seed)
    wider = pad(points, 2 * POINTS, garbage=np.nan)
    np.testing.assert_array_equal(kept, disk(wider, radius, seed))


@given(st.integers(1, POINTS), RADII, SEEDS)
def test_of_coincident_points_one_is_kept(count, radius, seed):
    points = np.tile([[0.3, -0.2, 0.7]], (count, 1))
    assert len(host_disk(points, radius, seed)) == 1
    assert len(disk(pad(points, POINTS), radius, seed)) == 1


def test_a_long_chain_of_conflicts_is_settled(monkeypatch):
    """Lots that ascend along a line: each point waits for the one before it."""
    count = 50
    lots = np.arange(count, dtype=np.uint32)
    monkeypatch.setattr(hi, "draw_lots", lambda n, key: jnp.asarray(lots))
    points = np.outer(np.arange(count), [0.6, 0, 0])
    assert host_disk(points, 1.0, 0).tolist() == list(range(0, count, 2))


@given(padded(), RADII, SEEDS)
def test_level_holds_the_sample_then_zeros(cloud, radius, seed):
    level, _ = level_of(cloud, radius, seed)
    count = level.mask.sum()
    kept = level.index[:count]
    assert level.mask[:count].all()
    np.testing.assert_array_equal(level.position[:count], cloud.position[kept])
    np.testing.assert_array_equal(level.normal[:count], NORMAL[kept])
    assert not level.position[count:].any()
    assert not level.normal[count:].any()


@pytest.fixture(scope="module")
def dense():
    points = np.random.default_rng(1).random((POINTS, 3)).astype(np.float32)
    cloud = pad(points, POINTS)
    return cloud, *level_of(cloud, 0.4, 0)


def test_too_few_edges_are_told(dense):
    cloud, _, need = dense
    short = replace(ALL_PAIRS, edges=int(need.search.edges) - 1)
    demand = level_of(cloud, 0.4, 0, Room(short, POINTS))[1]
    assert demand.search == need.search


def test_too_few_points_are_told_and_the_first_are_kept(dense):
    cloud, level, need = dense
    room = int(need.points) - 1
    short, demand = level_of(cloud, 0.4, 0, Room(ALL_PAIRS, room))
    assert demand == need
    assert short.mask.all()
    np.testing.assert_array_equal(short.index, level.index[:room])


@pytest.mark.parametrize("radius", [0.0, -1.0, np.nan])
def test_bad_radius_is_one_line(radius):
    with pytest.raises(InputError, match=r"^radius is [^\n]*\Z"):
        host_disk(np.zeros((2, 3)), radius, 0)


def test_non_finite_points_are_one_line():
    with pytest.raises(InputError, match=r"^points holds non-finite [^\n]*\Z"):
        host_disk(np.full((2, 3), np.nan), 0.1, 0)

"""Levels of a cloud that moves: points that were kept are kept again."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from oracles import distance
from small_sphere import CLOUD, LEVELS, NETWORKS, as_numpy, generous
from strategies import ALL_PAIRS, POINTS, SEEDS, padded

from ginn_jax import hierarchy, inference, levels
from ginn_jax.packets import radius_edges
from ginn_jax.train import state_shapes
from ginn_jax.voxels import build_grid

pytestmark = pytest.mark.usefixtures("cheap_compiling")

# No distance between points on the tests' lattices, nor is `HOLD` of it.
RADIUS = 0.297
MASKS = hnp.arrays(bool, POINTS)


def rows_within(reach):
    """Rows of numbers drawn one by one, so that no two are the same by default."""
    elements = st.floats(-reach, reach, width=32)
    return hnp.arrays(np.float32, (POINTS, 3), elements=elements, fill=st.nothing())


@jax.jit
def sample(cloud, seed, kept_before=None):
    position, mask = cloud
    radius = jnp.float32(RADIUS)
    grid = build_grid(position, mask, radius)
    lots = hierarchy.draw_lots(POINTS, key=jax.random.key(seed))
    given = grid, position, mask, radius, ALL_PAIRS, lots
    return hierarchy.sample_disk(*given, kept_before=kept_before)[0]


def held_darts(points, lots, before):
    """Those kept before are thrown first, and bear each other down to .6 radii."""
    kept = []
    for i in sorted(range(len(points)), key=lambda i: (not before[i], int(lots[i]), i)):
        apart = [
            RADIUS * (0.6 if before[i] and before[k] else 1.0)
            <= distance(points[i], points[k])
            for k in kept
        ]
        if all(apart):
            kept.append(i)
    return sorted(kept)


@given(padded(), SEEDS, MASKS)
def test_points_kept_before_are_thrown_first_and_bear_each_other(cloud, seed, before):
    points, rows = cloud.real()
    lots = np.asarray(hierarchy.draw_lots(POINTS, key=jax.random.key(seed)))[rows]
    expected = rows[held_darts(points, lots, before[rows])]
    found = np.flatnonzero(sample(cloud, seed, before))
    np.testing.assert_array_equal(found, expected)


@jax.jit
def sample_by_edges(cloud, seed, kept_before, normal):
    """With and without pairs at hand, which are also of those half as far again."""
    position, mask = cloud
    radius = jnp.float32(RADIUS)
    grid = build_grid(position, mask, radius)
    lots = hierarchy.draw_lots(POINTS, key=jax.random.key(seed))
    edges = radius_edges(grid, position, mask, 1.5 * radius, ALL_PAIRS)
    more = lots, normal, kept_before
    chosen = hierarchy.choose_among(edges, position, mask, radius, *more)
    given = grid, position, mask, radius, ALL_PAIRS, *more
    return chosen, hierarchy.sample_disk(*given)[0]


@given(padded(), SEEDS, MASKS, rows_within(1.0))
def test_edges_at_hand_give_the_same_sample_as_a_search(cloud, seed, before, normal):
    chosen, searched = sample_by_edges(cloud, seed, before, normal)
    np.testing.assert_array_equal(chosen, searched)


@given(padded(), SEEDS, SEEDS)
def test_a_cloud_that_stays_keeps_its_points_whatever_the_lots(cloud, seed, other):
    first = np.asarray(sample(cloud, seed))
    np.testing.assert_array_equal(sample(cloud, other, first), first)


@given(padded(source=rows_within(0.375)), SEEDS, rows_within(0.125))
def test_points_that_move_a_fifth_of_the_radius_are_all_kept(cloud, seed, step):
    """No two then come nearer than .6 of it."""
    before = np.asarray(sample(cloud, seed))
    length = np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
    step = step * np.minimum(1, 0.19 * RADIUS / length)
    moved = cloud._replace(position=cloud.position + step)
    after = np.asarray(sample(moved, seed, before))
    assert not (before & ~after).any()


@partial(jax.jit, static_argnums=(0, 1))
def levels_of(network, limits, cloud, names, kept_before=None, *, key):
    given = network, limits, cloud, names, kept_before
    made, _, demands = levels.build_levels(*given, key=key)
    return made, demands


@pytest.fixture(scope="module")
def built():
    """A sphere's levels, the network and its room."""
    network = NETWORKS["surface"]
    limits, names = generous(network), np.arange(len(CLOUD.mask), dtype=np.int32)
    key = jax.random.key(2)
    return network, limits, as_numpy(levels_of(network, limits, CLOUD, names, key=key))


def test_kept_names_the_points_of_every_level(built):
    made, demands = built[2]
    assert made.kept.shape == (len(LEVELS), len(CLOUD.mask))
    for level, (points, kept) in enumerate(zip(made.points, made.kept, strict=True)):
        assert kept.sum() == points.mask.sum() == demands[f"level_{level}.points"]
        np.testing.assert_array_equal(
            points.position[points.mask], CLOUD.position[kept]
        )
    assert not (made.kept[1] & ~made.kept[0]).any()


def test_every_level_keeps_what_it_kept_however_points_are_sorted(built):
    """By name: under another order and other lots, the same points."""
    network, limits, (first, _) = built
    order = np.random.default_rng(0).permutation(len(CLOUD.mask)).astype(np.int32)
    cloud = jax.tree.map(lambda a: a[order], CLOUD)
    given = network, limits, cloud, order
    key = jax.random.key(5)
    again = as_numpy(levels_of(*given, first.kept, key=key)[0])
    other = as_numpy(levels_of(*given, key=key)[0])
    np.testing.assert_array_equal(again.kept, first.kept)
    assert all((a != b).any() for a, b in zip(other.kept, first.kept, strict=True))


def test_an_encoding_takes_what_the_one_before_kept():
    points = tiny.sphere_on_plane(1000, 4)
    rng = np.random.default_rng(0)
    variables = jax.tree.map(
        lambda leaf: rng.normal(size=leaf.shape).astype(leaf.dtype),
        state_shapes(replace(tiny.CONFIG, network=tiny.ONE_LEVEL)).variables,
    )
    given = variables, points.position, points.normal
    one, two = jax.random.split(jax.random.key(0))

    def encode(before, key):
        network, limits = tiny.ONE_LEVEL, tiny.ONE_LEVEL_LIMITS
        made, _ = inference.encode_cloud(
            network, limits, *given, kept_before=before, key=key
        )
        return made

    nothing = inference.nothing_kept(tiny.ONE_LEVEL, 1000)
    first = encode(nothing, one)
    assert first.kept is not None
    np.testing.assert_array_equal(first.kept, encode(None, one).kept)
    again = encode(first.kept, two)
    np.testing.assert_array_equal(again.kept, first.kept)
    jax.tree.map(np.testing.assert_array_equal, again.code, first.code)
    assert (np.asarray(encode(nothing, two).kept) != first.kept).any()

"""Levels, edges, areas and weights of a small sphere."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_sphere import (
    CLOUD,
    LEVELS,
    NETWORKS,
    QUERIES,
    RADIUS,
    as_jax,
    as_numpy,
    generous,
    jitted,
)

from ginn_jax import geometry as ge
from ginn_jax import limits as lm
from ginn_jax import searches as se
from ginn_jax.architecture import Network
from ginn_jax.packets import Demand, Edges
from ginn_jax.presets import only_2d, released_table

pytestmark = pytest.mark.usefixtures("cheap_compiling")


@pytest.fixture(scope="module", params=NETWORKS)
def built(request):
    config = NETWORKS[request.param]
    return config, *as_numpy(jitted(config, generous(config), CLOUD, QUERIES))


@pytest.fixture(scope="module")
def surface():
    config = NETWORKS["surface"]
    return config, *as_numpy(jitted(config, generous(config), CLOUD, QUERIES))


def real_rows(points):
    return np.asarray(points.position, np.float64)[points.mask]


def pairs(field, receivers):
    real = field.receiver < receivers
    return set(zip(field.receiver[real], field.sender[real], strict=True))


def test_every_limit_has_its_demand_and_every_demand_its_limit(built):
    config, _, _, demands = built
    assert (
        set(demands) == set(se.limit_names(config)) == set(dict(generous(config).sizes))
    )


def test_demands_within_limits_fit(built):
    config, _, _, demands = built
    exact = lm.Limits(tuple((name, int(d)) for name, d in demands.items()))
    for limits in (generous(config), exact):
        assert lm.fits(limits, as_jax(demands))
        assert lm.exceeded(limits, as_jax(demands)) == {}
    for name in demands:
        short = lm.Limits(tuple((n, c - (n == name)) for n, c in exact.sizes))
        assert not lm.fits(short, as_jax(demands))
        assert lm.exceeded(short, as_jax(demands)) == {name: exact.of(name)}


def test_levels_are_nested_poisson_disks(built):
    config, geometry, _, _ = built
    finest = geometry.finest[geometry.levels[0].mask]
    cloud = CLOUD
    np.testing.assert_array_equal(
        geometry.levels[0].position[geometry.levels[0].mask], cloud.position[finest]
    )
    finer = real_rows(cloud)
    for level, radius in zip(geometry.levels, config.levels, strict=True):
        points = real_rows(level)
        assert set(map(tuple, points)) <= set(map(tuple, finer))
        distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
        assert distance[np.triu_indices(len(points), 1)].min() >= radius * (1 - 1e-6)
        reach = np.linalg.norm(finer[:, None] - points[None], axis=-1).min(axis=1)
        assert reach.max() < radius * (1 + 1e-6)
        np.testing.assert_array_equal(level.normal, level.position / RADIUS)
        assert not level.position[~level.mask].any()
        finer = points


def test_fields_hold_the_pairs_of_a_direct_search(built):
    """Also where the edges of another convolution are turned round."""
    config, geometry, query_field, _ = built
    fields = [(geometry.fields[c.name], c) for c in config.encoder]
    for field, conv in [*fields, (query_field, config.query)]:
        senders = geometry.levels[conv.source]
        receivers = QUERIES if conv is config.query else geometry.levels[conv.target]
        places = np.flatnonzero(receivers.mask)
        expected = oracles.neighbors(
            real_rows(senders), receivers.position[places], np.float32(conv.radius)
        )
        expected = {(places[q], p) for q, p in expected}
        assert len(expected) > len(places)
        assert pairs(field, len(receivers.mask)) == expected


def test_inputs_point_from_sender_to_receiver(built):
    config, geometry, query_field, _ = built
    fields = [(geometry.fields[c.name], c) for c in config.encoder]
    for field, conv in [*fields, (query_field, config.query)]:
        receivers = QUERIES if conv is config.query else geometry.levels[conv.target]
        real = field.receiver < len(receivers.mask)
        x = receivers.position[field.receiver[real]]
        y = geometry.levels[conv.source].position[field.sender[real]]
        np.testing.assert_allclose(
            field.inputs.T[real, :3], (x - y) / np.float32(conv.radius), atol=1e-6
        )
        assert not field.inputs[:, ~real].any()
        assert not field.weight[~real].any()
        assert (field.weight[real] > 0).all()


def test_areas_add_up_to_the_surface(surface):
    _, geometry, _, _ = surface
    area, mask = geometry.area, geometry.levels[0].mask
    assert not area[~mask].any()
    assert area.sum() == pytest.approx(4 * np.pi * RADIUS**2, rel=0.05)


def test_weights_are_areas_relative_to_the_disk(surface):
    config, geometry, query_field, _ = surface
    points = real_rows(geometry.levels[0])
    within = next(c for c in config.encoder if c.source == c.target == 0)
    area = [oracles.quartic_area(p, points, within.radius) for p in points]
    np.testing.assert_allclose(geometry.area[: len(points)], area, rtol=1e-4)
    real = query_field.receiver < len(QUERIES.mask)
    expected = np.array(area)[query_field.sender[real]]
    expected /= np.pi * config.query.radius**2
    np.testing.assert_allclose(query_field.weight[real], expected, rtol=1e-4)


def test_exact_limits_give_the_same_geometry(surface):
    """Larger capacities only add padding."""
    config, geometry, query_field, demands = surface
    exact = lm.Limits(tuple((name, int(d)) for name, d in demands.items()))
    tight, tight_query, same = as_numpy(jitted(config, exact, CLOUD, QUERIES))
    assert same == demands
    count = len(tight.levels[0].mask)
    assert tight.levels[0].mask.all()
    np.testing.assert_array_equal(tight.area, geometry.area[:count])
    for conv in config.encoder:
        few, many = tight.fields[conv.name], geometry.fields[conv.name]
        rows = len(tight.levels[conv.target].mask)
        wide = len(geometry.levels[conv.target].mask)
        assert pairs(few, rows) == pairs(many, wide)
        assert sum(few.weight) == pytest.approx(sum(many.weight), rel=1e-5)
    few = query_field.receiver < len(QUERIES.mask)
    np.testing.assert_array_equal(tight_query.weight, query_field.weight[few])


@given(
    st.lists(st.tuples(st.integers(0, 6), st.integers(0, 4)), unique=True, max_size=8)
)
def test_turned_edges_are_the_same_pairs(drawn):
    """Edges as (receiver of 7, sender of 5), padded to 9 rows."""
    drawn = sorted(drawn)
    receiver, sender = np.full(9, 7, np.int32), np.zeros(9, np.int32)
    for row, (r, s) in enumerate(drawn):
        receiver[row], sender[row] = r, s
    need = jnp.int32(len(drawn))
    edges = Edges(
        jnp.asarray(sender), jnp.asarray(receiver), Demand(need, need, need, need)
    )
    turned = as_numpy(ge.turn_edges(edges, 5, 7))
    real = turned.receiver < 5
    assert (turned.receiver[~real] == 5).all()
    listed = zip(turned.sender[real], turned.receiver[real], strict=True)
    assert sorted(listed) == drawn


def test_only_convolutions_between_levels_are_turned():
    config = NETWORKS["surface"]
    twins = {c.name: se.transposed(config, c) for c in config.encoder}
    assert twins == {"conv_0": None, "pool_1": "up_1", "conv_1": None, "up_1": None}
    kde = replace(config, density="kde")
    assert not any(se.transposed(kde, c) for c in kde.encoder)
    released = Network((0.1,) * 4, released_table(2, (0.1, 0.2, 0.4)), kde.query, 2, 2)
    twins = {c.name: se.transposed(released, c) for c in released.encoder}
    # pool_1 reaches half as far as up_1.
    assert {k: v for k, v in twins.items() if v} == {"pool_2": "up_2", "pool_3": "up_3"}


@partial(jax.jit, static_argnums=(0, 1))
def named_levels(config, limits, cloud, names):
    """Levels only: XLA drops the searches that come after them."""
    built, _ = ge.build_geometry(config, limits, cloud, names, key=jax.random.key(2))
    return built.levels


@pytest.mark.parametrize("seed", [0, 1])
def test_levels_are_of_the_same_points_however_they_are_sorted(seed):
    """What keeps a moving cloud from flickering: lots go by name, not by place."""
    config = NETWORKS["surface"]
    order = np.random.default_rng(seed).permutation(len(CLOUD.mask)).astype(np.int32)
    sorted_cloud = jax.tree.map(lambda a: a[order], CLOUD)
    whole = generous(config)
    one = named_levels(config, whole, CLOUD, np.arange(len(order), dtype=np.int32))
    two = named_levels(config, whole, sorted_cloud, order)
    other = named_levels(config, whole, sorted_cloud, np.arange(340, dtype=np.int32))

    def points(levels, level):
        place = as_numpy(levels[level])
        return {tuple(p) for p in place.position[place.mask].tolist()}

    for level in range(len(LEVELS)):
        assert points(one, level) == points(two, level)
        assert points(one, level) != points(other, level)


def test_a_network_without_f_3d_finds_the_same_areas(surface):
    flat = only_2d(surface[0])
    built = as_numpy(jitted(flat, generous(flat), CLOUD, QUERIES))
    geometry, _, demands = built
    assert lm.exceeded(generous(flat), as_jax(demands)) == {}
    np.testing.assert_allclose(geometry.area, surface[1].area, rtol=1e-5)

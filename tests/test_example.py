"""What a training step is made of: points given, points asked, their targets."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import short_run
import tiny
from hypothesis import given
from hypothesis import strategies as st

from ginn_jax import dataset, example, train
from ginn_jax.geometry import Geometry
from ginn_jax.objective import init_variables
from ginn_jax.receptive_field import Oriented


def test_left_over_points_carry_the_loss():
    # 12 points: level 0 has points 0, 4 and 7; its last rows are padding.
    mask = np.array([True, True, True, False, False])
    level = Oriented(np.zeros((5, 3), np.float32), np.zeros((5, 3), np.float32), mask)
    finest = jnp.array([0, 4, 7, 11, 11], jnp.int32)
    geometry = Geometry((level,), finest, {}, None, None)
    left_over = jax.jit(example.left_over, static_argnums=2)
    rows, real = left_over(geometry, jnp.ones(12, bool), 3)
    assert real.all()
    assert rows.tolist() == [2, 6, 10]
    rows, real = left_over(geometry, jnp.ones(12, bool), 11)
    assert rows[real].tolist() == [1, 2, 3, 5, 6, 8, 9, 10, 11]
    assert real.tolist() == [True] * 9 + [False] * 2


@pytest.mark.parametrize("sparsest", [1.0, 0.1])
def test_queries_lie_beside_the_finest_level(sparsest):
    config = replace(tiny.CONFIG, network=tiny.ONE_LEVEL, queries=100)
    config = replace(config, sparsest=sparsest)
    build = partial(train.make_example, config, tiny.ONE_LEVEL_LIMITS)
    with tiny.cheap_compiling():
        made, _ = jax.jit(build)(tiny.batch(), key=jax.random.key(3))
    queries, level = made.queries, made.geometry.levels[0]
    assert queries.mask.sum() == 200
    turned = np.array(queries.position)[:, 0] > 2
    position = np.array(queries.position, np.float64)
    kept = np.array(level.position)[np.array(level.mask)].astype(np.float64)
    distance = np.linalg.norm(position[:, None] - kept, axis=-1).min(axis=1)
    assert distance.min() > 0
    # Of a share of the cloud, points are asked for that no Poisson disk covers.
    assert (distance.max() < 0.08) == (sparsest == 1)
    # Each still has its own target, wherever rotation and thinning have put it.
    centred = position - np.outer(turned, [4, 0, 0])
    exact = tiny.exact_openness(centred, np.array(queries.normal))
    np.testing.assert_allclose(made.target, exact, atol=1e-4)


def test_parameters_begin_alike_whatever_the_cloud():
    """Those of a blank example are those of a real one, bit for bit."""
    more = {"lights": 1, "materials": 3, "asks": "all"}
    network = replace(tiny.ONE_LEVEL, **more)
    config = replace(tiny.CONFIG, network=network)
    build = partial(train.make_example, config, tiny.ONE_LEVEL_LIMITS)
    wide = {"lights": "light", "materials": "material"}
    numbers = {
        wide[n]: np.ones((2, 1200, w), np.float32) for n, w in more.items() if n in wide
    }
    init = jax.jit(partial(init_variables, network, key=jax.random.key(4)))
    with tiny.cheap_compiling():
        made, _ = jax.jit(build)(
            tiny.batch()._replace(**numbers), key=jax.random.key(3)
        )
        assert made.geometry.levels[0].mask.sum() > 100
        assert tiny.identical(init(made), init(example.blank_example(network)))


@given(
    mask=st.lists(st.booleans(), min_size=1, max_size=300),
    sparsest=st.floats(0.05, 1.0),
    seed=st.integers(0, 2**32 - 1),
)
def test_network_is_given_a_share_of_the_points(mask, sparsest, seed):
    mask = np.array(mask)
    key = jax.random.key(seed)
    kept = np.array(example.given_share(jnp.array(mask), sparsest, key=key))
    assert not (kept & ~mask).any()
    assert (sparsest < 1) or (kept == mask).all()
    # Eight standard deviations and more of the sparsest share.
    least = sparsest * mask.sum() - 8 * np.sqrt(mask.sum())
    assert kept.sum() >= least


def test_shares_are_between_the_sparsest_and_all():
    mask = jnp.ones(4000, bool)
    keys = jax.random.split(jax.random.key(5), 200)
    counts = jax.vmap(lambda key: example.given_share(mask, 0.2, key=key).mean())(keys)
    # 200 draws of a uniform share: mean .6, deviation .016.
    assert 0.18 < counts.min() < 0.25
    assert 0.95 < counts.max() <= 1
    assert abs(counts.mean() - 0.6) < 0.08


@given(st.floats(1e-3, 1e5), st.floats(1e-3, 1e5))
def test_targets_are_in_units_of_their_own_clouds_light(one, two):
    batch = dataset.stack_clouds([short_run.cloud(0, one), short_run.cloud(1, two)])
    made = in_units_of_light(batch)
    for i in range(2):
        plain = tiny.sphere_on_plane(short_run.POINTS, i)
        np.testing.assert_allclose(made.target[i], plain.target, rtol=1e-4)
        np.testing.assert_allclose(made.light[i], 1, rtol=1e-4)


in_units_of_light = jax.jit(jax.vmap(example.in_unit_light))

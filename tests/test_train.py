"""One tiny scene is learned, by the one step that is compiled for all of this file."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import tiny
import two_devices
from hypothesis import given
from hypothesis import strategies as st

from ginn_jax import example, objective, train
from ginn_jax.geometry import Geometry
from ginn_jax.limits import exceeded
from ginn_jax.receptive_field import Oriented


def run(state, steps, data=None):
    """The state after some steps, and the report of each."""
    reports = []
    for _ in range(steps):
        state, report = tiny.step(state, tiny.batch() if data is None else data)
        reports.append(report)
    return state, reports


@pytest.fixture(scope="module")
def trained():
    """The state after all steps of the configuration, as NumPy, and the losses."""
    state, reports = run(tiny.fresh_state(), tiny.CONFIG.steps)
    assert all(r.fits for r in reports)
    return jax.tree.map(np.array, state), np.array([r.loss for r in reports])


def test_tiny_scene_is_overfitted(trained):
    state, losses = trained
    variance = tiny.batch().target.var()
    assert losses[0] > 0.5 * variance
    assert losses[-20:].mean() < 0.1 * variance
    assert state.step == tiny.CONFIG.steps
    assert state.skipped == 0


def test_training_goes_on_from_given_weights(trained):
    given = jax.tree.map(jnp.asarray, trained[0].variables)
    state = train.init_state(tiny.CONFIG, given)
    assert (state.step, state.skipped) == (0, 0)
    _, [report] = run(state, 1)
    assert report.loss < 0.2 * trained[1][0]
    assert tiny.identical(given, trained[0].variables)


def test_gradient_reaches_every_parameter():
    state, [report] = run(tiny.fresh_state(), 1)
    # Some are Muon's, the others Adam's.
    first_moments = [m for _, m in optax.tree.get_all_with_path(state.optimizer, "mu")]
    leaves = jax.tree_util.tree_leaves_with_path(first_moments)
    dead = [jax.tree_util.keystr(path) for path, leaf in leaves if not np.any(leaf)]
    params, _ = objective.split_variables(state.variables)
    assert len(leaves) == len(jax.tree.leaves(params)) > 40
    assert dead == []
    assert report.gradient_norm > 0


def test_step_compiles_once(trained):
    run(tiny.fresh_state(), 1)
    compiled = train.train_step._cache_size()
    run(tiny.fresh_state(), 2, tiny.batch(5))
    run(train.place(tiny.CONFIG, trained[0]), 2)
    assert train.train_step._cache_size() == compiled


def test_seed_and_step_decide_everything():
    one, first = run(tiny.fresh_state(), 3)
    two, second = run(tiny.fresh_state(), 3)
    assert tiny.identical((one, first), (two, second))


def test_other_step_draws_otherwise():
    later = tiny.fresh_state()._replace(step=jnp.int32(7))
    _, [now] = run(tiny.fresh_state(), 1)
    _, [then] = run(train.place(tiny.CONFIG, later), 1)
    assert now.loss != then.loss
    assert now.demands["level_0.edges"] != then.demands["level_0.edges"]


def test_donated_state_is_not_used_again(trained):
    state, data = train.place(tiny.CONFIG, trained[0]), tiny.batch()
    before = jax.tree.map(np.array, data)
    state, _ = run(state, 2, jax.device_put(data))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.variables))
    assert tiny.identical(data, before)


def test_overflow_leaves_the_state_alone(trained):
    state = jax.tree.map(np.array, train.place(tiny.CONFIG, trained[0]))
    crowded = tiny.batch()._replace(position=tiny.batch().position * np.float32(0.3))
    after, [report] = run(train.place(tiny.CONFIG, state), 1, crowded)
    assert not report.fits
    assert tiny.identical(after, state)
    short = exceeded(tiny.LIMITS, report.demands)
    assert short["level_0.edges"] > tiny.LIMITS.of("level_0.edges")
    # What follows is as though nothing had happened.
    again, _ = run(after, 1)
    unbroken, _ = run(train.place(tiny.CONFIG, state), 1)
    assert tiny.identical(again, unbroken)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_non_finite_gradient_is_skipped_and_counted(value):
    state = jax.tree.map(np.array, tiny.fresh_state())
    target = tiny.batch().target.copy()
    target[1] = value
    after, [report] = run(tiny.fresh_state(), 1, tiny.batch()._replace(target=target))
    assert report.fits
    assert not np.isfinite(report.loss)
    assert tiny.identical(after.variables, state.variables)
    assert tiny.identical(after.optimizer, state.optimizer)
    assert (int(after.step), int(after.skipped)) == (1, 1)


def check_loss_of_zero_network(config, limits, of_second):
    """A network that says 0 has the mean square of the targets for its loss.

    Each cloud has its own constant, 1 or 3, so a cloud that is not counted shows, as
    does one that counts twice; `of_second` of the queries are of the second.
    """
    state = tiny.fresh_state(config, limits)
    last = state.variables["shader"]["params"]["Dense_1"]
    assert last["kernel"].shape[1] == 1
    state.variables["shader"]["params"]["Dense_1"] = jax.tree.map(jnp.zeros_like, last)
    state = train.place(config, state)
    target = np.ones_like(tiny.batch().target) * np.array([[1], [3]], np.float32)
    _, report = tiny.step(state, tiny.batch()._replace(target=target), config, limits)
    assert report.fits
    share = of_second / (config.queries * config.batch_size)
    np.testing.assert_allclose(report.loss, 1 + (9 - 1) * share, rtol=1e-6)
    # That of the last bias alone is 2 * mean(0 - target) = -4.
    assert 4 < report.gradient_norm < 100


def test_loss_is_the_mean_square_error():
    target = np.ones_like(tiny.batch().target) * np.array([[0], [1]], np.float32)
    build = partial(train.make_example, tiny.CONFIG, tiny.LIMITS)
    with tiny.cheap_compiling():
        key = train.share_key(tiny.CONFIG, 0, 0)
        made, _ = jax.jit(build)(tiny.batch()._replace(target=target), key=key)
    assert made.queries.mask.all()
    of_second = int(made.target.sum())
    assert abs(of_second - 128) < 8
    check_loss_of_zero_network(tiny.CONFIG, tiny.LIMITS, of_second)


TWO_DEVICES = """
import numpy as np
from dataclasses import replace
from ginn_jax import train
assert train.batch_mesh(2).size == train.batch_mesh(4).size == 2
assert train.batch_mesh(3).size == 1
import test_train, tiny
config = replace(tiny.CONFIG, network=tiny.ONE_LEVEL)
limits = tiny.ONE_LEVEL_LIMITS
test_train.check_loss_of_zero_network(config, limits, config.queries)
state, data = tiny.fresh_state(config, limits), tiny.batch()
for _ in range(2):
    state, report = tiny.step(state, data, config, limits)
shares = [[s.data for s in a.addressable_shards] for a in jax.tree.leaves(state)]
assert all(len(s) == 2 and tiny.identical(*s) for s in shares)
assert report.fits and state.step == 2 and train.train_step._cache_size() == 1
nan = data._replace(target=data.target * np.float32([[1], [np.nan]]))
state, report = tiny.step(state, nan, config, limits)
assert state.skipped == 1 and state.step == 3
crowded = data.position * np.float32([[[1]], [[0.2]]])
state, report = tiny.step(state, data._replace(position=crowded), config, limits)
assert not report.fits and state.step == 3
"""


def test_batch_is_shared_between_devices():
    two_devices.check(TWO_DEVICES)


def rates(config, steps):
    """The size of each update under a constant gradient, that of a learning rate of 1.

    Adam's is then 1, and Muon's as near to .2 as Newton and Schulz come to orthogonal.
    """
    optimizer = train.make_optimizer(config)
    update = jax.jit(optimizer.update)
    gradient, found = jnp.eye(4, dtype=jnp.float32), []
    state = optimizer.init(gradient)
    with jax.numpy_dtype_promotion("standard"):
        for _ in range(steps):
            change, state = update(gradient, state, gradient)
            found.append(-float(change[0, 0]))
    return np.array(found)


def test_paper_schedule():
    config = replace(
        tiny.CONFIG, schedule="paper", learning_rate=0.005, epoch_steps=3, steps=600
    )
    expected = 0.005 * 0.7 ** (np.arange(95) // 30)
    np.testing.assert_allclose(rates(config, 95), expected, rtol=1e-4)


def test_cosine_schedule_warms_up_and_decays():
    config = replace(tiny.CONFIG, steps=80, warm_up=20, learning_rate=0.01)
    found = rates(config, 81)
    # Orthogonal, with the mean square of a 4 x 4 matrix of Adam's steps of .2.
    assert 0.7 < found.max() / (0.01 * 0.2 * np.sqrt(4)) < 1.3
    found /= found.max()
    np.testing.assert_allclose(found[:21], np.arange(21) / 20, atol=1e-5)
    t = np.arange(61) / 60
    np.testing.assert_allclose(found[20:], 0.5 * (1 + np.cos(np.pi * t)), atol=1e-5)


def test_warm_up_fits_into_a_short_run():
    found = rates(replace(tiny.CONFIG, steps=10, warm_up=100), 11)
    assert np.argmax(found) == 5
    assert found[10] < 1e-6


@pytest.mark.parametrize("schedule", ["cosine", "paper"])
def test_gradient_is_clipped(schedule):
    optimizer = train.make_optimizer(replace(tiny.CONFIG, schedule=schedule))
    gradient = {"a": jnp.float32(300), "b": jnp.float32(-400)}
    with jax.numpy_dtype_promotion("standard"):
        _, state = optimizer.update(gradient, optimizer.init(gradient), gradient)
    (clipped,) = [
        value
        for path, value in optax.tree.get_all_with_path(state, "mu")
        if "muon" not in str(path)
    ]
    np.testing.assert_allclose(clipped["a"], 0.1 * 0.6, rtol=1e-5)
    np.testing.assert_allclose(clipped["b"], 0.1 * -0.8, rtol=1e-5)


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

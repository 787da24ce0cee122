"""One tiny scene is learned, by the one step that is compiled for all of this file."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import tiny
import two_devices

from ginn_jax import objective, train
from ginn_jax.limits import exceeded


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

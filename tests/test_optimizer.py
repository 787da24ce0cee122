"""Muon and Adam as training uses them: rates over the steps, clipped gradients."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import tiny

from ginn_jax import recipe
from ginn_jax.kernels import init_kernel


def rates(config, steps):
    """The size of each update under a constant gradient, that of a learning rate of 1.

    Adam's is then 1, and Muon's as near to .2 as Newton and Schulz come to orthogonal.
    """
    optimizer = recipe.make_optimizer(config)
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


def test_biases_of_kernel_blocks_are_no_matrix():
    """Twice the gradient is the same step of Adam, whatever the other blocks' are."""
    optimizer = recipe.make_optimizer(replace(tiny.CONFIG, clip_norm=1e9))
    kernel = init_kernel(3, 8, 4, 4, key=jax.random.key(0))
    rng = np.random.default_rng(0)
    gradient = jax.tree.map(lambda w: jnp.float32(rng.normal(size=w.shape)), kernel)
    other = gradient._replace(b2=gradient.b2.at[0].multiply(0.0))

    def second(gradient):
        state = optimizer.init(kernel)
        with jax.numpy_dtype_promotion("standard"):
            for _ in range(2):  # the warm-up begins at a rate of 0
                change, state = optimizer.update(gradient, state, kernel)
        return change

    one, two = second(gradient), second(other)
    assert np.abs(one.b2[1]).min() > 0
    np.testing.assert_allclose(one.b2[1], two.b2[1], rtol=1e-5)
    block = np.asarray(one.w2[0], np.float64)
    spread = np.linalg.svd(block, compute_uv=False)
    assert spread.max() < 3 * spread.min()


@pytest.mark.parametrize("schedule", ["cosine", "paper"])
def test_gradient_is_clipped(schedule):
    optimizer = recipe.make_optimizer(replace(tiny.CONFIG, schedule=schedule))
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

"""Muon and Adam as training uses them: rates over the steps, clipped gradients."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import tiny

from ginn_jax import train


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

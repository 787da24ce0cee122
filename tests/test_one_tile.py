"""What a GPU computes in one tile without loops is what a CPU does tile by tile."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st
from jax.extend.core import jaxprs_in_params

from ginn_jax import objective, train
from ginn_jax import ranges as rg

pytestmark = pytest.mark.usefixtures("cheap_compiling")


@pytest.fixture
def on_gpu(monkeypatch):
    """What is traced is for a GPU; it runs on the CPU all the same."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


def gradient(config, limits, variables, batch, key):
    """Loss and gradient of a batch, from its Poisson disks on, and all demands."""
    example, demands = train.make_example(config, limits, batch, key=key)
    differentiate = jax.value_and_grad(objective.batch_loss, has_aux=True)
    split = objective.split_variables(variables)
    (loss, _), found = differentiate(*split, config.network, example)
    return loss, found, demands


def prepare(config, limits):
    """The function to trace, another one each time, and what it is given: JAX knows
    nothing of a backend that is another one, and would take what it traced before."""
    state = tiny.fresh_state(config, limits)
    inputs = state.variables, tiny.batch(), jax.random.key(2)
    return partial(gradient, config, limits), inputs


ONE_LEVEL = replace(tiny.CONFIG, network=tiny.ONE_LEVEL), tiny.ONE_LEVEL_LIMITS


@pytest.fixture(scope="module")
def in_tiles():
    traced, inputs = prepare(*ONE_LEVEL)
    return jax.jit(traced)(*inputs)


def test_gradients_and_demands_are_those_of_tiles(in_tiles, on_gpu):
    traced, inputs = prepare(*ONE_LEVEL)
    loss, found, demands = jax.jit(traced)(*inputs)
    assert jax.tree.map(int, demands) == jax.tree.map(int, in_tiles[2])
    np.testing.assert_allclose(loss, in_tiles[0], rtol=1e-6)
    largest = max(float(jnp.abs(a).max()) for a in jax.tree.leaves(in_tiles[1]))
    for a, b in zip(*map(jax.tree.leaves, (found, in_tiles[1])), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5 * largest)


def loops(jaxpr):
    """Loops of unknown length, in whatever is called too."""
    return sum(
        (equation.primitive.name == "while")
        + sum(map(loops, jaxprs_in_params(equation.params)))
        for equation in jaxpr.eqns
    )


def test_only_poisson_disks_wait_for_the_host(on_gpu):
    """A loop of unknown length takes a round trip a turn, which is longer than most of
    what is in it; of a disk nobody knows how many rounds it takes."""
    traced, inputs = prepare(tiny.CONFIG, tiny.LIMITS)
    jaxpr = jax.make_jaxpr(traced)(*inputs).jaxpr
    assert loops(jaxpr) == len(tiny.NETWORK.levels)


@given(st.lists(st.integers(0, 6), min_size=13, max_size=13), st.integers(0, 13))
def test_ranges_of_one_tile_are_listed_in_order(lengths, listed):
    owners = [i for i, n in enumerate(lengths) for _ in range(n)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax, "default_backend", lambda: "gpu")
        slots = rg.range_slots(jnp.array(lengths, jnp.int32), 128)
        some = rg.range_slots(jnp.array(lengths, jnp.int32), 128, jnp.int32(listed))
    assert slots.owner[: len(owners)].tolist() == owners
    assert int(slots.total) == len(owners)
    assert int(some.total) == sum(lengths[:listed])

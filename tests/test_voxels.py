"""What grids are made of: Morton codes and stable orders."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ginn_jax import voxels as vx

order_of = jax.jit(vx.morton_order)


@given(hnp.arrays(np.float32, (40, 3), elements=st.floats(-5, 5, width=32)))
def test_morton_order_is_a_permutation_with_padding_last(position):
    mask = np.arange(40) % 5 != 0
    order = np.asarray(order_of(position, mask))
    assert sorted(order.tolist()) == list(range(40))
    assert mask[order][: mask.sum()].all()


def test_morton_order_brings_neighbours_together():
    position = np.random.default_rng(0).random((4096, 3)).astype(np.float32)
    order = np.asarray(order_of(position, np.ones(4096, bool)))
    boxes = np.ptp(position[order].reshape(-1, 32, 3), axis=1).max(axis=1)
    assert np.median(boxes) < 0.4
    assert np.median(np.ptp(position.reshape(-1, 32, 3), axis=1).max(axis=1)) > 0.8


@given(hnp.arrays(np.uint32, 50, elements=st.integers(0, 7)))
def test_orders_are_stable(keys):
    expected = np.argsort(keys, kind="stable")
    for bits in (3, 31):
        found = jax.jit(vx.stable_order, static_argnums=1)(jnp.asarray(keys), bits)
        np.testing.assert_array_equal(found, expected)

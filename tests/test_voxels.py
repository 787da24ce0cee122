"""What grids are made of: ranges, compaction, Morton codes and stable orders."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ginn_jax import voxels as vx

INT32_MAX = 2**31 - 1


@pytest.mark.parametrize("total", [INT32_MAX - 5000, 2**31, 2**31 + 5, 2**32 + 7])
def test_demand_saturates_where_int32_would_wrap(total):
    length = np.full(9, total // 9, np.int64)
    length[0] += total - length.sum()
    length = jnp.asarray(length.astype(np.int32))
    demand = vx.expand_ranges(jnp.zeros(9, jnp.int32), length, 64)[1]
    assert int(demand) == min(total, INT32_MAX)


expand = jax.jit(vx.expand_ranges, static_argnames="capacity")
squeeze = jax.jit(vx.compact, static_argnames="capacity")


@given(st.lists(st.integers(0, 6), min_size=8, max_size=8))
def test_ranges_are_listed_in_order(lengths):
    starts = 100 * np.arange(len(lengths), dtype=np.int32)
    rows = [
        (i, s + k)
        for i, (s, n) in enumerate(zip(starts, lengths, strict=True))
        for k in range(n)
    ]
    slots, total = jax.tree.map(
        np.asarray, expand(starts, np.array(lengths, np.int32), 16)
    )
    wanted = rows[:16]
    listed = np.stack([slots.owner, slots.row], axis=1)[slots.valid]
    assert total == len(rows)
    assert listed.tolist() == [list(row) for row in wanted]


@given(hnp.arrays(bool, 20), st.sampled_from([1, 7, 24]))
def test_compaction_keeps_order_and_counts_all(keep, capacity):
    index, real, demand = map(np.asarray, squeeze(keep, capacity))
    assert demand == keep.sum()
    assert index[real].tolist() == np.flatnonzero(keep)[:capacity].tolist()


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

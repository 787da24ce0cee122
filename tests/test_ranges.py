"""Lists of variable length: what is listed, and that tiles and padding do not show."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ginn_jax import ranges as rg

INT32_MAX = 2**31 - 1
TILE = 5
LENGTHS = st.lists(st.integers(0, 6), min_size=13, max_size=13)


@pytest.fixture(autouse=True, scope="module")
def _small_tiles():
    """Several tiles to the short lists of tests, the last one not full."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rg, "tile_rows", lambda capacity, most=TILE: min(capacity, TILE))
        yield


@pytest.mark.parametrize("total", [INT32_MAX - 5000, 2**31, 2**31 + 5, 2**32 + 7])
def test_demand_saturates_where_int32_would_wrap(total):
    length = np.full(9, total // 9, np.int64)
    length[0] += total - length.sum()
    length = jnp.asarray(length.astype(np.int32))
    assert int(rg.range_slots(length, 64).total) == min(total, INT32_MAX)


@given(st.integers(0, INT32_MAX), st.integers(0, INT32_MAX))
def test_as_many_tiles_as_hold_the_rows(rows, size):
    """Of any number that int32 has, and rounded up without leaving it."""
    assert int(rg.tiles_holding(jnp.int32(rows), size)) == -(-rows // max(size, 1))


@pytest.fixture(scope="module")
def list_ranges():
    return jax.jit(rg.range_slots, static_argnames="capacity")


@pytest.mark.parametrize("capacity", [3, 5, 16, 128])
@given(lengths=LENGTHS)
def test_ranges_are_listed_in_order(list_ranges, capacity, lengths):
    owners = [i for i, n in enumerate(lengths) for _ in range(n)]
    slots = list_ranges(np.array(lengths, np.int32), capacity)
    assert slots.total == len(owners)
    assert slots.owner[: len(owners)].tolist() == owners[:capacity]
    np.testing.assert_array_equal(slots.begin, np.cumsum([0, *lengths[:-1]]))


@pytest.fixture(scope="module")
def open_slots():
    return jax.jit(partial(rg.range_slots, capacity=64))


@given(lengths=LENGTHS, real=st.integers(0, 15))
def test_ranges_that_are_not_real_have_no_slots(open_slots, lengths, real):
    slots = open_slots(np.array(lengths, np.int32), ranges=np.int32(real))
    owners = [i for i, n in enumerate(lengths[:real]) for _ in range(n)]
    begin = np.cumsum([0, *lengths[:real], *[0] * len(lengths[real:])])[: len(lengths)]
    assert slots.total == len(owners)
    assert np.asarray(slots.owner)[: len(owners)].tolist() == owners[:64]
    np.testing.assert_array_equal(slots.begin, begin)


@pytest.fixture(scope="module")
def squares():
    make = lambda row: (row + 1, (row[:, None] + 1) ** jnp.arange(3))  # noqa: E731
    return jax.jit(lambda count: rg.fill(make, count, 12))


@given(st.integers(0, 20))
def test_rows_are_filled_up_to_the_count_and_zero_beyond_its_tile(squares, count):
    ones, powers = map(np.asarray, squares(np.int32(count)))
    number = np.arange(12) + 1
    np.testing.assert_array_equal(ones[:count], number[:count])
    np.testing.assert_array_equal(
        powers[:count], (number[:, None] ** np.arange(3))[:count]
    )
    beyond = -(-count // TILE) * TILE
    assert not ones[beyond:].any()
    assert not powers[beyond:].any()


@pytest.fixture(scope="module")
def squeeze():
    return jax.jit(rg.compact, static_argnames="capacity")


@pytest.mark.parametrize("capacity", [1, 7, 24])
@given(keep=hnp.arrays(bool, 20))
def test_compaction_keeps_order_and_counts_all(squeeze, keep, capacity):
    index, real, demand = map(np.asarray, squeeze(keep, capacity))
    assert demand == keep.sum()
    assert index[real].tolist() == np.flatnonzero(keep)[:capacity].tolist()

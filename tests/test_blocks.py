"""Queries in turns of a block for every device."""

from functools import partial

import jax
import numpy as np
import pytest
import two_devices
from hypothesis import given
from hypothesis import strategies as st

from ginn_jax import blocks

TWO_DEVICES = """
import numpy as np
from dataclasses import replace
import test_relight as cases
import tiny
from ginn_jax import block_shading, blocks, inference, shading, train
from ginn_jax.lit_clouds import network_numbers
from ginn_jax.relight import prepare_relighting, relight

blocks.BLOCK = 256
network = cases.EFFECTS["beams"]
limits = cases.limits_of(network)
config = replace(tiny.CONFIG, network=network)
variables = jax.device_get(train.init_state(config).variables)
cloud, queries = cases.lit(1000, 1, (8.0, 1.3)), cases.lit(700, 2, (8.0, 1.3))

# Three turns, the last with a block that is half empty.
ends = variables, cloud.position, cloud.normal, *network_numbers(cloud)
inference.encodes_in_lanes = lambda network: False
encoded, _ = inference.encode_cloud(network, limits, *ends, key=cases.KEY)
asked = queries.position, queries.normal, *network_numbers(queries)
found = block_shading.shade_blocks(network, limits, variables, encoded, *asked)[0]
assert block_shading.shade_turn._cache_size() == 1
codes = jax.tree.leaves(encoded._replace(center=None, kept=None))
assert all(len(a.devices()) == 2 for a in codes)
# The next frame's f_3D runs where this lies: on one.
assert len(encoded.kept.devices()) == 1
one = blocks.pad_points(encoded.center, queries.position, queries.normal, 700)
numbers = map(np.asarray, network_numbers(queries))
shade = jax.jit(shading.shade, static_argnums=(0, 1))
whole, _ = shade(network, limits, variables, encoded, one, *numbers)
assert np.abs(whole).max() > 1e-3
cases.close(found, np.asarray(whole).T)

given = network, limits, variables, cloud, queries
ready, _ = prepare_relighting(*given, key=cases.KEY)
assert len(ready.turns) == 3
assert all(len(a.devices()) == 2 for a in jax.tree.leaves(ready.turns))
relit = relight(network, variables, ready, cloud, queries)
cases.close(relit, np.maximum(whole.T, 0))
"""


def test_devices_share_queries():
    two_devices.check(TWO_DEVICES)


@given(count=st.integers(1, 40), size=st.integers(1, 9), channels=st.integers(1, 3))
def test_what_is_split_into_turns_comes_back_in_rows(count, size, channels):
    rng = np.random.default_rng(count)
    position = rng.normal(size=(count, 3)).astype(np.float32)
    numbers = rng.normal(size=(channels, count, 2)).astype(np.float32)
    turns = blocks.in_turns(None, position, position, size)
    split = blocks.channels_in_turns(numbers, size, len(turns))
    assert all(turn.mask.shape == (jax.device_count(), size) for turn in turns)
    mask = blocks.in_rows([np.float32(turn.mask) for turn in turns])
    assert mask[:count].all()
    assert not mask[count:].any()
    for axis in range(3):
        rows = blocks.in_rows([turn.position[..., axis] for turn in turns])
        np.testing.assert_array_equal(rows[:count], position[:, axis])
    rows = blocks.in_rows([turn[..., 1] for turn in split])
    np.testing.assert_array_equal(rows[:count], numbers[..., 1].T)
    assert not rows[count:].any()


def test_no_block_is_dropped():
    """Of two blocks for one device the second would be lost."""
    count = jax.device_count()
    add = partial(blocks.for_each_block, lambda shared, block: shared + block, 1.0)
    np.testing.assert_array_equal(add(np.zeros((count, 3))), np.ones((count, 3)))
    with pytest.raises(ValueError, match="squeeze"):
        add(np.zeros((2 * count, 3)))

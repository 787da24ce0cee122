"""The paper's density, over every pair of neighbours, against float64 by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conv_cases import BANDWIDTH, Case, cases, dense_case
from hypothesis import given
from strategies import ALL_PAIRS

from ginn_jax import receptive_field as rf
from ginn_jax.density import kde_weight
from ginn_jax.packets import Demand, Edges, radius_edges
from ginn_jax.voxels import build_grid

pytestmark = pytest.mark.usefixtures("cheap_compiling")


@pytest.fixture(autouse=True, scope="module")
def _small_tiles():
    """Several tiles of 16 edges, the last two overlapping."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rf, "TILE", 16)
        yield


@jax.jit
def weigh(senders, receivers, radius):
    grid = build_grid(senders.position, senders.mask, radius)
    ends = grid, receivers.position, receivers.mask, radius
    edges = radius_edges(*ends, ALL_PAIRS)
    count = receivers.mask.shape[0]
    return edges, kde_weight(senders.position, edges, count, radius, BANDWIDTH)


def by_hand(near, width):
    """One over the density at each of these points, by all of them."""
    squared = np.sum((near[:, None] - near) ** 2, axis=-1) / width**2
    constant = (2 * np.pi) ** -1.5 / BANDWIDTH**3
    return 1 / (constant * np.exp(-squared / 2).sum(1))


def check(case: Case):
    edges, weight = jax.device_get(weigh(case.senders, case.receivers, case.radius))
    points = np.asarray(case.senders.position, np.float64)
    for i in range(len(case.receivers.mask)):
        mine = edges.receiver == i
        near = points[edges.sender[mine]]
        expected = by_hand(near, case.radius * BANDWIDTH)
        np.testing.assert_allclose(weight[mine], expected, rtol=2e-5)
    assert not weight[edges.receiver == len(case.receivers.mask)].any()
    return int(edges.demand.edges)


@given(cases())
def test_weights_are_one_over_the_density(case):
    check(case)


def test_weights_of_many_tiles_are_one_over_the_density():
    assert check(dense_case()) > 5 * 16


def chosen_edges():
    """Of receivers with 0 to 9 senders, beyond a tile; the last rows are padding."""
    rng = np.random.default_rng(4)
    counts, receivers = (7, 0, 9, 1, 8), 5
    receiver = np.repeat(np.arange(receivers), counts)
    sender = np.concatenate([rng.permutation(9)[:n] for n in counts])
    real, padding = len(sender), 6
    sender = np.pad(sender, (0, padding)).astype(np.int32)
    receiver = np.pad(receiver, (0, padding), constant_values=receivers)
    demand = Demand(*map(jnp.int32, (0, 0, 0, real)))
    edges = Edges(jnp.asarray(sender), jnp.asarray(receiver, jnp.int32), demand)
    places = rng.normal(scale=0.2, size=(9, 3))
    return edges, real, receivers, places, rng.normal(size=real + padding)


def test_weights_have_the_gradient_of_their_formula():
    """In places and radius, against central differences in float64."""
    edges, real, receivers, places, wanted = chosen_edges()

    def total(places, radius):
        sums = 0.0
        for i in range(receivers):
            mine = np.flatnonzero(np.asarray(edges.receiver) == i)
            near = places[np.asarray(edges.sender)[mine]]
            sums += (wanted[mine] * by_hand(near, radius * BANDWIDTH)).sum()
        return sums

    def ours(places, radius):
        weight = kde_weight(places, edges, receivers, radius, BANDWIDTH)
        assert weight.shape[0] > real
        return jnp.sum(weight * wanted)

    given = jnp.asarray(places, jnp.float32), jnp.float32(0.5)
    np.testing.assert_allclose(ours(*given), total(places, 0.5), rtol=1e-5)
    moved, grown = jax.grad(ours, (0, 1))(*given)
    step = 1e-5
    for place in np.ndindex(places.shape):
        low, high = places.copy(), places.copy()
        low[place] -= step
        high[place] += step
        expected = (total(high, 0.5) - total(low, 0.5)) / (2 * step)
        np.testing.assert_allclose(moved[place], expected, rtol=1e-3, atol=1e-4)
    expected = (total(places, 0.5 + step) - total(places, 0.5 - step)) / (2 * step)
    np.testing.assert_allclose(grown, expected, rtol=1e-3)


def test_a_crowd_shares_the_weight_of_one():
    points = rf.Oriented(np.ones((30, 3), np.float32), None, np.ones(30, bool))
    _, weight = jax.device_get(weigh(points, points, np.float32(0.1)))
    alone = by_hand(np.zeros((1, 3)), 0.1 * BANDWIDTH)
    np.testing.assert_allclose(weight[:900], np.full(900, alone / 30), rtol=1e-6)
    assert not weight[900:].any()

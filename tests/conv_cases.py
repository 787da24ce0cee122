"""Clouds with features to convolve, their fields, and kernels of random weights."""

from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax
import numpy as np
import pytest
from hypothesis import assume
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from strategies import ALL_PAIRS, POINTS, QUERIES, SEEDS, UNIT, lattice, pad

from ginn_jax import kernels
from ginn_jax import mcconv as mc
from ginn_jax import receptive_field as rf
from ginn_jax.density import kde_weight
from ginn_jax.packets import radius_edges
from ginn_jax.voxels import build_grid

CHANNELS, OUTPUTS, HIDDEN, BANDWIDTH = 3, 2, 5, 0.3
# What weighs the senders, and whether kernels see normals.
VARIANTS = pytest.mark.parametrize("variant", [("kde", False), ("surface", True)])
MIXES = pytest.mark.parametrize("mixes", [False, True])


@partial(jax.jit, static_argnames="variant")
def field_of(senders, receivers, radius, variant):
    """The receptive field."""
    density, oriented = variant
    grid = build_grid(senders.position, senders.mask, radius)
    limit = ALL_PAIRS
    edges = radius_edges(grid, receivers.position, receivers.mask, radius, limit)
    inputs = rf.kernel_inputs(senders, receivers, edges, radius, oriented)
    count = receivers.mask.shape[0]
    if density == "kde":
        weight = kde_weight(senders.position, edges, count, radius, BANDWIDTH)
    else:
        own = radius_edges(grid, senders.position, senders.mask, radius, ALL_PAIRS)
        area = rf.point_area(senders.position, senders.mask, own, radius)
        weight = rf.surface_weight(area, edges, count, radius)
    real = edges.demand.edges
    return rf.Field(edges.sender, edges.receiver, inputs, weight, real)


@partial(jax.jit, static_argnames="mixes")
def apply(kernel, features, field, mixes):
    if mixes:
        return mc.mc_conv_mixing(kernel, features, field, QUERIES, OUTPUTS)
    return mc.mc_conv(kernel, features, field, QUERIES)


def make_kernel(seed, inputs, values, group):
    """Random weights and biases in blocks of `group` values."""
    rng = np.random.default_rng(seed)
    blocks = -(-values // group)
    sizes = [inputs, HIDDEN, HIDDEN, group]
    arrays = []
    for a, b in pairwise(sizes):
        arrays += [
            rng.normal(size=(blocks, a, b)) / a**0.5,
            rng.normal(size=(blocks, b)),
        ]
    return kernels.Kernel(*(a.astype(np.float32) for a in arrays))


class Case(NamedTuple):
    """Senders with features, receivers, a radius and the seed of a kernel."""

    senders: rf.Oriented
    features: np.ndarray
    receivers: rf.Oriented
    radius: float
    seed: int

    def near(self, i):
        """Rows of the senders within reach of receiver i."""
        points = np.asarray(self.senders.position, np.float64)
        distance = np.linalg.norm(points - self.receivers.position[i], axis=1)
        return np.flatnonzero(self.senders.mask & (distance < self.radius)).tolist()


def with_normals(cloud, rng):
    normal = rng.normal(size=cloud.position.shape)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return rf.Oriented(cloud.position, normal.astype(np.float32), cloud.mask)


def clear_of_radius(points, queries, radius):
    """No distance is within rounding of the radius."""
    distance = np.linalg.norm(points[:, None] - queries[None], axis=-1)
    return not (np.abs(distance / radius - 1) < 1e-5).any()


@st.composite
def cases(draw, rows=POINTS, queries=QUERIES):
    points, places = draw(lattice(rows)), draw(lattice(queries))
    radius = draw(st.sampled_from([0.3, 0.7, 1.9]))
    assume(clear_of_radius(points, points, radius))
    assume(clear_of_radius(points, places, radius))
    seed = draw(SEEDS)
    rng = np.random.default_rng(seed)
    features = draw(hnp.arrays(np.float32, (POINTS, CHANNELS), elements=UNIT))
    return Case(
        with_normals(pad(points, POINTS), rng),
        features,
        with_normals(pad(places, QUERIES), rng),
        radius,
        seed,
    )


def dense_case():
    """Random senders, some masked, some receivers with nothing in reach."""
    rng = np.random.default_rng(5)
    points = pad(rng.random((POINTS, 3)), POINTS, rng.random(POINTS) < 0.8)
    places = rng.random((QUERIES, 3))
    places[::4] += 100
    places = pad(places, QUERIES, rng.random(QUERIES) < 0.8)
    features = rng.normal(size=(POINTS, CHANNELS)).astype(np.float32)
    return Case(with_normals(points, rng), features, with_normals(places, rng), 0.6, 3)


def value(case, variant, mixes=False, group=CHANNELS):
    """The convolution, all geometry included."""
    radius = np.float32(case.radius)
    field = field_of(case.senders, case.receivers, radius, variant)
    values = CHANNELS * (OUTPUTS if mixes else 1)
    kernel = make_kernel(case.seed, field.inputs.shape[0], values, group)
    return np.asarray(apply(kernel, case.features, field, mixes))


def assert_close(actual, expected):
    assert np.isfinite(expected).all()
    scale = max(1, np.abs(expected).max(initial=0))
    np.testing.assert_allclose(actual, expected, rtol=0, atol=3e-5 * scale)

"""Monte Carlo convolution: its invariances, and a double loop."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from conv_cases import (
    BANDWIDTH,
    CHANNELS,
    MIXES,
    OUTPUTS,
    VARIANTS,
    assert_close,
    cases,
    dense_case,
    field_of,
    make_kernel,
    value,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from strategies import POINTS, QUERIES, UNIT

from ginn_jax import kernels
from ginn_jax import mcconv as mc
from ginn_jax import receptive_field as rf
from ginn_jax.errors import InputError
from ginn_jax.network import splat

pytestmark = pytest.mark.usefixtures("cheap_compiling")


def map_points(case, change):
    """The case with `change` applied to all positions."""
    moved = [
        points._replace(position=change(points.position).astype(np.float32))
        for points in (case.senders, case.receivers)
    ]
    return case._replace(senders=moved[0], receivers=moved[1])


def take(case, rows):
    """The case with these rows as its senders."""
    senders = rf.Oriented(*(a[rows] for a in case.senders))
    return case._replace(senders=senders, features=case.features[rows])


@VARIANTS
@given(cases(), st.permutations(range(POINTS)))
def test_order_of_senders_does_not_matter(variant, case, order):
    assert_close(value(take(case, order), variant), value(case, variant))


@VARIANTS
@given(cases(), hnp.arrays(np.int64, 3, elements=st.integers(-1024, 1024)))
def test_moving_everything_changes_nothing(variant, case, shift):
    moved = map_points(case, lambda p: p + shift / 256)
    assert_close(value(moved, variant), value(case, variant))


@VARIANTS
@given(cases(), st.sampled_from([0.5, 4.0, 3.7, 0.013]))
def test_scaling_points_and_radius_changes_nothing(variant, case, factor):
    scaled = map_points(case, lambda p: p * factor)
    scaled = scaled._replace(radius=factor * case.radius)
    assert_close(value(scaled, variant), value(case, variant))


@VARIANTS
@given(cases(rows=POINTS // 2))
def test_duplicating_every_sender_changes_nothing(variant, case):
    half = np.arange(POINTS) % (POINTS // 2)
    doubled = take(case, half)
    assert doubled.senders.mask.sum() == 2 * case.senders.mask.sum()
    assert_close(value(doubled, variant), value(case, variant))


@VARIANTS
@given(cases())
def test_more_padding_changes_nothing(variant, case):
    wider = [
        np.pad(a, [(0, POINTS)] + [(0, 0)] * (a.ndim - 1))
        for a in (*case.senders, case.features)
    ]
    padded = case._replace(senders=rf.Oriented(*wider[:3]), features=wider[3])
    assert_close(value(padded, variant), value(case, variant))


@given(cases(queries=2))
def test_senders_out_of_reach_change_nothing(case):
    near = {j for i in np.flatnonzero(case.receivers.mask) for j in case.near(i)}
    mask = case.senders.mask & np.isin(np.arange(POINTS), list(near))
    alone = case._replace(senders=case.senders._replace(mask=mask))
    assert_close(value(alone, ("kde", False)), value(case, ("kde", False)))


@MIXES
@given(cases(), hnp.arrays(np.float32, (POINTS, CHANNELS), elements=UNIT), UNIT)
def test_convolution_is_linear_in_features(mixes, case, other, factor):
    variant = ("kde", False)
    first = value(case, variant, mixes)
    second = value(case._replace(features=other), variant, mixes)
    both = case._replace(features=case.features + np.float32(factor) * other)
    assert_close(value(both, variant, mixes), first + factor * second)


def loop_value(case, variant, mixes, group):
    """The convolution in float64, one receiver after the other."""
    points, real = np.asarray(case.senders.position, np.float64), case.senders.mask
    normals = np.asarray(case.senders.normal, np.float64)
    kernel = make_kernel(
        case.seed, 7 if variant[1] else 3, CHANNELS * (OUTPUTS if mixes else 1), group
    )
    mix = oracles.mixing(OUTPUTS) if mixes else oracles.depth_wise
    density = (
        oracles.Surface(points, real, case.radius)
        if variant[0] == "surface"
        else oracles.Gaussian(points, case.radius, BANDWIDTH)
    )
    result = np.zeros((QUERIES, OUTPUTS if mixes else CHANNELS))
    for i in np.flatnonzero(case.receivers.mask):
        x, normal = case.receivers.position[i], case.receivers.normal[i]
        near = case.near(i)
        both = [(normal.astype(float), normals[j]) if variant[1] else () for j in near]
        inputs = [
            oracles.edge_inputs(x, points[j], case.radius, *n)
            for j, n in zip(near, both, strict=True)
        ]
        result[i] = oracles.convolve(density, kernel, case.features, inputs, near, mix)
    return result


@pytest.mark.usefixtures("full_compiling")
@VARIANTS
@pytest.mark.parametrize(("mixes", "group"), [(False, 2), (True, 4), (True, 6)])
@settings(max_examples=8)
@given(case=cases(queries=3))
def test_convolution_equals_the_formula(variant, mixes, group, case):
    """Kernels in blocks, the last of which is cut off, and in one shared block."""
    expected = loop_value(case, variant, mixes, group)
    assert_close(value(case, variant, mixes, group), expected)


@pytest.mark.parametrize(("outputs", "group", "blocks"), [(7, 3, 3), (6, 6, 1)])
def test_new_kernels_are_scaled_to_their_inputs(outputs, group, blocks):
    kernel = kernels.init_kernel(200, outputs, 100, group, key=jax.random.key(0))
    shapes = [a.shape[1:] for a in kernel]
    assert {len(a) for a in kernel} == {blocks}
    assert shapes == [(200, 100), (100,), (100, 100), (100,), (100, group), (group,)]
    for weight, inputs in ((kernel.w1, 200), (kernel.w2, 100), (kernel.w3, 100)):
        assert np.std(weight) == pytest.approx((2 / inputs) ** 0.5, rel=0.1)
    for bias in (kernel.b1, kernel.b2, kernel.b3):
        assert not np.asarray(bias).any()
    assert (
        abs(np.corrcoef(kernel.w2[0].ravel(), kernel.w1[0, :100].ravel())[0, 1]) < 0.1
    )


def test_tiles_change_nothing(monkeypatch):
    """Several tiles, the last one overlapping the one before, and padding after it."""
    rng = np.random.default_rng(2)
    edges, count, rows = 100, 83, 9
    field = rf.Field(
        rng.integers(0, rows, edges).astype(np.int32),
        np.where(np.arange(edges) < count, rng.integers(0, rows, edges), rows).astype(
            np.int32
        ),
        rng.normal(size=(3, edges)).astype(np.float32),
        rng.random(edges).astype(np.float32),
        np.int32(count),
    )
    field = jax.tree.map(jnp.asarray, field)
    kernel = make_kernel(0, 3, CHANNELS, CHANNELS)
    features = rng.normal(size=(rows, CHANNELS)).astype(np.float32)

    def results():
        def total(kernel, features, inputs, weight):
            varied = field._replace(inputs=inputs, weight=weight)
            return jnp.sum(jnp.sin(mc.mc_conv(kernel, features, varied, rows)))

        arguments = kernel, features, field.inputs, field.weight
        return jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2, 3)))(*arguments)

    whole = results()
    monkeypatch.setattr(rf, "TILE", 32)
    parts = results()
    jax.tree.map(
        partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), parts, whole
    )
    assert not np.asarray(parts[1][3])[count:].any()


def test_a_splat_is_the_mean_of_what_is_near_and_faces_alike():
    """Weighed by area, distance and likeness; nothing where nothing is in reach."""
    case = dense_case()
    normals, places = (
        np.float64(a) for a in (case.senders.normal, case.senders.position)
    )
    radius, variant = np.float32(case.radius), ("surface", True)
    field = field_of(case.senders, case.receivers, radius, variant)
    values = np.random.default_rng(0).normal(size=POINTS).astype(np.float32)
    found = jax.jit(splat, static_argnums=2)(jnp.asarray(values), field, QUERIES)
    area = oracles.Surface(places, case.senders.mask, case.radius).share
    alone = 0
    for i in range(QUERIES):
        x, normal = case.receivers.position[i], case.receivers.normal[i]
        near = case.near(i) if case.receivers.mask[i] else []
        weights = []
        for j in near:
            inside = 1 - (oracles.distance(x, places[j]) / case.radius) ** 2
            alike = max(normals[j] @ normal, 0) ** 4 + 1e-3
            weights.append(area[j] * inside**2 * alike)
        expected = np.average(values[near], weights=weights) if len(near) else 0
        assert found[i] == pytest.approx(expected, abs=1e-4)
        alone += not len(near)
    assert 0 < alone < QUERIES


@pytest.mark.parametrize(
    ("inputs", "outputs", "message"),
    [(4, 6, "takes 4 inputs, edges have 3"), (3, 9, "3 blocks of 4 values for 6")],
)
def test_a_kernel_made_for_something_else_is_refused(inputs, outputs, message):
    zeros = jnp.zeros(8, jnp.int32)
    field = rf.Field(zeros, zeros, jnp.zeros((3, 8)), jnp.ones(8), jnp.int32(8))
    kernel = kernels.init_kernel(inputs, outputs, 4, 4, key=jax.random.key(0))
    with pytest.raises(InputError, match=message):
        mc.mc_conv(kernel, jnp.zeros((5, 6)), field, 5)
    with pytest.raises(InputError, match=message):
        mc.mc_conv_mixing(kernel, jnp.zeros((5, 2)), field, 5, 3)

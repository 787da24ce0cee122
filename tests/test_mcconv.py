"""Monte Carlo convolution: its invariances, a double loop, finite differences."""

from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from strategies import ALL_PAIRS, POINTS, QUERIES, SEEDS, UNIT, lattice, pad

from ginn_jax import mcconv as mc
from ginn_jax import receptive_field as rf
from ginn_jax.hierarchy import same_side
from ginn_jax.packets import EdgeLimit, radius_edges
from ginn_jax.voxels import build_grid

CHANNELS, OUTPUTS, HIDDEN, BANDWIDTH = 3, 2, 5, 0.3
PAIRS = POINTS * POINTS * QUERIES
# What weighs the senders, and whether kernels see normals.
VARIANTS = pytest.mark.parametrize("variant", [("kde", False), ("surface", True)])
MIXES = pytest.mark.parametrize("mixes", [False, True])


@partial(jax.jit, static_argnames=("variant", "pairs"))
def field_of(senders, receivers, radius, variant, pairs=PAIRS):
    """The receptive field, and how many pairs its densities looked at."""
    density, oriented = variant
    grid = build_grid(senders.position, senders.mask, radius)
    limit = ALL_PAIRS
    edges = radius_edges(grid, receivers.position, receivers.mask, radius, limit)
    inputs = rf.kernel_inputs(senders, receivers, edges, radius, oriented)
    positions = senders.position, receivers.position
    if density == "kde":
        weight, demand = rf.kde_weight(*positions, edges, radius, BANDWIDTH, pairs)
    else:
        own = radius_edges(grid, senders.position, senders.mask, radius, ALL_PAIRS)
        area = rf.point_area(senders.position, senders.mask, own, radius)
        count = receivers.mask.shape[0]
        weight, demand = rf.surface_weight(area, edges, count, radius), 0
    count = edges.demand.edges
    return rf.Field(edges.sender, edges.receiver, inputs, weight, count), demand


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
    return mc.Kernel(*(a.astype(np.float32) for a in arrays))


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


def value(case, variant, mixes=False, group=CHANNELS):
    """The convolution, all geometry included."""
    radius = np.float32(case.radius)
    field, demand = field_of(case.senders, case.receivers, radius, variant)
    assert demand <= PAIRS
    values = CHANNELS * (OUTPUTS if mixes else 1)
    kernel = make_kernel(case.seed, field.inputs.shape[0], values, group)
    return np.asarray(apply(kernel, case.features, field, mixes))


def assert_close(actual, expected):
    assert np.isfinite(expected).all()
    scale = max(1, np.abs(expected).max(initial=0))
    np.testing.assert_allclose(actual, expected, rtol=0, atol=3e-5 * scale)


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


@VARIANTS
@pytest.mark.parametrize(("mixes", "group"), [(False, 2), (True, 4), (True, 6)])
@settings(max_examples=8)
@given(case=cases(queries=3))
def test_convolution_equals_the_formula(variant, mixes, group, case):
    """Kernels in blocks, the last of which is cut off, and in one shared block."""
    expected = loop_value(case, variant, mixes, group)
    assert_close(value(case, variant, mixes, group), expected)


@pytest.fixture
def dense_case():
    """Random senders, some masked, some receivers with nothing in reach."""
    rng = np.random.default_rng(5)
    points = pad(rng.random((POINTS, 3)), POINTS, rng.random(POINTS) < 0.8)
    places = rng.random((QUERIES, 3))
    places[::4] += 100
    places = pad(places, QUERIES, rng.random(QUERIES) < 0.8)
    features = rng.normal(size=(POINTS, CHANNELS)).astype(np.float32)
    return Case(with_normals(points, rng), features, with_normals(places, rng), 0.6, 3)


def loss(parameters, field, cotangent, mixes):
    kernel, features = parameters
    return jnp.vdot(cotangent, apply(kernel, features, field, mixes))


gradient = jax.jit(jax.grad(loss), static_argnames="mixes")


def problem(case, variant, mixes):
    """Kernel and features, their field, a direction to differentiate in."""
    field, _ = field_of(case.senders, case.receivers, np.float32(case.radius), variant)
    count = CHANNELS * (OUTPUTS if mixes else 1)
    kernel = make_kernel(case.seed, field.inputs.shape[0], count, 2)
    width = OUTPUTS if mixes else CHANNELS
    cotangent = np.random.default_rng(6).normal(size=(QUERIES, width))
    return (kernel, case.features), field, cotangent


def double(tree):
    return jax.tree.map(
        lambda a: np.asarray(a, np.float64 if a.dtype == np.float32 else a.dtype), tree
    )


@VARIANTS
@MIXES
def test_gradients_equal_finite_differences(dense_case, variant, mixes):
    parameters, field, cotangent = double(problem(dense_case, variant, mixes))
    rng, step = np.random.default_rng(7), 1e-6
    with jax.enable_x64(True):
        slopes = gradient(parameters, field, cotangent, mixes)
        leaves, tree = jax.tree.flatten(parameters)
        for i, leaf in enumerate(leaves):
            direction = rng.normal(size=leaf.shape)
            ends = [
                loss(
                    tree.unflatten([*leaves[:i], moved, *leaves[i + 1 :]]),
                    field,
                    cotangent,
                    mixes,
                )
                for moved in (leaf + step * direction, leaf - step * direction)
            ]
            expected = float(ends[0] - ends[1]) / (2 * step)
            slope = np.vdot(jax.tree.leaves(slopes)[i], direction)
            assert abs(expected) > 1e-3
            assert slope == pytest.approx(expected, rel=1e-5)


@VARIANTS
@MIXES
def test_empty_neighbourhoods_are_zero_with_their_gradients(dense_case, variant, mixes):
    far = dense_case.receivers.position + np.float32(50)
    case = dense_case._replace(receivers=dense_case.receivers._replace(position=far))
    nobody = np.zeros(POINTS, bool)
    masked = dense_case._replace(senders=dense_case.senders._replace(mask=nobody))
    for empty in (case, masked):
        parameters, field, cotangent = problem(empty, variant, mixes)
        assert (np.asarray(field.receiver) == QUERIES).all()
        assert not np.asarray(apply(*parameters, field, mixes)).any()
        slopes = gradient(parameters, field, cotangent.astype(np.float32), mixes)
        for slope in jax.tree.leaves(slopes):
            np.testing.assert_array_equal(slope, 0)


@VARIANTS
@MIXES
@pytest.mark.parametrize("first", [False, True])
def test_padding_contributes_nothing_to_values_and_gradients(
    dense_case, variant, mixes, first
):
    """Results are bit-equal whatever masked rows hold, with and without row 0 in use.

    Row 0 is what padded edges name as their sender.
    """
    results = []
    for garbage in (0.0, 0.5, -1e6):
        mask = np.array(dense_case.senders.mask)
        mask[0] = first
        rows = np.where(mask[:, None], 1, 0)
        position, normal, features = (
            np.where(rows, a, garbage).astype(np.float32)
            for a in (*dense_case.senders[:2], dense_case.features)
        )
        case = dense_case._replace(
            senders=rf.Oriented(position, normal, mask), features=features
        )
        parameters, field, cotangent = problem(case, variant, mixes)
        padded = np.asarray(field.receiver) == QUERIES
        assert padded.any()
        assert not np.asarray(field.weight)[padded].any()
        assert not np.asarray(field.inputs)[:, padded].any()
        slopes = gradient(parameters, field, cotangent.astype(np.float32), mixes)
        assert not np.asarray(slopes[1])[~mask].any()
        results.append((apply(*parameters, field, mixes), slopes))
        assert not np.asarray(results[-1][0])[~case.receivers.mask].any()
    for result in results[1:]:
        jax.tree.map(np.testing.assert_array_equal, result, results[0])


@given(cases(), SEEDS)
def test_rotation_turns_offsets_and_keeps_products(case, seed):
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    turned = [
        rf.Oriented(
            (points.position @ turn.T).astype(np.float32),
            (points.normal @ turn.T).astype(np.float32),
            points.mask,
        )
        for points in (case.senders, case.receivers)
    ]
    inputs = []
    for senders, receivers in ((case.senders, case.receivers), turned):
        field, _ = field_of(
            senders, receivers, np.float32(case.radius), ("surface", True)
        )
        order = np.lexsort((field.sender, field.receiver))
        inputs.append(np.asarray(field.inputs).T[order])
    before, after = inputs
    np.testing.assert_allclose(after[:, :3], before[:, :3] @ turn.T, atol=1e-5)
    np.testing.assert_allclose(after[:, 3:], before[:, 3:], atol=1e-5)


def test_density_tells_how_many_pairs_it_needs(dense_case):
    radius, variant = np.float32(dense_case.radius), ("kde", False)
    near = [dense_case.near(i) for i in np.flatnonzero(dense_case.receivers.mask)]
    need = sum(len(n) ** 2 for n in near)
    args = dense_case.senders, dense_case.receivers, radius, variant
    full, demand = field_of(*args)
    assert demand == need
    exact, demand = field_of(*args, pairs=need)
    assert demand == need
    np.testing.assert_array_equal(exact.weight, full.weight)
    assert field_of(*args, pairs=need - 1)[1] == need


@jax.jit
def area_of(position, radius, normal=None):
    mask = jnp.ones(position.shape[0], bool)
    grid = build_grid(position, mask, radius)
    limit = EdgeLimit(1 << 14, 1 << 18, 1 << 12, 1 << 17)
    edges = radius_edges(grid, position, mask, radius, limit)
    counted = None if normal is None else same_side(normal, edges)
    area = rf.point_area(position, mask, edges, radius, counted)
    return area, edges.demand


def flat_square(side):
    """Places in the unit square, evenly spread, and the points at height .3."""
    rng = np.random.default_rng(8)
    place = (np.indices((side, side)).reshape(2, -1).T + 0.5) / side
    place += rng.uniform(-0.2, 0.2, place.shape) / side
    return place, np.insert(place, 1, 0.3, axis=1).astype(np.float32)


def test_area_of_either_side_of_a_sheet():
    """What faces away does not count: each side has the area of the sheet alone."""
    _, above = flat_square(20)
    below = np.float32([[0.003, 0.296, 0.002]]) + above * [1, 0, 1]
    position = np.concatenate([above, below]).astype(np.float32)
    normal = np.repeat(np.float32([[0, 1, 0], [0, -1, 0]]), len(above), axis=0)
    radius = np.float32(0.2)
    both, demand = area_of(position, radius, normal)
    assert demand.edges <= 1 << 17
    alone, _ = area_of(np.concatenate([above, above + np.float32(9)]), radius)
    np.testing.assert_allclose(both[: len(above)], alone[: len(above)], rtol=1e-5)
    np.testing.assert_allclose(both[len(above) :], alone[: len(above)], rtol=1e-3)


def test_area_of_a_flat_square():
    """Inside it every point stands for 1 / density, and together for the area."""
    side, radius = 40, 0.12
    place, position = flat_square(side)
    area, demand = area_of(position, np.float32(radius))
    assert demand.candidates <= 1 << 18
    assert demand.edges <= 1 << 17
    inside = (np.abs(place - 0.5) < 0.5 - radius).all(axis=1)
    np.testing.assert_allclose(np.asarray(area)[inside], 1 / side**2, rtol=0.1)
    middle = (np.abs(place - 0.5) < 0.25).all(axis=1)
    assert np.asarray(area)[middle].sum() == pytest.approx(0.25, rel=0.02)


@pytest.mark.parametrize(("outputs", "group", "blocks"), [(7, 3, 3), (6, 6, 1)])
def test_new_kernels_are_scaled_to_their_inputs(outputs, group, blocks):
    kernel = mc.init_kernel(200, outputs, 100, group, key=jax.random.key(0))
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


def test_kernel_inputs_have_the_gradient_of_their_formula(monkeypatch):
    """Tiles and all, against central differences in float64; padding has none."""
    monkeypatch.setattr(rf, "TILE", 4)
    rng = np.random.default_rng(3)
    ends = [rng.normal(size=(n, 6)).astype(np.float32) for n in (5, 6)]
    receiver, sender = rng.integers(0, 5, 10), rng.integers(0, 6, 10)
    wanted, count = rng.normal(size=(7, 10)), 7

    def total(x, y):
        x, y = x[receiver[:count]], y[sender[:count]]
        offset, n, m = (x[:, :3] - y[:, :3]) / 0.5, x[:, 3:], y[:, 3:]
        dots = [(a * b).sum(1) for a, b in ((n, offset), (m, offset), (n, m))]
        rows = [*offset.T, *dots, (offset**2).sum(1)]
        return float((np.stack(rows) * wanted[:, :count]).sum())

    def ours(x, y):
        rows = jnp.asarray(receiver, jnp.int32), jnp.asarray(sender, jnp.int32)
        inputs = rf._inputs_in_tiles(
            True, x, y, jnp.float32(0.5), *rows, jnp.int32(count)
        )
        return jnp.sum(inputs * wanted)

    np.testing.assert_allclose(ours(*map(jnp.asarray, ends)), total(*ends), rtol=1e-5)
    slopes = jax.grad(ours, argnums=(0, 1))(*map(jnp.asarray, ends))
    ends = [e.astype(np.float64) for e in ends]
    for end, slope in enumerate(slopes):
        for place in np.ndindex(ends[end].shape):
            low, high = ([e.copy() for e in ends] for _ in range(2))
            low[end][place] -= 1e-4
            high[end][place] += 1e-4
            expected = (total(*high) - total(*low)) / 2e-4
            np.testing.assert_allclose(slope[place], expected, rtol=1e-4, atol=1e-4)

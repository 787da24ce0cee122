"""What kernels see and what senders weigh: rotations, densities, areas of surfaces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conv_cases import cases, field_of
from hypothesis import given
from strategies import SEEDS

from ginn_jax import receptive_field as rf
from ginn_jax.hierarchy import same_side
from ginn_jax.packets import EdgeLimit, radius_edges
from ginn_jax.voxels import build_grid

pytestmark = pytest.mark.usefixtures("cheap_compiling")


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
        field = field_of(senders, receivers, np.float32(case.radius), ("surface", True))
        order = np.lexsort((field.sender, field.receiver))
        inputs.append(np.asarray(field.inputs).T[order])
    before, after = inputs
    np.testing.assert_allclose(after[:, :3], before[:, :3] @ turn.T, atol=1e-5)
    np.testing.assert_allclose(after[:, 3:], before[:, 3:], atol=1e-5)


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


@pytest.mark.parametrize("masked", [0, -1])
def test_whatever_is_masked_has_no_gradient(masked):
    """Padded edges name the first row, and the last one may be read beyond the end."""
    rng = np.random.default_rng(5)
    mask = np.ones(12, bool)
    mask[masked] = False
    radius = jnp.float32(0.7)

    def total(position, normal, radius):
        points = rf.Oriented(position, normal, jnp.asarray(mask))
        grid = build_grid(position, points.mask, radius)
        limit = EdgeLimit(256, 256, 64, 256)
        edges = radius_edges(grid, position, points.mask, radius, limit)
        area = rf.point_area(position, points.mask, edges, radius)
        inputs = rf.kernel_inputs(points, points, edges, radius, True)
        weight = rf.surface_weight(area, edges, 12, radius)
        return jnp.sum(inputs * weight)

    slopes = jax.jit(jax.grad(total, argnums=(0, 1, 2)))
    ends = [rng.uniform(0, 1, (12, 3)).astype(np.float32) for _ in range(2)]
    garbage = [np.where(mask[:, None], end, np.float32(np.nan)) for end in ends]
    clean = [np.where(mask[:, None], end, np.float32(0)) for end in ends]
    wanted, found = slopes(*clean, radius), slopes(*garbage, radius)
    for right, mine in zip(wanted, found, strict=True):
        np.testing.assert_array_equal(right, mine)
    assert not found[0][masked].any()
    assert np.abs(found[0]).max() > 0.1

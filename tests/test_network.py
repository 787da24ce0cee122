"""What no prediction and no gradient may depend on."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from ginn_jax import objective
from ginn_jax.architecture import Conv, Network
from ginn_jax.example import Asked, Example
from ginn_jax.geometry import build_geometry, build_query_field
from ginn_jax.limits import Limits, fits
from ginn_jax.presets import RELEASED, compact_network
from ginn_jax.receptive_field import Oriented
from ginn_jax.searches import limit_names

# The paper's kernels, batch norm, density and every kind of layer, in two levels.
SMALL_PAPER = Network(
    levels=(0.08, 0.1),
    encoder=(
        Conv("conv_1", 0, 0, 0.2, 0.25, 4, "raw", mixes=True),
        Conv("pool_1", 0, 1, 0.2, 0.2, 8),
        Conv("conv_2", 1, 1, 0.3, 0.25, 8, skip="pool_1"),
        Conv("up_1", 1, 0, 0.2, 0.2, 16, "norm", skip="conv_1"),
    ),
    query=replace(RELEASED.query, radius=0.2),
    latent=8,
    head=8,
    hidden=8,
    group=8,
    oriented=False,
    density="kde",
    norm="batch",
)
SPLATTED = replace(
    SMALL_PAPER, splat=True, levels=(0.08,), encoder=SMALL_PAPER.encoder[:1]
)
COMPACT = compact_network(k=4, levels=(0.08, 0.1), query_radius=0.2, latent=4)
ROWS = 320


pytestmark = pytest.mark.usefixtures("cheap_compiling")


@cache
def scene():
    """Points 0.11 apart, so that both levels keep all; the rest are the queries."""
    points = tiny.sphere_on_plane(2500, 1)
    kept = np.zeros(0, int)
    for i, p in enumerate(points.position):
        if (np.linalg.norm(points.position[kept] - p, axis=1) > 0.11).all():
            kept = np.append(kept, i)
    assert 200 < len(kept) < ROWS
    rest = np.setdiff1d(np.arange(2500), kept)[:200]
    return points.position[kept], points.normal[kept], points, rest


def cloud(order=None, rubbish=0.3):
    """The scene's points, in an order among themselves and the padding."""
    position, normal, *_ = scene()
    spare = ROWS - len(position)
    position = np.concatenate([position, np.full((spare, 3), rubbish, np.float32)])
    normal = np.concatenate([normal, np.full((spare, 3), rubbish, np.float32)])
    mask = np.arange(ROWS) < ROWS - spare
    order = np.arange(ROWS) if order is None else order
    return Oriented(position[order], normal[order], mask[order])


def queries(isolated=0):
    """200 points of the scene's; the last `isolated` are moved far away."""
    *_, points, rest = scene()
    position = points.position[rest].copy()
    position[200 - isolated :] += np.float32(50)
    return Oriented(position, points.normal[rest], np.ones(200, bool))


def limits_of(network, factor=1):
    sizes = {"columns": 8192, "candidates": 49152, "words": 2048}
    sizes |= {"edges": 12288, "points": ROWS}
    names = limit_names(network)
    return Limits(tuple((n, int(factor * sizes[n.split(".")[-1]])) for n in names))


@cache
def example_of(network, factor):
    """A compiled function from a cloud and queries to what the network needs."""
    limits = limits_of(network, factor)

    @jax.jit
    def build(cloud, queries):
        geometry, demands = build_geometry(
            network, limits, cloud, key=jax.random.key(2)
        )
        field, more = build_query_field(
            network, limits, geometry.levels[0], geometry.grid, geometry.area, queries
        )
        target = jnp.sin(9 * queries.position[:, 0])
        given, asked = (Asked(p.normal, None) for p in (geometry.levels[0], queries))
        example = Example(geometry, given, field, queries, asked, target)
        return example, demands | more, fits(limits, demands | more)

    def checked(cloud, queries):
        example, demands, enough = build(cloud, queries)
        assert enough, demands
        for level in example.geometry.levels:
            assert level.mask.sum() == cloud.mask.sum()
        return example

    return checked


@cache
def initial(network):
    example = example_of(network, 1)(cloud(), queries())
    init = jax.jit(partial(objective.init_variables, network))
    return init(example, key=jax.random.key(5))


@cache
def predictor(network):
    """Predictions of a network at initial parameters, one compilation per shape."""

    @jax.jit
    def predict(variables, example):
        return objective.infer(network, variables, example)[0]

    return lambda example: np.array(predict(initial(network), example))


@cache
def gradient_of(network):
    """Loss, moments and gradient in training, one compilation per shape."""
    params, moments = objective.split_variables(initial(network))
    value = jax.value_and_grad(objective.batch_loss, has_aux=True)
    compiled = jax.jit(lambda example: value(params, moments, network, example))
    return compiled


def test_gradient_reaches_every_parameter_of_the_papers_layers():
    (loss, moments), gradient = gradient_of(SMALL_PAPER)(
        example_of(SMALL_PAPER, 1)(cloud(), queries())
    )
    assert np.isfinite(loss)
    leaves = jax.tree_util.tree_leaves_with_path(gradient)
    named = {jax.tree_util.keystr(path): np.abs(leaf).max() for path, leaf in leaves}
    # Batch norm takes away what a bias before it adds.
    last = "['shader']['params']['Dense_1']['bias']"
    norms_away = [n for n in named if n.endswith("['bias']") and "BatchNorm" not in n]
    assert len(norms_away) == 2 + 1 + 2
    assert all(named[n] > 1e-5 for n in named if n == last or n not in norms_away), (
        named
    )
    kinds = {
        kind for kind in ("BatchNorm", "w1", "b3", "Dense") for n in named if kind in n
    }
    assert len(kinds) == 4
    _, before = objective.split_variables(initial(SMALL_PAPER))
    for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(moments), strict=True):
        assert np.isfinite(new).all()
        assert not np.array_equal(old, new)


@pytest.mark.parametrize("network", [SMALL_PAPER, SPLATTED], ids=["3D-2D", "splat"])
def test_padding_changes_nothing_in_training(network):
    """Neither loss nor gradient nor running moments, whatever the padding holds."""
    small = gradient_of(network)(example_of(network, 1)(cloud(), queries()))
    large = gradient_of(network)(
        example_of(network, 1.5)(cloud(rubbish=-0.7), queries())
    )
    for a, b in zip(jax.tree.leaves(small), jax.tree.leaves(large), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5 * max(1, np.abs(a).max()))


def test_padding_changes_no_prediction():
    build = example_of(COMPACT, 1)
    one = predictor(COMPACT)(build(cloud(), queries()))
    two = predictor(COMPACT)(build(cloud(rubbish=-0.7), queries()))
    assert one.std() > 1e-3
    np.testing.assert_allclose(one, two, atol=1e-5)


def test_order_of_points_changes_no_prediction():
    order = np.random.default_rng(0).permutation(ROWS)
    one = predictor(COMPACT)(example_of(COMPACT, 1)(cloud(), queries()))
    two = predictor(COMPACT)(example_of(COMPACT, 1)(cloud(order), queries()))
    np.testing.assert_allclose(one, two, atol=1e-5)


def test_isolated_queries_are_finite_and_disturb_no_other():
    build = example_of(COMPACT, 1)
    near = predictor(COMPACT)(build(cloud(), queries()))
    far = predictor(COMPACT)(build(cloud(), queries(isolated=30)))
    assert np.isfinite(far).all()
    np.testing.assert_allclose(far[:170], near[:170], atol=1e-6)
    assert not np.allclose(far[170:], near[170:], atol=1e-3)


def test_isolated_queries_leave_the_gradient_finite():
    build = example_of(SMALL_PAPER, 1)
    for isolated in (30, 200):
        result = gradient_of(SMALL_PAPER)(build(cloud(), queries(isolated)))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result))

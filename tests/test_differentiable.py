"""The shading of a query has a gradient in all that it depends on."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from ginn_jax import shading, train
from ginn_jax.receptive_field import Oriented
from ginn_jax.searches import uniform_limits

pytestmark = pytest.mark.usefixtures("cheap_compiling")

# Everything that numbers pass on their way: means of facets, light of both kinds.
NETWORK = replace(
    tiny.ONE_LEVEL,
    sided=True,
    lights=1,
    materials=1,
    asks="all",
    local=True,
    beams=1,
    taper=0.4,
    smooth=0.05,
)
LIMITS = uniform_limits(NETWORK, 1 << 14)
POINTS, QUERIES = 400, 200
WEIGHTS = np.random.default_rng(2).normal(size=(1, QUERIES)).astype(np.float32)
# How far each is moved at most; a pair that crosses a sharp border there adds a jump.
NEAR, SMOOTH = (3e-5, 1e-5, 3e-6), (1e-1, 3e-2, 1e-2, 1e-3)
STEPS = {
    "position": NEAR,
    "normal": SMOOTH,
    "material": SMOOTH,
    "light": SMOOTH,
    "query_position": NEAR,
    "query_normal": SMOOTH,
    "query_material": SMOOTH,
    "query_light": SMOOTH,
}


def numbers_of(count, seed):
    """Position, normal, material and light of so many points on a sphere or a plane."""
    rng, cloud = np.random.default_rng(seed), tiny.sphere_on_plane(count, seed)
    material, light = (rng.uniform(0.3, 0.9, (1, count, 1)) for _ in range(2))
    given = cloud.position, cloud.normal, material, light
    return [np.asarray(a, np.float32) for a in given]


@pytest.fixture(scope="module")
def given():
    """All that the shading depends on, by name."""
    arrays = [*numbers_of(POINTS, 0), *numbers_of(QUERIES, 1)]
    return dict(zip(STEPS, arrays, strict=True))


@pytest.fixture(scope="module")
def shaded():
    """What the network makes of the queries."""
    config = replace(tiny.CONFIG, network=NETWORK)
    rng = np.random.default_rng(4)
    # Of a network at its beginning some gradients are hardly more than rounding.
    variables = jax.tree.map(
        lambda a: np.float32(a + 0.3 * rng.standard_normal(a.shape)),
        jax.device_get(train.init_state(config).variables),
    )

    def values(position, normal, material, light, *queries):
        cloud = points_of(position, normal)
        given = NETWORK, LIMITS, variables, cloud, material, light, None
        encoded, demands = shading.encode(*given, jax.random.key(0))
        asked = points_of(*queries[:2]), *queries[2:]
        found, more = shading.shade(NETWORK, LIMITS, variables, encoded, *asked)
        return found, demands | more

    return jax.jit(values)


def points_of(position, normal):
    """Points without padding; their normals are made unit vectors."""
    normal = normal / jnp.linalg.norm(normal, axis=1, keepdims=True)
    return Oriented(position, normal, jnp.ones(len(position), bool))


@pytest.fixture(scope="module")
def gradients(given, shaded):
    """That of the weighted sum of the values, in everything at once."""

    @jax.jit
    def pull(*given):
        _, back, demands = jax.vjp(shaded, *given, has_aux=True)
        return back(jnp.asarray(WEIGHTS)), demands

    found, demands = pull(*given.values())
    assert all(int(d) <= LIMITS.of(name) for name, d in demands.items())
    return dict(zip(STEPS, found, strict=True))


@pytest.mark.parametrize("name", STEPS)
def test_gradients_are_the_slopes_of_the_shading(name, given, shaded, gradients):
    gradient = np.asarray(gradients[name])
    assert np.isfinite(gradient).all()
    rng = np.random.default_rng(3)
    # Some way up, for a sum over random ones would be hardly more than its rounding.
    way = np.sign(gradient) * rng.uniform(0.2, 1, gradient.shape)
    way = way.astype(np.float32)
    slope = partial(slope_along, shaded, given, name, way)
    slopes = np.array([slope(step) for step in STEPS[name]])
    expected = float(np.vdot(gradient.astype(np.float64), way))
    assert expected > 0
    assert np.abs(slopes / expected - 1).min() < 0.03


def slope_along(shaded, given, name, way, step):
    """That of the weighted sum between a step down and a step up the way."""
    ends = (given[name] + sign * np.float32(step) * way for sign in (-1, 1))
    low, high = (np.float64(shaded(*(given | {name: e}).values())[0]) for e in ends)
    return np.sum(WEIGHTS * (high - low)) / (2 * step)

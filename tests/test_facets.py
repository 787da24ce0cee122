"""Facets are smoothed by means over the samples around, and by nothing else."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from strategies import POINTS, QUERIES, UNIT, padded

from ginn_jax import example, facets, inference, train
from ginn_jax.architecture import QUERY
from ginn_jax.errors import InputError
from ginn_jax.geometry import build_geometry
from ginn_jax.receptive_field import Oriented
from ginn_jax.searches import limit_names, uniform_limits
from ginn_jax.voxels import build_grid

pytestmark = pytest.mark.usefixtures("cheap_compiling")

RADIUS = 0.5
NETWORK = replace(tiny.ONE_LEVEL, smooth=RADIUS)
LIMITS = uniform_limits(NETWORK, 1 << 12)
CHANNELS = 2


@st.composite
def oriented(draw, rows):
    """A padded cloud with unit normals, drawn as well."""
    position, mask = draw(padded(rows))
    normal = draw(hnp.arrays(np.float32, (rows, 3), elements=UNIT)).astype(np.float64)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 0.1, normal / np.maximum(length, 0.1), [0.0, 1, 0])
    position = np.where(np.isfinite(position), position, 0)
    return Oriented(*(a.astype(np.float32) for a in (position, normal)), mask)


def lights(rows):
    """Light of two channels on so many points."""
    some = st.floats(0, 4, width=32, allow_subnormal=False)
    return hnp.arrays(np.float32, (CHANNELS, rows, 1), elements=some)


@jax.jit
def smoothed(samples, receivers, light, own):
    """Normals and light of the receivers."""
    grid = build_grid(samples.position, samples.mask, jnp.float32(RADIUS))
    around = facets.Around(samples, grid)
    field, demands = facets.facet_field(NETWORK, LIMITS, around, receivers, QUERY)
    normal = facets.smooth_normals(field, around, receivers)
    return normal, facets.smooth_light(field, light, own), demands


def mean_around(place, normal, own, samples, values):
    """The mean in float64, sample by sample; `values` and `own` are flat."""
    total, weight = facets.OWN * np.asarray(own, np.float64), facets.OWN
    for j in np.flatnonzero(samples.mask):
        away = np.asarray(samples.position[j], np.float64) - place
        alike = float(np.dot(samples.normal[j].astype(np.float64), normal))
        share = 1 - (away @ away) / RADIUS**2
        if share > 0 and alike > 0:
            total = total + share * alike**2 * values[j]
            weight += share * alike**2
    return total / weight


@given(oriented(POINTS), oriented(QUERIES), lights(POINTS), lights(QUERIES))
def test_normals_and_light_are_means_over_the_samples_around(
    samples, receivers, light, own
):
    normal, shaded, demands = jax.device_get(smoothed(samples, receivers, light, own))
    assert all(d <= LIMITS.of(name) for name, d in demands.items())
    for i in np.flatnonzero(receivers.mask):
        ends = receivers.position[i].astype(np.float64), receivers.normal[i]
        mean = mean_around(*ends, ends[1], samples, samples.normal.astype(np.float64))
        right = mean / np.linalg.norm(mean)
        np.testing.assert_allclose(normal[i], right, atol=2e-3)
        flat = light[:, :, 0].T.astype(np.float64)
        right = mean_around(*ends, own[:, i, 0], samples, flat)
        np.testing.assert_allclose(shaded[:, i, 0], right, atol=2e-3)


@given(oriented(POINTS), st.floats(0.125, 8, width=32))
def test_what_is_the_same_everywhere_stays(samples, level):
    up = np.where(samples.mask[:, None], np.float32([0, 1, 0]), 0).astype(np.float32)
    samples = samples._replace(normal=up)
    light = np.full((CHANNELS, POINTS, 1), level, np.float32)
    receivers = Oriented(*(a[:QUERIES] for a in samples))
    found = smoothed(samples, receivers, light, light[:, :QUERIES])
    np.testing.assert_allclose(found[0], receivers.normal, atol=1e-6)
    real = np.asarray(found[1])[:, receivers.mask]
    np.testing.assert_allclose(real, level, rtol=1e-6)


def test_the_other_side_of_a_thin_wall_does_not_count():
    rng = np.random.default_rng(0)
    place = rng.uniform(-0.2, 0.2, (POINTS, 3)).astype(np.float32) * [1, 0, 1]
    side = np.where(np.arange(POINTS) % 2, -1.0, 1.0)[:, None]
    normal, mask = (side * [0, 1, 0]).astype(np.float32), np.ones(POINTS, bool)
    walls = Oriented(place.astype(np.float32), normal, mask)
    light = np.broadcast_to((side > 0).astype(np.float32), (CHANNELS, POINTS, 1))
    receivers = Oriented(*(a[:QUERIES] for a in walls))
    found = smoothed(walls, receivers, light, light[:, :QUERIES])
    np.testing.assert_allclose(found[0], receivers.normal, atol=1e-6)
    np.testing.assert_allclose(found[1], light[:, :QUERIES], atol=1e-6)


def test_a_point_without_samples_keeps_its_own():
    samples = Oriented(
        *(np.zeros((POINTS, 3), np.float32),) * 2, np.zeros(POINTS, bool)
    )
    up = np.tile(np.float32([0, 1, 0]), (QUERIES, 1))
    receivers = Oriented(up, up, np.ones(QUERIES, bool))
    own = np.random.default_rng(1).random((CHANNELS, QUERIES, 1), np.float32)
    light = np.ones((CHANNELS, POINTS, 1), np.float32)
    found = smoothed(samples, receivers, light, own)
    np.testing.assert_array_equal(found[0], up)
    np.testing.assert_allclose(found[1], own, rtol=1e-6)


LIT = {"linear": True, "materials": 1, "lights": 1, "asks": "all"}
WAVY, FLAT = (replace(n, **LIT) for n in (tiny.NETWORK, tiny.ONE_LEVEL))
KEY = jax.random.key(1)


@pytest.fixture(scope="module")
def scene():
    """A cloud and queries whose normals and light are rough, one channel of light."""
    rng = np.random.default_rng(2)
    points = tiny.sphere_on_plane(1300, 3)
    normal = points.normal + 0.3 * rng.normal(size=points.normal.shape)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    light = rng.gamma(0.5, size=(1, 1300, 1)).astype(np.float32)
    material = np.full((1, 1300, 1), 0.5, np.float32)
    columns = points.position, normal.astype(np.float32), material, light
    return [columns[i][:1000] for i in (0, 1)] + [c[:, :1000] for c in columns[2:]], [
        columns[i][1000:] for i in (0, 1)
    ] + [c[:, 1000:] for c in columns[2:]]


def by_hand(samples, points, reach):
    """What `points` are as means over `samples`, all pairs in float64."""
    place, normal, material, light = points
    away = place[:, None].astype(np.float64) - samples[0]
    near = np.maximum(1 - np.sum(away**2, axis=2) / reach**2, 0)
    share = near * np.maximum(normal.astype(np.float64) @ samples[1].T, 0) ** 2
    turned = share @ samples[1] + facets.OWN * normal
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    lit = share @ samples[3][0] + facets.OWN * light[0]
    lit = (lit / (share.sum(axis=1, keepdims=True) + facets.OWN))[None]
    return place, turned.astype(np.float32), material, lit.astype(np.float32)


def test_a_network_sees_what_was_smoothed_by_hand(scene):
    cloud, queries = scene
    weights = jax.device_get(
        train.init_state(replace(tiny.CONFIG, network=FLAT)).variables
    )

    def shade(network, cloud, queries):
        limits = uniform_limits(network, 1 << 15)
        encode = partial(inference.encode_cloud, network, limits, weights)
        encoded, limits = encode(*cloud, key=KEY)
        return inference.shade_points(network, limits, weights, encoded, *queries)[0]

    found = shade(replace(FLAT, smooth=0.12), cloud, queries)
    expected = shade(FLAT, *(by_hand(cloud, some, 0.12) for some in scene))
    size = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=2e-4 * size)
    assert np.abs(found - shade(FLAT, cloud, queries)).max() > 0.02 * size


def test_a_training_step_sees_the_same(scene):
    place, normal, material, light = scene[0]
    network = replace(WAVY, smooth=0.12)
    cloud = Oriented(place, normal, np.ones(len(place), bool))
    limits = uniform_limits(network, 1 << 17)
    build = jax.jit(partial(build_geometry, network, limits))
    geometry, demands = build(cloud, key=KEY)
    assert all(d <= limits.of(name) for name, d in jax.device_get(demands).items())
    finest = geometry.levels[0]
    rows = np.asarray(geometry.finest)[np.asarray(finest.mask)]
    some = place[rows], normal[rows], material[:, rows], light[:, rows]
    _, turned, _, lit = by_hand(scene[0], some, 0.12)
    np.testing.assert_allclose(
        np.asarray(finest.normal)[finest.mask], turned, atol=1e-5
    )
    batch = tiny.ShadedPoints(
        place, normal, *(light[0, :, 0],) * 2, material[0], light[0]
    )
    own = example.numbers(
        jax.tree.map(jnp.asarray, batch), geometry.finest, finest.mask, geometry.facets
    )
    np.testing.assert_allclose(np.asarray(own[1])[finest.mask], lit[0], atol=1e-5)
    level = geometry.levels[1]
    rows = np.flatnonzero(level.mask)
    at = [
        np.flatnonzero((finest.position == level.position[r]).all(1))[0] for r in rows
    ]
    np.testing.assert_array_equal(level.normal[rows], finest.normal[np.array(at)])


def test_networks_that_do_not_smooth_search_for_nothing():
    plain, smooth = set(limit_names(tiny.ONE_LEVEL)), set(limit_names(NETWORK))
    assert plain < smooth
    assert {n.rsplit(".", 1)[0] for n in smooth - plain} == {"facets", "query.facets"}


@pytest.mark.parametrize("radius", [-0.1, np.nan, np.inf])
def test_a_radius_that_is_none_is_refused(radius):
    with pytest.raises(InputError, match="smooth"):
        replace(tiny.ONE_LEVEL, smooth=radius)

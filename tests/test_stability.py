"""Stiff and extreme input: what once lost digits, or all of them."""

import warnings
from dataclasses import replace
from functools import cache, partial

import jax
import numpy as np
import pytest
import tiny
import trimesh

from benchmarks import (
    stability,
    stability_cases,
    stability_network,
    stability_stages,
)
from ginn_jax import dataset, hierarchy, image, inference, irradiance, recipe, train
from ginn_jax.dataset import unit_light
from ginn_jax.errors import InputError, InputWarning
from ginn_jax.lighting import PointLight
from ginn_jax.limits import Limits, raise_limits
from ginn_jax.mesh import Mesh
from ginn_jax.shading import Encoded
from ginn_jax.train import state_shapes

KEY = jax.random.key(0)
CLOUD = tiny.sphere_on_plane(300, 0)
NETWORK = tiny.ONE_LEVEL
CONFIG = replace(tiny.CONFIG, network=NETWORK)
LIMITS = tiny.ONE_LEVEL_LIMITS

# Light


@pytest.mark.parametrize("brightness", [0.0, 1e-41, 1e-38, 1e-30, 1e6, 1e36])
def test_light_of_any_brightness_has_a_unit(brightness):
    """Numbers too small to be inverted are no light; large ones do not overflow."""
    light = np.random.default_rng(0).uniform(0, 2, (1000, 1))
    light = (brightness * light).astype(np.float32)
    unit, scale = jax.jit(unit_light)(light, np.ones(1000, bool))
    assert np.isfinite(unit).all()
    assert np.isfinite(scale)
    if brightness >= 1e-30:
        mean = light.astype(float).mean()
        assert float(scale) == pytest.approx(mean, rel=1e-5)
        np.testing.assert_allclose(unit, light / mean, rtol=1e-5)


def test_closed_room_of_high_albedo():
    """Of a lamp in the middle of a ball each bounce leaves the albedo: a / (1 - a)."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    faces = ball.faces.astype(np.int32)
    mesh = Mesh(ball.vertices.astype(np.float32), faces, np.zeros(len(faces), np.int32))
    points, face = trimesh.sample.sample_surface(ball, 32, seed=0)
    ends = points.astype(np.float32), -ball.face_normals[face].astype(np.float32)
    lamp = PointLight(np.zeros(3, np.float32), np.ones(3, np.float32))
    scene = irradiance.light_scene(mesh, np.array([[0.5, 0.98, 0.99]]), lamp)
    direct = irradiance.direct_irradiance(scene, *ends, looks=1, seed=0)
    found = irradiance.indirect_irradiance(scene, *ends, paths=64, seed=0)
    series = np.array([1, 49, 99]) * direct.mean(0)
    np.testing.assert_allclose(found.mean.mean(0), series, rtol=0.03)


# Places


def test_wide_clouds_of_a_batch_stay_out_of_reach():
    """One with points far out, and a batch in metres: nobody gets new neighbours."""
    batch = tiny.batch()
    for position in (batch.position * np.float32(100), batch.position.copy()):
        position[0, 5] = [3.9, 0.5, 0]
        together = jax.jit(dataset.side_by_side)(batch._replace(position=position))
        placed = np.asarray(together.position).reshape(position.shape)
        gap = placed[1, :, 0].min() - placed[0, :, 0].max()
        assert gap > max(1.0, np.abs(position).max() / 2)
        np.testing.assert_allclose(placed[0], position[0])


def test_usual_clouds_of_a_batch_stand_as_ever():
    placed = jax.jit(dataset.side_by_side)(tiny.batch()).position
    expected = tiny.batch().position + np.array([[[0, 0, 0]], [[4, 0, 0]]], np.float32)
    np.testing.assert_array_equal(placed, expected.reshape(-1, 3))


@cache
def weights():
    with tiny.cheap_compiling():
        return train.init_state(CONFIG).variables


def shaded(position, offset=0.0):
    """What a network says of the cloud's own points, both moved."""
    with tiny.cheap_compiling():
        network, limits = tiny.ONE_LEVEL, tiny.ONE_LEVEL_LIMITS
        ends = position + offset, CLOUD.normal
        encoded, limits = inference.encode_cloud(
            network, limits, weights(), *ends, key=KEY
        )
        return inference.shade_points(network, limits, weights(), encoded, *ends)[0]


@pytest.mark.parametrize("offset", [1e3, 1e4, 1e6])
def test_a_cloud_far_away_looks_as_it_does_here(offset):
    """To the float64 that it comes in, and not to float32 at that distance."""
    position = CLOUD.position.astype(np.float64)
    here, there = shaded(position), shaded(position, offset)
    assert np.ptp(here) > 1e-3
    np.testing.assert_allclose(there, here, atol=1e-5 * np.abs(here).max())


@pytest.mark.parametrize("offset", [1e3, 1e4, 1e6])
def test_a_picture_far_away_has_the_edges_that_it_has_here(offset, monkeypatch):
    """Two floors, .02 apart, are told apart in the float64 that they come in."""

    def shade_heights(network, limits, variables, encoded, position, *_):
        return np.float32(position[:, 1] - offset > 0.01), limits

    tiny.shade_pixels_by(monkeypatch, shade_heights)
    x, z = np.meshgrid(*2 * [np.linspace(-0.6, 0.6, 24)])
    upper = x < 0
    position = np.stack([x, np.where(upper, 0.02, 0.0), z], axis=-1) + offset
    network = replace(NETWORK, query=replace(NETWORK.query, radius=0.02))
    center = dataset.center_of(position.reshape(-1, 3))
    codes = Encoded(*4 * [None], None, center)
    up = np.broadcast_to(np.float32([0, 1, 0]), position.shape)
    frame = codes, position, up, np.ones(x.shape, bool)
    found, _ = image.shade_image(network, LIMITS, {}, *frame, resolution_scale=0.5)
    np.testing.assert_allclose(found, upper, atol=1e-3)


def test_a_cloud_in_other_units_is_told():
    """Its points are all farther from each other than any receptive field is wide."""
    with pytest.warns(InputWarning, match="lie 1 points .* fit the object into the un"):
        shaded(100 * CLOUD.position.astype(np.float64))
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputWarning)
        shaded(CLOUD.position.astype(np.float64))


def test_clouds_of_a_batch_are_counted_from_their_middle():
    """Before anything turns them, which far from the origin would round them."""
    cloud = CLOUD._replace(position=CLOUD.position.astype(np.float64))
    moved = cloud._replace(position=cloud.position + 2.0**20)
    batch = dataset.stack_clouds([CLOUD, moved])
    assert batch.position.dtype == np.float32
    np.testing.assert_array_equal(batch.position[0], CLOUD.position)
    np.testing.assert_allclose(batch.position[1], CLOUD.position, atol=1e-6)


@pytest.mark.parametrize("offset", [0.0, 0.7, -1e4, 1e30])
@pytest.mark.parametrize("size", [1.0, 1e-6, 0.0])
def test_coordinates_are_counted_from_where_nothing_is_rounded(offset, size):
    position = (offset + size * CLOUD.position).astype(np.float32)
    center = dataset.center_of(position)
    assert center.dtype == np.float32
    exact = position.astype(np.float64) - center
    np.testing.assert_array_equal(dataset.relative_to(center, position), exact)
    if offset == 0 and size:
        assert not center.any()


# Crowds


def test_more_pairs_than_can_be_counted_are_refused():
    """The largest demand there is means that or more: no capacity will do."""
    limits = Limits((("level_0.edges", 64),))
    with pytest.raises(InputError, match=r"^level_0\.edges would [^\n]*merge[^\n]*\Z"):
        raise_limits(limits, {"level_0.edges": 2**31 - 1}, 1.25)
    assert raise_limits(limits, {"level_0.edges": 2**30}, 1.25).of("level_0.edges")


def test_words_are_as_many_as_their_queries_can_be_counted():
    limits = Limits((("query.words", 64),))
    with pytest.raises(InputError, match=r"^query\.words would need 20000000 "):
        raise_limits(limits, {"query.words": 20_000_000}, 1.25)
    assert raise_limits(limits, {"query.words": 10_000_000}, 1.25).of("query.words")


# Float64, to compare with


def test_a_step_draws_and_searches_alike_in_float64():
    """The same random numbers and pairs, whatever the default types are."""
    batch = jax.tree.map(lambda a: a[:, :64], tiny.batch())
    config = replace(CONFIG, points=64, queries=32)

    def example(batch):
        make = partial(train.make_example, config, LIMITS)
        made, demands = jax.jit(make)(batch, key=jax.random.key(5))
        return jax.device_get((made.queries.position, made.field, demands))

    with tiny.cheap_compiling(), jax.numpy_dtype_promotion("standard"):
        place, field, demands = example(batch)
        with jax.enable_x64(True):
            double = jax.tree.map(lambda a: a.astype(np.float64), batch)
            exact_place, exact, exact_demands = example(double)
    assert exact_place.dtype == np.float64
    assert demands == exact_demands
    np.testing.assert_allclose(place, exact_place, atol=1e-6)
    np.testing.assert_array_equal(field.sender, exact.sender)
    np.testing.assert_allclose(field.weight, exact.weight, rtol=1e-5)


# The benchmark


def test_errors_are_relative_and_non_finite_numbers_are_counted():
    found = np.array([1.0, 2.0, np.nan]), np.array([[50.0]])
    exact = np.array([1.0, 4.0, 4.0]), np.array([[40.0]])
    assert stability_stages.error(found, exact) == (0.5, 1)
    assert stability_stages.error(exact, exact) == (0.0, 0)


def test_benchmark_sees_a_lost_pair_and_a_lost_point(monkeypatch):
    case = stability_cases.plain()._replace(count=200)
    stages = stability_stages.search_row, stability_stages.disk_row
    assert [stage(case)["error"] for stage in stages] == [0, 0]
    find, thin = stability_stages.find_neighbors, hierarchy.poisson_disk
    fewer = lambda *args: tuple(a[:-1] for a in find(*args))  # noqa: E731
    monkeypatch.setattr(stability_stages, "find_neighbors", fewer)
    monkeypatch.setattr(
        hierarchy, "poisson_disk", lambda *a, key: thin(*a, key=key)[1:]
    )
    assert all(stage(case)["error"] > 0 for stage in stages)


def test_benchmark_knows_the_network():
    """What it traces for every case; running that takes minutes."""
    case, network = stability_cases.plain(), stability_cases.small_network()
    config = recipe.Training(network, 1, batch_size=1, points=256, queries=64)
    cloud = stability_stages.oriented(case)
    numbers = case.albedo.astype(np.float32), case.light.astype(np.float32)
    given = state_shapes(config).variables, cloud, *numbers, cloud
    fixed = network, stability_network.roomy(network)
    traced = partial(stability_network.whole, *fixed)
    _, values, demands = jax.eval_shape(traced, *given)
    assert values.shape == (len(case.light), len(case.position))
    assert set(demands) == set(dict(fixed[1].sizes))


def test_report_says_what_is_outside_and_what_was_refused():
    rows = [
        {"stage": "f_2D", "case": "good", "error": 1e-6, "bad": 0, "ms": 1.0},
        {"stage": "f_2D", "case": "poor", "error": 0.5, "bad": 3, "ms": 1.0},
        {"stage": "f_2D", "case": "bent", "note": "refused: no"},
        {"stage": "subsurface", "case": "noisy", "error": 0.1, "bad": 0, "ms": 1.0},
    ]
    parts = stability.write_report(rows).split("\n\n")
    tables = [part for part in parts if part.startswith("| ")]
    assert "| f_2D | 2 | 1 | 1e-06 |" in tables[0]
    assert "| subsurface | 1 | 0 | - |" in tables[0]
    assert [case in tables[1] for case in ("good", "poor", "bent")] == [0, 1, 0]
    assert [case in tables[2] for case in ("good", "poor", "bent")] == [0, 0, 1]

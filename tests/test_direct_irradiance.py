"""Closed forms of direct irradiance."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rooms import (
    LAMP,
    UP,
    WHITE,
    copies,
    cup,
    floor,
    floor_and_wall,
    joined,
    quad,
    sampled,
    spread,
)

from ginn_jax import irradiance
from ginn_jax.irradiance import direct_irradiance, light_scene
from ginn_jax.lighting import (
    EnvironmentMap,
    PointLight,
    constant_sky,
    irradiance_of,
    studio,
)


def test_open_plane_under_a_constant_sky():
    """The mean is within .1 % of pi L, and no point is 1 % off."""
    scene = light_scene(floor(), WHITE, constant_sky(2.0))
    points, normals = sampled(floor(), 200)
    found = direct_irradiance(scene, points, normals, looks=1024, seed=0)
    np.testing.assert_allclose(found, 2 * np.pi, rtol=0.01)
    np.testing.assert_allclose(found.mean(0), 2 * np.pi, rtol=1e-3)
    under = direct_irradiance(scene, points, -normals, looks=1024, seed=0)
    np.testing.assert_allclose(under, 2 * np.pi, rtol=0.01)


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 2), (2, 9), (9, 1), (3, 2)])
def test_a_map_of_few_pixels_is_light_as_any_other(shape):
    sky = EnvironmentMap(np.full((*shape, 3), 2, np.float32))
    points, normals = sampled(floor(), 50)
    scene = light_scene(floor(), WHITE, sky)
    found = direct_irradiance(scene, points, normals, looks=1024, seed=0)
    np.testing.assert_allclose(found, 2 * np.pi, rtol=0.02)


@pytest.mark.parametrize("kind", [list, bool, np.uint8, int])
def test_numbers_of_any_type_are_radiance(kind, unchecked):
    pixels = np.ones((4, 8, 3))
    sky = EnvironmentMap(pixels.tolist() if kind is list else pixels.astype(kind))
    points, normals = sampled(floor(), 50)
    scene = light_scene(floor(), WHITE, sky)
    found = direct_irradiance(scene, points, normals, looks=1024, seed=0)
    np.testing.assert_allclose(found, np.pi, rtol=0.02)


def quadrature(light, normal, fine=4):
    """Irradiance of a map whose first and last row lie on the poles, as Mitsuba's do.

    Linear between rows; `fine` nodes a row.
    """
    height, width = light.radiance.shape[:2]
    theta = (np.arange(height * fine) + 0.5) / (height * fine) * np.pi
    phi = (np.arange(width) + 0.5) / width * 2 * np.pi
    place = theta / np.pi * (height - 1)
    row = place.astype(int)
    share = (place - row)[:, None, None]
    radiance = (1 - share) * light.radiance[row] + share * light.radiance[row + 1]
    down, around = np.meshgrid(theta, phi, indexing="ij")
    toward = [np.sin(around) * np.sin(down), np.cos(down), -np.cos(around)]
    toward[2] *= np.sin(down)
    cosine = np.maximum(np.tensordot(normal, toward, 1), 0)
    weight = cosine * np.sin(down) * np.pi / len(theta) * 2 * np.pi / width
    return (radiance * weight[..., None]).sum((0, 1))


@pytest.mark.parametrize("light", [3, 8])
def test_unshadowed_surface_has_the_irradiance_of_the_map(light):
    """For any normal, and the more exactly the more directions are looked in.

    By `irradiance_of` only to 5 %, as it has the first row half a row below the pole.
    """
    light = studio(light)
    scene = light_scene(floor(1e-3), WHITE, light)
    normals = np.random.default_rng(0).normal(size=(10, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # Far from the mesh, which then hides nothing.
    points = np.tile(np.float32([5, 5, 5]), (10, 1))
    exact = np.array([quadrature(light, n) for n in normals])
    for samples, rtol in [(1024, 0.05), (65536, 2e-3)]:
        found = direct_irradiance(
            scene, points, normals.astype(np.float32), looks=samples, seed=0
        )
        np.testing.assert_allclose(found, exact, rtol=rtol)
    simple = np.array([irradiance_of(light, n) for n in normals])
    np.testing.assert_allclose(simple, exact, rtol=0.05)


@settings(max_examples=30)
@given(hnp.arrays(np.float32, (8, 2), elements=st.floats(-1, 1, width=32)))
def test_plane_under_a_point_light(place):
    """Intensity times cosine over the distance squared, to float32's rounding."""
    scene = light_scene(floor(2), WHITE, LAMP)
    points = np.insert(place, 1, 0, axis=1)
    found = direct_irradiance(
        scene, points, np.tile(UP, (8, 1)), looks=1 + len(place), seed=1
    )
    toward = LAMP.position - points
    distance = np.linalg.norm(toward, axis=1, keepdims=True)
    expected = LAMP.intensity * toward[:, 1:2] / distance**3
    np.testing.assert_allclose(found, expected, rtol=2e-4)


def test_shadow_of_a_point_light_is_black():
    """A square halfway up casts a shadow of twice its size."""
    light = PointLight(np.array([0.0, 1.0, 0.0]), np.ones(3))
    lid = quad((-0.1, 0.5, -0.1), (0, 0, 0.2), (0.2, 0, 0))
    scene = light_scene(joined(floor(), lid), WHITE, light)
    x = np.linspace(-0.9, 0.9, 61, dtype=np.float32)
    points = np.stack(np.meshgrid(x, [0], x), axis=-1).reshape(-1, 3)
    points = points.astype(np.float32)
    normals = np.tile(UP, (len(points), 1))
    found = direct_irradiance(scene, points, normals, looks=1, seed=0)
    dark = np.abs(points).max(axis=1) < 0.2
    assert 0 < dark.sum() < len(points)
    np.testing.assert_array_equal(found[dark], 0)
    assert found[~dark].min() > 0
    behind = direct_irradiance(scene, points, -normals, looks=1, seed=0)
    np.testing.assert_array_equal(behind, 0)


def test_wall_hides_half_the_sky():
    scene = light_scene(floor_and_wall(100), WHITE, constant_sky())
    points, normals = copies((0.05, 0, 0), 200)
    found = direct_irradiance(scene, points, normals, looks=256, seed=0)
    mean, sigma = spread(found)
    assert (sigma < 0.01).all()
    np.testing.assert_allclose(mean, np.pi / 2, atol=4 * sigma.max() + 2e-3)


def test_two_maps_together_give_both_their_irradiance():
    one, two = studio(1), studio(2)
    both = EnvironmentMap(one.radiance + two.radiance)
    points, normals = copies((0.2, 0, 0.3), 128)
    scenes = [light_scene(cup(), WHITE, light) for light in (one, two, both)]
    found = [
        spread(direct_irradiance(s, points, normals, looks=256, seed=i))
        for i, s in enumerate(scenes)
    ]
    mean, sigma = np.array(found).transpose(1, 0, 2)
    assert mean[:2].min() > 0
    assert (sigma < 0.02 * mean).all()
    assert (np.abs(mean[0] + mean[1] - mean[2]) < 4.5 * sigma.sum(0)).all()


def test_chunks_do_not_matter_for_direct_light(monkeypatch):
    scene = light_scene(cup(), WHITE, studio(1))
    points, normals = sampled(cup(), 60)

    def look(count, seed):
        return direct_irradiance(
            scene, points[:count], normals[:count], looks=16, seed=seed
        )

    whole = look(60, 7)
    np.testing.assert_array_equal(whole, look(60, 7))
    np.testing.assert_array_equal(whole[:20], look(20, 7))
    assert (whole != look(60, 8)).any()
    for most in (16, 16 * 7, 16 * 59):
        monkeypatch.setattr(irradiance, "PATHS_PER_LAUNCH", most)
        np.testing.assert_array_equal(whole, look(60, 7))

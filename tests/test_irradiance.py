"""Conserved light and closed forms of indirect irradiance, and of both together."""

import numpy as np
import pytest
import trimesh
from rooms import (
    LAMP,
    WHITE,
    copies,
    cup,
    floor,
    joined,
    quad,
    sampled,
    solid,
    spread,
    total,
)

from ginn_jax import irradiance
from ginn_jax.irradiance import direct_irradiance, indirect_irradiance, light_scene
from ginn_jax.lighting import EnvironmentMap, constant_sky, irradiance_of, studio

BALL = solid(trimesh.creation.icosphere(subdivisions=2, radius=0.5))


def scaled(light, factor):
    return EnvironmentMap(light.radiance * np.asarray(factor, np.float32))


@pytest.mark.parametrize("light", [constant_sky(3.0), studio(1), LAMP])
def test_convex_object_alone_lights_itself_by_nothing(light):
    scene = light_scene(BALL, WHITE, light)
    points, normals = sampled(BALL, 3000)
    found = indirect_irradiance(scene, points, normals, paths=16, seed=0)
    np.testing.assert_array_equal(found.mean, 0)
    np.testing.assert_array_equal(found.variance, 0)
    direct = direct_irradiance(scene, points, normals, looks=4, seed=0)
    assert direct.max() > 0


def facing_quads():
    """Two white squares of side 1, one above the other at a distance of .5."""
    lower = quad((0, 0, 0), (0, 0, 1), (1, 0, 0))
    upper = quad((0, 0.5, 0), (1, 0, 0), (0, 0, 1))
    return joined(lower, upper)


@pytest.mark.parametrize("mesh", [cup(), facing_quads()])
def test_white_furnace(mesh):
    """Where nothing is absorbed, all that a sky of radiance 1 surrounds gets pi.

    After all bounces: in the cup the fourth still brings some percent.
    """
    scene = light_scene(mesh, WHITE, constant_sky())
    points, normals = sampled(mesh, 200, seed=1)
    direct = direct_irradiance(scene, points, normals, looks=1024, seed=0)
    bounced = indirect_irradiance(scene, points, normals, paths=1024, seed=0)
    mean, sigma = total(bounced)
    assert (sigma < 0.002 * np.pi).all()
    assert (mean > 0.2 * np.pi).all()
    np.testing.assert_allclose(
        mean + direct.mean(0), np.pi, atol=4 * sigma.max() + 1e-3 * np.pi
    )
    off = direct + bounced.mean - np.pi
    assert (np.abs(off) < 6 * np.sqrt(bounced.variance) + 0.03 * np.pi).all()


def test_black_surfaces_send_nothing_on():
    scene = light_scene(cup(), np.zeros((2, 3)), studio(1))
    points, normals = sampled(cup(), 500)
    found = indirect_irradiance(scene, points, normals, paths=16, seed=0)
    np.testing.assert_array_equal(found.mean, 0)


def test_ceiling_sends_back_its_albedo_of_what_it_gets():
    """A vast ceiling above a point sends a E / pi from everywhere, and E is pi L."""
    albedo = np.array([[0.02, 0.01, 0.005]])
    ceiling = quad((-500, 1, -500), (1000, 0, 0), (0, 0, 1000))
    scene = light_scene(ceiling, albedo, constant_sky(2.0))
    points, normals = copies((0, 0, 0), 100)
    found = indirect_irradiance(scene, points, normals, paths=256, seed=2)
    mean, sigma = total(found)
    expected = 2 * np.pi * albedo[0]
    assert (sigma < 0.01 * expected).all()
    assert (np.abs(mean - expected) < 4 * sigma + 1e-3 * expected).all()


@pytest.mark.parametrize("light", [constant_sky(), studio(1), LAMP])
def test_twice_the_radiance_gives_exactly_twice_the_light(light):
    if isinstance(light, EnvironmentMap):
        double = scaled(light, 2)
    else:
        double = light._replace(intensity=2 * light.intensity)
    points, normals = sampled(cup(), 100)
    direct, bounced = [], []
    for each in (light, double):
        scene = light_scene(cup(), WHITE * 0.7, each)
        given = scene, points, normals
        direct.append(direct_irradiance(*given, looks=16, seed=3))
        bounced.append(indirect_irradiance(*given, paths=16, seed=3))
    assert bounced[0].mean.max() > 0
    np.testing.assert_allclose(direct[1], 2 * direct[0], rtol=1e-5)
    np.testing.assert_allclose(bounced[1].mean, 2 * bounced[0].mean, rtol=1e-5)
    np.testing.assert_allclose(
        bounced[1].variance, 4 * bounced[0].variance, rtol=1e-3, atol=1e-6
    )


@pytest.mark.parametrize("light", [studio(1), LAMP])
def test_swapped_channels_swap_the_light(light):
    """The same paths but for how roulette and maps weigh colours: within the noise."""
    albedo = np.array([[0.9, 0.5, 0.1], [0.2, 0.6, 0.8]])
    if isinstance(light, EnvironmentMap):
        tinted = scaled(light, [1, 0.5, 0.2])
        other = EnvironmentMap(np.ascontiguousarray(tinted.radiance[..., ::-1]))
    else:
        tinted, other = light, light._replace(intensity=light.intensity[::-1].copy())
    points, normals = copies((0.2, 0, 0.3), 400)
    one, two = (
        light_scene(cup(), albedo, tinted),
        light_scene(cup(), albedo[:, ::-1].copy(), other),
    )
    found = [
        spread(direct_irradiance(s, points, normals, looks=64, seed=4))
        for s in (one, two)
    ] + [
        total(indirect_irradiance(s, points, normals, paths=64, seed=4))
        for s in (one, two)
    ]
    for (a, sigma_a), (b, sigma_b) in (found[:2], found[2:]):
        off = np.abs(a - b[::-1])
        assert (off < 4.5 * np.hypot(sigma_a, sigma_b[::-1]) + 1e-4 * a).all()
        assert abs(a[0] - a[2]) > 10 * off.max()  # else swapping would not show


@pytest.mark.parametrize("paths", [2, 8])
def test_variance_is_that_of_the_mean(paths):
    """Over 64 seeds, at each point; their ratio is 1 but for 5 of its own errors."""
    scene = light_scene(cup(), WHITE * 0.8, constant_sky())
    points, normals = sampled(cup(), 100)
    found = [
        indirect_irradiance(scene, points, normals, paths=paths, seed=s)
        for s in range(64)
    ]
    mean = np.array([f.mean for f in found], float)
    stated = np.array([f.variance for f in found], float).mean(0)
    off = mean.var(0, ddof=1) - stated
    error = off.std(0) / np.sqrt(len(points))
    assert (error < 0.05 * stated.mean(0)).all()
    assert (np.abs(off.mean(0)) < 5 * error).all()


def test_seed_decides():
    scene = light_scene(cup(), WHITE * 0.8, studio(1))
    points, normals = copies((0.2, 0, 0.3), 2000)

    def cast(seed):
        return indirect_irradiance(scene, points, normals, paths=4, seed=seed)

    one, same, other = cast(5), cast(5), cast(6)
    np.testing.assert_array_equal(one.mean, same.mean)
    np.testing.assert_array_equal(one.variance, same.variance)
    a, b = one.mean[:, 1], other.mean[:, 1]
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.12
    assert abs(np.corrcoef(a[1:], a[:-1])[0, 1]) < 0.12


def test_chunks_are_independent_and_of_the_same_mean(monkeypatch):
    scene = light_scene(cup(), WHITE * 0.8, constant_sky())
    points, normals = copies((0.2, 0, 0.3), 300)
    whole = indirect_irradiance(scene, points, normals, paths=16, seed=0)
    monkeypatch.setattr(irradiance, "PATHS_PER_LAUNCH", 16 * 100)
    parts = indirect_irradiance(scene, points, normals, paths=16, seed=0)
    assert parts.mean.shape == parts.variance.shape == (300, 3)
    thirds = parts.mean.reshape(3, 100, 3)
    assert (thirds[0] != thirds[1]).any()
    assert (thirds[1] != thirds[2]).any()
    (a, sigma_a), (b, sigma_b) = total(whole), total(parts)
    assert (np.abs(a - b) < 4.5 * np.hypot(sigma_a, sigma_b)).all()


def test_sun_in_one_pixel_is_found():
    """1e5 in a pixel of a dim sky: finite, and the sun's share as the sum says."""
    radiance = np.full((256, 512, 3), 0.1, np.float32)
    radiance[40, 100] = 1e5
    light = EnvironmentMap(radiance)
    scene = light_scene(floor(), WHITE * 0.5, light)
    points, normals = copies((0, 0, 0), 50)
    found = direct_irradiance(scene, points, normals, looks=256, seed=0)
    expected = irradiance_of(light, np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(found.mean(0), expected, rtol=0.02)
    np.testing.assert_allclose(found, expected[None].repeat(50, 0), rtol=0.1)
    inside = light_scene(cup(), WHITE * 0.5, light)
    points, normals = sampled(cup(), 200)
    bounced = indirect_irradiance(inside, points, normals, paths=32, seed=0)
    assert np.isfinite(bounced.mean).all()
    assert np.isfinite(bounced.variance).all()
    assert bounced.mean.max() > 0.1


def test_material_without_faces_may_have_an_albedo():
    """The albedo is that of the face's material, whatever else there is."""
    points, normals = sampled(cup(), 50)
    found = [
        indirect_irradiance(
            light_scene(cup(), albedo, constant_sky()),
            points,
            normals,
            paths=8,
            seed=0,
        ).mean
        for albedo in (WHITE * 0.5, np.concatenate([WHITE * 0.5, np.zeros((2, 3))]))
    ]
    np.testing.assert_array_equal(found[0], found[1])


def test_each_material_has_its_albedo():
    """On the floor of a cup whose walls alone, or floor alone, are black."""
    floor_black = np.array([[0.0] * 3, [0.8] * 3])
    points, normals = copies((0.5, 0, 0.5), 100)
    dark, light = (
        indirect_irradiance(
            light_scene(cup(), albedo, constant_sky()),
            points,
            normals,
            paths=64,
            seed=0,
        )
        for albedo in (floor_black[::-1], floor_black)
    )
    np.testing.assert_array_equal(dark.mean, 0)
    assert light.mean.mean() > 0.5


def test_no_points_and_one_path():
    scene = light_scene(cup(), WHITE, constant_sky())
    nothing = np.zeros((0, 3), np.float32)
    assert direct_irradiance(scene, nothing, nothing, looks=4, seed=0).shape == (0, 3)
    found = indirect_irradiance(scene, nothing, nothing, paths=4, seed=0)
    assert found.mean.shape == found.variance.shape == (0, 3)
    points, normals = sampled(cup(), 5)
    one = indirect_irradiance(scene, points, normals, paths=1, seed=0)
    assert np.isfinite(one.mean).all()
    assert np.isnan(one.variance).all()

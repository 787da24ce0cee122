"""Subsurface scattering: conserved energy and closed forms."""

import numpy as np
import pytest
import trimesh
from media import BALL, IORS, SLAB, medium_of, scene_of, surface
from rooms import total

from ginn_jax import subsurface
from ginn_jax.irradiance import direct_irradiance
from ginn_jax.lighting import EnvironmentMap, PointLight, constant_sky, studio
from ginn_jax.slab import external_reflectance
from ginn_jax.subsurface import Medium, subsurface_exitance


def middle(z, count):
    """`count` times the centre of the face of `SLAB` at height z."""
    points = np.tile(np.array([0, 0, z], np.float32), (count, 1))
    return points, points / abs(z)


@pytest.mark.parametrize("ior", IORS)
def test_thick_slab_has_the_albedo_asked_for(ior):
    """1,000 mean free paths a side: the centre of a face does not see the edges."""
    block = trimesh.creation.box((1, 1, 1))
    albedo = np.array([0.1, 0.5, 0.9], np.float32)
    points, normals = middle(0.5, 64)
    result, _ = subsurface_exitance(
        scene_of(block, constant_sky()),
        Medium(albedo, 1000.0, ior),
        points,
        normals,
        paths=1024,
        seed=0,
    )
    mean, sigma = total(result)
    expected = (1 - external_reflectance(ior)) * albedo * np.pi
    assert (np.abs(mean - expected) < 4 * sigma).all()
    assert (sigma < [0.02 * x for x in expected]).all()


# Energy


@pytest.mark.parametrize("ior", IORS)
@pytest.mark.parametrize("extinction", [0.0, 0.1, 5.0, 50.0])
def test_medium_without_absorption_returns_what_enters(extinction, ior):
    points, normals = surface(BALL, 64)
    result, lost = subsurface_exitance(
        scene_of(BALL, constant_sky(2.0)),
        medium_of(1, extinction, ior),
        points,
        normals,
        paths=2048,
        seed=1,
    )
    mean, sigma = total(result)
    expected = 2 * np.pi * (1 - external_reflectance(ior))
    assert (np.abs(mean - expected) < 4 * sigma).all()
    assert (sigma < 0.005 * expected).all()
    assert lost < 1e-4


def test_flux_out_is_flux_in_under_uneven_light():
    """A point light beside the ball: exitance moves elsewhere, its total does not."""
    points, normals = surface(BALL, 20_000)
    light = PointLight(np.array([0.0, 0.3, 1.0]), np.array([1.0, 2.0, 4.0]))
    scene = scene_of(BALL, light)
    result, _ = subsurface_exitance(
        scene, medium_of(1, 10.0, 1.3), points, normals, paths=8, seed=2
    )
    arrives = direct_irradiance(scene, points, normals, looks=1, seed=0)
    enters = (1 - external_reflectance(1.3)) * arrives.astype(float)
    difference = result.mean - enters
    sigma = difference.std(0) / np.sqrt(len(points))
    assert (np.abs(difference.mean(0)) < 4 * sigma).all()
    assert (sigma < 0.02 * enters.mean(0)).all()
    assert (np.abs(difference).mean(0) > 0.2 * enters.mean(0)).all()


def test_black_medium_is_black():
    points, normals = surface(BALL, 64)
    result, _ = subsurface_exitance(
        scene_of(BALL, constant_sky()),
        medium_of(0, 50.0, 1.3),
        points,
        normals,
        paths=256,
        seed=3,
    )
    assert result.mean.mean() < 0.01


def test_twice_the_light_gives_exactly_twice_the_exitance():
    points, normals = surface(BALL, 50)
    light = studio(1)
    medium = medium_of((0.3, 0.6, 0.9), 20.0, 1.3)
    one, two = (
        subsurface_exitance(
            scene_of(BALL, EnvironmentMap(light.radiance * np.float32(factor))),
            medium,
            points,
            normals,
            paths=64,
            seed=4,
        )[0]
        for factor in (1, 2)
    )
    assert one.mean.min() > 0
    np.testing.assert_array_equal(two.mean, 2 * one.mean)


# Solids of one medium


def boxes(*spans):
    """A block of 1 x 1 made of boxes between these x, with walls inside it."""
    parts = [
        trimesh.creation.box(bounds=[(low, -0.5, -0.5), (high, 0.5, 0.5)])
        for low, high in spans
    ]
    return trimesh.util.concatenate(parts)


@pytest.mark.parametrize("extinction", [0.0, 2.0, 20.0])
@pytest.mark.parametrize(
    "spans",
    [
        [(-0.5, 0.1), (-0.1, 0.5)],
        [(-0.5, 0.2), (-0.3, 0.4), (-0.2, 0.5), (-0.05, 0.05)],
    ],
    ids=["two", "four"],
)
def test_solids_that_overlap_are_filled_as_one(spans, extinction):
    """What is inside another solid is no boundary: no light is lost on it."""
    points, normals = surface(boxes((-0.5, 0.5)), 400)
    lamp = PointLight(np.array([1.5, 1.0, 0.5]), np.array([1.0, 1.0, 1.0]))
    one, parts = (
        subsurface_exitance(
            scene_of(shape, lamp),
            medium_of((0.3, 0.6, 0.9), extinction, 1.3),
            points,
            normals,
            paths=256,
            seed=i,
        )
        for i, shape in enumerate((boxes((-0.5, 0.5)), boxes(*spans)))
    )
    (mean, sigma), (found, other) = total(one[0]), total(parts[0])
    assert (np.abs(mean - found) < 4 * np.hypot(sigma, other)).all()
    assert (sigma < 0.02 * mean).all()
    assert max(one[1], parts[1]) < 1e-4


def test_what_is_opaque_inside_a_medium_takes_light():
    """A black ball inside a glowing one is not filled with its medium."""
    points, normals = surface(BALL, 64)
    core = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    clear, dark = (
        subsurface_exitance(
            scene_of(BALL, constant_sky(), opaque=opaque),
            medium_of(1, 5.0, 1.3),
            points,
            normals,
            paths=256,
            seed=11,
        )[0]
        for opaque in (None, core)
    )
    assert (total(dark)[0] < 0.8 * total(clear)[0]).all()
    assert total(dark)[0].min() > 0.1


# Light from one side


def test_thin_slab_glows_in_front_when_lit_from_behind():
    lamp = PointLight(np.array([0.0, 0.0, 2.0]), np.array([1.0, 1.0, 1.0]))
    points, normals = middle(-0.05, 64)
    scene = scene_of(SLAB, lamp)
    medium = medium_of((0.2, 0.5, 0.9), 30.0, 1.3)
    assert not direct_irradiance(scene, points, normals, looks=1, seed=0).any()
    front, _ = subsurface_exitance(scene, medium, points, normals, paths=512, seed=6)
    mean, sigma = total(front)
    assert (mean > 5 * sigma).all()
    assert (np.diff(mean) > 0).all()
    behind, _ = subsurface_exitance(scene, medium, *middle(0.05, 64), paths=512, seed=6)
    assert (total(behind)[0] > mean).all()


def test_what_stands_before_the_light_takes_it():
    lamp = PointLight(np.array([0.0, 0.0, 2.0]), np.array([1.0, 1.0, 1.0]))
    screen = trimesh.creation.box((9, 9, 0.1))
    screen.apply_translation((0, 0, 1))
    scene = scene_of(SLAB, lamp, opaque=screen)
    result, lost = subsurface_exitance(
        scene, medium_of(0.9, 30.0, 1.3), *middle(-0.05, 16), paths=64, seed=7
    )
    assert not result.mean.any()
    assert lost < 0.01


def test_straight_light_crosses_a_clear_matched_slab():
    """A lamp as high above the slab as that is thick: E at angle t is 100 cos(t)^3.

    The mean of that over cosine-distributed directions is 100 * 2 / 5.
    """
    lamp = PointLight(np.array([0.0, 0.0, 0.15]), np.array([1.0, 1.0, 1.0]))
    scene = scene_of(trimesh.creation.box((9, 9, 0.1)), lamp)
    result, _ = subsurface_exitance(
        scene, medium_of(0.5, 0.0, 1.0), *middle(-0.05, 64), paths=2048, seed=8
    )
    mean, sigma = total(result)
    assert (np.abs(mean - 40) < 4 * sigma).all()
    assert (sigma < 0.2).all()


# What comes with the mean


def test_walks_that_leave_through_a_hole_are_counted():
    points, normals = surface(BALL, 64)
    open_ball = BALL.copy()
    open_ball.update_faces(np.arange(len(BALL.faces)) % 10 > 0)
    for albedo, extinction in ((1, 0.0), (1, 3.0), (0.1, 3.0)):
        medium = medium_of(albedo, extinction, 1.0)
        scene = scene_of(open_ball, constant_sky())
        result, lost = subsurface_exitance(
            scene, medium, points, normals, paths=256, seed=9
        )
        assert 0.05 < lost < 0.2
        assert np.isfinite(result.mean).all()
        assert total(result)[0].max() < np.pi


def test_variance_is_that_of_the_mean():
    points, normals = middle(0.05, 5000)
    result, _ = subsurface_exitance(
        scene_of(SLAB, constant_sky()),
        medium_of((0.3, 0.6, 0.9), 10.0, 1.3),
        points,
        normals,
        paths=16,
        seed=10,
    )
    np.testing.assert_allclose(result.mean.var(0), result.variance.mean(0), rtol=0.1)


def test_seed_decides_and_chunks_are_joined(monkeypatch):
    points, normals = middle(0.05, 40)
    scene = scene_of(SLAB, constant_sky())

    def exitance(seed):
        medium = medium_of(0.5, 10.0, 1.3)
        return subsurface_exitance(scene, medium, points, normals, paths=32, seed=seed)

    one, _ = exitance(0)
    np.testing.assert_array_equal(one.mean, exitance(0)[0].mean)
    assert not np.array_equal(one.mean, exitance(1)[0].mean)
    monkeypatch.setattr(subsurface, "PATHS_PER_LAUNCH", 32 * 7)
    parts, _ = exitance(0)
    assert parts.mean.shape == parts.variance.shape == (40, 3)
    assert len(np.unique(parts.mean[:, 0])) > 30
    nothing = np.zeros((0, 3), np.float32)
    empty, lost = subsurface_exitance(
        scene, medium_of(0.5, 10.0, 1.3), nothing, nothing, paths=4, seed=0
    )
    assert empty.mean.shape == (0, 3)
    assert lost == 0

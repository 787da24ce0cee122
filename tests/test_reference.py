"""Closed forms that ray-traced ambient occlusion must reproduce."""

import numpy as np
import pytest
import trimesh
from rooms import UP, copies, floor, floor_and_wall, joined, solid

from ginn_jax import draws, reference
from ginn_jax.camera import Camera


def assert_mean(estimate, expected, slack=0.0):
    """The average over all points is `expected` within 5 of its standard deviations."""
    n = len(estimate.mean)
    sigma = np.sqrt(estimate.variance.astype(float).sum()) / n
    assert sigma > 0
    assert abs(estimate.mean.astype(float).mean() - expected) < 5 * sigma + slack


def segment(t):
    """Share of the unit disk with x > t: of cosine-weighted directions with d_x > t."""
    return (np.arccos(t) - t * np.sqrt(1 - t * t)) / np.pi


def test_lone_plane_is_open():
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3)).astype(np.float32)
    points[:, 1] = 0
    normals = np.tile(UP, (5000, 1))
    for r in (1e-3, 0.1, 100.0):
        result = reference.ambient_occlusion(
            floor(), points, normals, r, rays=64, seed=0
        )
        np.testing.assert_array_equal(result.mean, 1)
        np.testing.assert_array_equal(result.variance, 0)


def test_floor_of_a_closed_box_is_dark():
    box = trimesh.creation.box((1, 1, 1))
    points = np.random.default_rng(1).uniform(-0.499, 0.499, (5000, 3))
    points[:, 1] = -0.5
    normals = np.tile(UP, (5000, 1))
    result = reference.ambient_occlusion(
        solid(box), points.astype(np.float32), normals, 2.0, rays=64, seed=0
    )
    np.testing.assert_array_equal(result.mean, 0)


@pytest.mark.parametrize("shift", [0.0, 100.0])
def test_no_surface_hides_itself_at_the_least_radius(shift):
    """Coordinates round off the sphere by a share of the largest of them."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    mesh = solid(ball.apply_translation([shift] * 3))
    corner = mesh.vertices[mesh.faces].astype(np.float64)
    share = np.random.default_rng(0).dirichlet([1, 1, 1], len(corner))
    points = (share[:, :, None] * corner).sum(1).astype(np.float32)
    normals = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    radius = reference.LEAST_RADIUS * float(np.abs(mesh.vertices).max())
    given = mesh, points, normals, radius
    result = reference.ambient_occlusion(*given, rays=64, seed=0)
    np.testing.assert_array_equal(result.mean, 1)


def test_half_is_blocked_at_the_foot_of_a_wall():
    points, normals = copies((1e-5, 0, 0), 2000)
    scene = floor_and_wall(100)
    result = reference.ambient_occlusion(scene, points, normals, 10.0, rays=256, seed=3)
    assert_mean(result, 0.5)


@pytest.mark.parametrize("distance", [0.02, 0.05, 0.09])
def test_wall_within_a_radius(distance):
    points, normals = copies((-distance, 0, 0), 1000)
    result = reference.ambient_occlusion(
        floor_and_wall(1), points, normals, 0.1, rays=256, seed=4
    )
    assert_mean(result, 1 - segment(distance / 0.1))


@pytest.mark.parametrize("height", [0.02, 0.05, 0.09])
def test_ceiling_within_a_radius(height):
    """A ray at angle t meets a ceiling h above after h / cos t: (h/r)^2 stay open."""
    lid = floor()._replace(vertices=floor().vertices + height * UP)
    points, normals = copies((0, 0, 0), 1000)
    result = reference.ambient_occlusion(
        joined(floor(), lid), points, normals, 0.1, rays=256, seed=5
    )
    assert_mean(result, (height / 0.1) ** 2, slack=5e-4)


@pytest.mark.parametrize("rays", [2, 7, 16])
def test_variance_is_that_of_the_mean(rays):
    points, normals = copies((-0.02, 0, 0), 40_000)
    result = reference.ambient_occlusion(
        floor_and_wall(1), points, normals, 0.1, rays=rays, seed=6
    )
    assert result.mean.var() == pytest.approx(result.variance.mean(), rel=0.05)


def test_seed_decides_and_chunks_do_not(monkeypatch):
    points, normals = copies((-0.02, 0, 0), 3000)
    scene = reference.build_scene(floor_and_wall(1))

    def cast(count, seed, mesh=scene):
        return reference.ambient_occlusion(
            mesh, points[:count], normals[:count], 0.1, rays=16, seed=seed
        ).mean

    whole = cast(3000, 7)
    np.testing.assert_array_equal(whole, cast(3000, 7, mesh=floor_and_wall(1)))
    np.testing.assert_array_equal(whole[:1000], cast(1000, 7))
    monkeypatch.setattr(reference, "RAYS_PER_LAUNCH", 5000)
    np.testing.assert_array_equal(whole, cast(3000, 7))
    assert abs(np.corrcoef(whole, cast(3000, 8))[0, 1]) < 0.1
    assert abs(np.corrcoef(whole[1:], whole[:-1])[0, 1]) < 0.1


@pytest.mark.parametrize("axis", [0, 1, 2, (0, 1), (0, 2), (1, 2)])
def test_random_numbers_of_points_rays_and_seeds_are_independent(axis):
    """Averages over any of the three vary as much as those of independent numbers."""
    words = np.indices((1000, 16, 16), np.uint32)
    a, b = (word / 2**32 for word in draws.random_pair(*words))
    disk, checks = (a - 0.5) ** 2 + (b - 0.5) ** 2 < 0.1, (a * 64 % 2 < 1) ^ (b < 0.5)
    for event, p in [
        (a < 0.5, 0.5),
        (b < 0.1, 0.1),
        (disk, 0.1 * np.pi),
        (checks, 0.5),
    ]:
        mean = event.mean(axis)
        expected = p * (1 - p) * mean.size / event.size
        assert ((mean - p) ** 2).mean() / expected == pytest.approx(
            1, abs=5 * np.sqrt(2 / mean.size)
        )


def test_no_points_and_one_ray():
    nothing = np.zeros((0, 3), np.float32)
    result = reference.ambient_occlusion(floor(), nothing, nothing, 0.1, rays=4, seed=0)
    assert result.mean.shape == result.variance.shape == (0,)
    points, normals = copies((0, 0, 0), 5)
    one = reference.ambient_occlusion(floor(), points, normals, 0.1, rays=1, seed=0)
    assert np.isnan(one.variance).all()


def test_pixels_are_points():
    """AO of the pixels that see the foot of a wall is what its points have."""
    camera = Camera(
        (-0.04, 1.0, 0.0),
        (-0.04, 0.0, 0.0),
        up=(1.0, 0.0, 0.0),
        vertical_fov=1.0,
        width=40,
        height=40,
    )
    scene = reference.build_scene(floor_and_wall(2))
    buffer = reference.render_gbuffer(scene, camera)
    position, normal = buffer.position[buffer.mask], buffer.normal[buffer.mask]
    result = reference.ambient_occlusion(scene, position, normal, 0.1, rays=64, seed=9)
    assert_mean(result, 1 - segment(-position[:, 0] / 0.1).mean())


def test_callers_variant_is_put_back():
    import mitsuba

    reference.build_scene(floor())
    before = mitsuba.variant()
    mitsuba.set_variant("scalar_rgb")
    try:
        points, normals = copies((0, 0, 0), 2)
        reference.ambient_occlusion(floor(), points, normals, 0.1, rays=2, seed=0)
        assert mitsuba.variant() == "scalar_rgb"
    finally:
        mitsuba.set_variant(before)

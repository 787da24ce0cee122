"""What the pixels of a camera see."""

import numpy as np
import pytest
import trimesh
from rooms import joined, quad, solid

from ginn_jax import reference
from ginn_jax.camera import Camera, orbit_camera


def test_gbuffer_of_a_sphere():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    camera = orbit_camera(200.0, -40.0, 2.0, width=160, height=120)
    buffer = reference.render_gbuffer(solid(ball), camera)
    position, normal = buffer.position[buffer.mask], buffer.normal[buffer.mask]
    distance = np.linalg.norm(position, axis=1)
    assert distance.min() > 0.498
    assert distance.max() < 0.5 + 1e-6
    assert (normal * position).sum(1).min() > 0.49
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, rtol=1e-5)
    assert ((np.array(camera.origin) - position) * normal).sum(1).min() > 0
    focal = 60 / np.tan(np.radians(35 / 2))
    silhouette = np.pi * (focal * 0.5) ** 2 / (2.0**2 - 0.5**2)
    assert buffer.mask.sum() == pytest.approx(silhouette, rel=0.01)
    for image in buffer[:3]:
        assert not image[~buffer.mask].any()


def test_gbuffer_pixels_are_where_the_camera_points():
    """The plane z = 0 from (0, 0, 3): each pixel's position is known exactly."""
    right = quad((0.5, -9, 0), (9, 0, 0), (0, 18, 0), 1)
    left = quad((-9, -9, 0), (0, 18, 0), (9.5, 0, 0))  # wound the other way round
    camera = Camera(
        (0.0, 0.0, 3.0), (0.0, 0.0, 0.0), vertical_fov=90.0, width=64, height=48
    )
    buffer = reference.render_gbuffer(joined(left, right), camera)
    assert buffer.mask.all()
    for row, column in [(0, 0), (0, 63), (47, 0), (20, 50)]:
        x = 3 * (column + 0.5 - 32) / 24
        y = 3 * (24 - row - 0.5) / 24
        np.testing.assert_allclose(buffer.position[row, column], (x, y, 0), atol=1e-5)
        assert buffer.material[row, column] == (x > 0.5)
    np.testing.assert_allclose(buffer.normal, np.broadcast_to([0, 0, 1], (48, 64, 3)))

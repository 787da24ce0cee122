"""Screen-space occlusion: planes and corners of known openness, and what it misses."""

import numpy as np
import pytest
import seen
from hypothesis import given, settings
from hypothesis import strategies as st

from ginn_jax.camera import orbit_camera
from ginn_jax.errors import InputError
from ginn_jax.mesh import Mesh
from ginn_jax.reference import ambient_occlusion as traced
from ginn_jax.screen_occlusion import ambient_occlusion, bitmask_occlusion

pytestmark = pytest.mark.usefixtures("cheap_compiling")

SIZE = 48
METHODS = pytest.mark.parametrize("method", [ambient_occlusion, bitmask_occlusion])


def openness(method, scene, radius, **options):
    given = {"radius": radius} | options
    return np.asarray(
        seen.compiled(method, scene.camera, *given.items())(*scene.surface)
    )


@METHODS
@settings(max_examples=4)
@given(st.floats(0, 360), st.floats(10, 85), st.floats(0.02, 0.5))
def test_a_lone_plane_is_open(method, azimuth, elevation, radius):
    camera = orbit_camera(azimuth, elevation, width=SIZE, height=SIZE)
    found = openness(method, seen.see(camera, seen.FLOOR), radius)
    np.testing.assert_allclose(found, 1, atol=0.02)


def corner_openness(distance, radius):
    """Openness beside an endless wall, by the part of it within the radius.

    Rays toward the wall at an angle with cosine c across it meet it after distance / c.
    """
    theta, phi = np.meshgrid(
        (np.arange(400) + 0.5) / 400 * np.pi / 2,
        (np.arange(800) + 0.5) / 800 * 2 * np.pi,
    )
    weight = np.sin(2 * theta).ravel()
    reach = (np.sin(theta) * np.cos(phi) * radius).ravel()
    order = reach.argsort()
    free = np.concatenate([[0], np.cumsum(weight[order])])
    return free[np.searchsorted(reach[order], distance, "right")] / weight.sum()


@METHODS
@pytest.mark.parametrize("azimuth", [0.0, 40.0])
def test_a_corner_is_as_open_as_its_closed_form(method, azimuth):
    scene = seen.corner(SIZE, azimuth)
    found = openness(method, scene, 0.5)
    distance = np.where(scene.part == 0, scene.position[..., 2], scene.position[..., 1])
    error = found - corner_openness(distance.ravel(), 0.5).reshape(found.shape)
    inner = np.zeros_like(scene.mask)
    inner[6:-6, 6:-6] = True
    assert np.abs(error[inner]).mean() < 0.025
    assert abs(error[inner].mean()) < 0.015


@METHODS
def test_background_is_open_and_does_not_count(method):
    """A box before nothing: nothing is in the way of its faces, nothing is NaN."""
    camera = orbit_camera(35.0, width=SIZE, height=SIZE)
    scene = seen.see(camera, ((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3)))
    found = openness(method, scene, 0.2)
    assert (found[~scene.mask] == 1).all()
    assert found[scene.mask].mean() > 0.99
    assert (found[scene.mask] > 0.97).mean() > 0.96  # a few at outlines are not
    nonsense = np.where(scene.mask[..., None], scene.position, np.nan)
    again = openness(method, scene._replace(position=nonsense), 0.2)
    np.testing.assert_array_equal(found, again)


@METHODS
def test_a_thing_far_before_the_floor_does_not_darken_it(method):
    camera = orbit_camera(0.0, 80.0, 2.2, width=SIZE, height=SIZE)
    floor = seen.see(camera, seen.FLOOR)
    both = seen.see(camera, seen.FLOOR, ((-0.1, 0.8, -0.1), (0.1, 0.9, 0.1)))
    found = openness(method, both, 0.2)
    assert (both.part != floor.part).sum() > 20
    np.testing.assert_allclose(found[both.part == 0], 1, atol=0.02)


@METHODS
def test_what_the_camera_does_not_see_is_missed(method):
    """A wall just out of view: rays find it, the screen cannot."""
    camera = orbit_camera(0.0, 60.0, 2.2, width=SIZE, height=SIZE)
    right = seen.see(camera, seen.FLOOR).position[..., 0].max()
    edge = np.float32(right + 0.01)
    scene = seen.see(camera, seen.FLOOR, ((float(edge), 0.0, -5.0), (5.0, 3.0, 5.0)))
    beside = scene.mask & (scene.part == 0) & (scene.position[..., 0] > edge - 0.15)
    walls = np.array([[edge, 0, -5], [edge, 3, -5], [edge, 3, 5], [edge, 0, 5]])
    wall = Mesh(
        walls.astype(np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.zeros(2, np.int32),
    )
    hidden = beside & ~np.isin(scene.part, [1])
    point = scene.position[hidden], scene.normal[hidden]
    truth = traced(wall, *point, 0.5, rays=256, seed=0).mean
    found = openness(method, scene, 0.5)[hidden]
    assert hidden.any()
    assert truth.mean() < 0.9
    assert found.mean() > 0.95


@METHODS
def test_the_same_image_gives_the_same_under_jit(method):
    scene = seen.corner(24)
    eager = method(*scene.surface, scene.camera, 0.3)
    np.testing.assert_allclose(eager, openness(method, scene, 0.3), atol=0.04)


@METHODS
@pytest.mark.parametrize(
    "options",
    [
        {"radius": 0.0},
        {"radius": "a"},
        {"radius": np.inf},
        {"steps": 0},
        {"steps": 2.5},
        {"directions": 0},
        {"thickness": -1.0},
    ],
)
def test_bad_arguments_are_refused(method, options, unchecked):
    scene = seen.corner(8)
    with pytest.raises(InputError):
        method(*scene.surface, scene.camera, **({"radius": 0.1} | options))


@pytest.mark.parametrize("bias", [np.nan, np.inf, -0.1])
def test_a_bias_that_is_none_is_refused(bias):
    scene = seen.corner(8)
    with pytest.raises(InputError, match="bias"):
        ambient_occlusion(*scene.surface, scene.camera, 0.1, bias=bias)


@METHODS
@pytest.mark.parametrize("kind", [np.float32, np.int32])
def test_a_mask_of_numbers_is_refused(method, kind, unchecked):
    position, normal, mask = seen.corner(8).surface
    with pytest.raises(InputError, match=r"mask is (float|int)32: give bool"):
        method(position, normal, mask.astype(kind), seen.corner(8).camera, 0.1)


@METHODS
def test_an_image_of_another_camera_is_refused(method):
    scene = seen.corner(8)
    with pytest.raises(InputError, match="camera"):
        method(*scene.surface, orbit_camera(width=9, height=8), 0.1)


def test_a_slice_has_two_directions():
    scene = seen.corner(8)
    with pytest.raises(InputError, match="even"):
        bitmask_occlusion(*scene.surface, scene.camera, 0.1, directions=3)

"""One bounce on the screen: against the integral, blocked, and what it misses."""

from contextlib import nullcontext

import jax
import numpy as np
import pytest
import seen
import tiny
from hypothesis import given, settings
from hypothesis import strategies as st

from ginn_jax.camera import orbit_camera
from ginn_jax.errors import InputError
from ginn_jax.screen_bounce import bitmask_irradiance, indirect_irradiance

SIZE = 48
COLOR = np.array([1.0, 0.5, 0.0], np.float32)
WHOLE = {"window": 2 * SIZE, "samples": 2 * SIZE, "back": 0.0}
METHODS = pytest.mark.parametrize(
    ("method", "options"),
    [(indirect_irradiance, WHOLE), (bitmask_irradiance, {"back": 0.0})],
    ids=["window", "bitmask"],
)


def bounced(method, scene, exitance, options):
    run = seen.compiled(method, scene.camera, *options.items())
    # The window's 10^4 pairs a pixel take longer than to compile them well.
    brief = method is bitmask_irradiance
    with tiny.cheap_compiling() if brief else nullcontext():
        return np.asarray(run(*scene.surface, exitance))


def sent(scene, part, color=COLOR):
    """Exitance of one part of a scene."""
    return np.where((scene.part == part)[..., None], color, 0).astype(np.float32)


def integral(scene, receivers, senders):
    """Form factors to what is seen, in float64, without occlusion.

    A pixel sees as much surface as the plane of its part has between its corners.
    """
    camera = scene.camera
    focal = camera.height / 2 / np.tan(np.radians(camera.vertical_fov) / 2)
    forward = np.subtract(camera.target, camera.origin)
    forward /= np.linalg.norm(forward)
    place, normal = (a.astype(np.float64) for a in scene.surface[:2])
    ray = place - camera.origin
    depth = ray @ forward
    area = depth**3 / focal**2 / np.abs((ray * normal).sum(-1))
    way = place[senders] - place[receivers][:, None]
    leaving = np.maximum(-(way * normal[senders]).sum(-1), 0)
    arriving = np.maximum((way * normal[receivers][:, None]).sum(-1), 0)
    factor = leaving * arriving / (np.pi * (way**2).sum(-1) ** 2)
    return (factor * area[senders]).sum(1)


@METHODS
@pytest.mark.parametrize("azimuth", [0.0, 40.0])
def test_a_lit_wall_bleeds_on_the_floor_as_much_as_the_integral(
    method, options, azimuth
):
    scene = seen.corner(SIZE, azimuth)
    found = bounced(method, scene, sent(scene, 1), options)
    floor = (scene.part == 0) & (scene.position[..., 2] > 0.1)
    truth = integral(scene, floor, scene.part == 1)
    np.testing.assert_allclose(found[floor], truth[:, None] * COLOR, atol=0.04)
    np.testing.assert_allclose(found[floor].mean(0), truth.mean() * COLOR, rtol=0.04)
    assert truth.mean() > 0.1
    assert np.abs(found[scene.part == 1]).max() < 1e-6


def test_a_small_window_gathers_less_but_the_same_next_to_the_wall():
    scene = seen.corner(SIZE)
    light = sent(scene, 1)
    whole = bounced(indirect_irradiance, scene, light, WHOLE)[..., 0]
    options = {"window": 20, "samples": 20, "back": 0.0}
    part = bounced(indirect_irradiance, scene, light, options)[..., 0]
    assert (part <= whole + 1e-5).all()
    assert part.sum() < 0.9 * whole.sum()
    near = (scene.part == 0) & (scene.position[..., 2] < 0.04)
    assert part[near].mean() > 0.7 * whole[near].mean() > 0.2


@METHODS
def test_fewer_samples_stand_for_more_area(method, options):
    scene = seen.corner(SIZE)
    fewer = {"samples": 45} if method is indirect_irradiance else {"directions": 8}
    light = sent(scene, 1)
    floor = scene.part == 0
    found = [
        bounced(method, scene, light, o)[floor].mean(0)[:2]
        for o in (options, options | fewer)
    ]
    np.testing.assert_allclose(*found, rtol=0.1)


@METHODS
@settings(max_examples=5)
@given(st.floats(0, 100), st.integers(0, 2**16))
def test_it_is_linear_in_light(method, options, factor, seed):
    scene = seen.corner(16)
    first, second = np.random.default_rng(seed).random((2, 16, 16, 3), np.float32)
    factor = np.float32(factor)
    both, one, other = (
        bounced(method, scene, light, options | {"thickness": 0.1})
        for light in (first + factor * second, first, second)
    )
    np.testing.assert_allclose(both, one + factor * other, rtol=1e-4, atol=1e-4)


@METHODS
def test_no_light_gives_none_and_background_never_counts(method, options):
    camera = orbit_camera(35.0, width=SIZE, height=SIZE)
    box = ((-0.3, -0.4, -0.3), (0.3, 0.3, 0.3))
    ground = ((-0.5, -0.5, -0.5), (0.5, -0.4, 0.5))
    scene = seen.see(camera, ground, box)
    assert not scene.mask.all()
    assert not bounced(method, scene, sent(scene, 5), options).any()
    light = sent(scene, 1)
    found = bounced(method, scene, light, options)
    assert not found[~scene.mask].any()
    assert found[scene.part == 0].max() > 0.05
    light = np.where(scene.mask[..., None], light, np.nan)
    nonsense = np.where(scene.mask[..., None], scene.position, np.nan)
    again = bounced(method, scene._replace(position=nonsense), light, options)
    np.testing.assert_array_equal(found, again)


@METHODS
def test_what_stands_between_blocks(method, options):
    camera = orbit_camera(90.0, 60.0, 2.2, width=SIZE, height=SIZE)
    lamp = ((-0.5, 0.0, -0.6), (-0.3, 0.4, 0.6))
    screen = ((-0.1, 0.0, -0.6), (0.0, 0.4, 0.6))
    free = seen.see(camera, seen.FLOOR, lamp)
    shut = seen.see(camera, seen.FLOOR, lamp, screen)
    x, z = shut.position[..., 0], shut.position[..., 2]
    shadow = (shut.part == 0) & (x > 0) & (x < 0.2) & (abs(z) < 0.2)
    options = options | {"thickness": 0.3}
    open_light = bounced(method, free, sent(free, 1), options)[shadow, 0]
    left = bounced(method, shut, sent(shut, 1), options)[shadow, 0]
    assert open_light.mean() > 0.05
    assert left.mean() < 0.15 * open_light.mean()


@METHODS
def test_a_back_sends_the_share_it_is_taken_to_send(method, options):
    """The camera sees the outside of a panel; the floor behind it its inside."""
    camera = orbit_camera(0.0, 50.0, 2.2, width=SIZE, height=SIZE)
    panel = ((-0.6, 0.0, 0.2), (0.6, 0.15, 0.25))
    scene = seen.see(camera, seen.FLOOR, panel)
    z = scene.position[..., 2]
    behind = (scene.part == 0) & (z < 0.05) & (z > -0.2)
    none, half, full = (
        bounced(method, scene, sent(scene, 1), options | {"back": b})[behind, 0].mean()
        for b in (0.0, 0.5, 1.0)
    )
    assert none < 0.3 * full
    np.testing.assert_allclose(half - none, full - half, rtol=1e-3)


@METHODS
def test_a_wall_out_of_view_sends_nothing(method, options):
    """An endless wall at right angles would send half of its exitance."""
    camera = orbit_camera(0.0, 80.0, 1.0, width=SIZE, height=SIZE)
    top = seen.see(camera, seen.FLOOR).position[..., 2].min()
    wall = ((-5.0, 0.0, -2.0), (5.0, 0.2, float(top) - 0.05))
    scene = seen.see(camera, seen.FLOOR, wall)
    assert (scene.part == 0).all()
    truth = integral_of_strip(scene.position[..., 2] - wall[1][2], 0.2)
    assert truth.max() > 0.15
    # A plane that sends light sends itself none.
    lit = sent(scene, 0)
    assert lit[scene.mask, 0].min() > 0
    assert np.abs(bounced(method, scene, lit, options)).max() < 1e-5


def integral_of_strip(distance, height):
    """Form factor of a wall of this height along the whole floor."""
    return (1 - distance / np.hypot(distance, height)) / 2


def test_the_defaults_run_under_jit_on_an_image_smaller_than_the_window():
    scene = seen.corner(16)
    light = sent(scene, 1)
    for method in (indirect_irradiance, bitmask_irradiance):
        found = jax.jit(method, static_argnums=4)(*scene.surface, light, scene.camera)
        assert np.isfinite(found).all()
        assert found[scene.part == 0].max() > 0.1


@pytest.mark.parametrize("options", [{"window": 0}, {"samples": 0}, {"thickness": 0.0}])
def test_bad_arguments_of_the_window_are_refused(options):
    scene = seen.corner(8)
    with pytest.raises(InputError):
        bounced(indirect_irradiance, scene, sent(scene, 1), options)


@METHODS
@pytest.mark.parametrize("back", [np.nan, -0.1, 1.5])
def test_a_back_that_sends_no_share_is_refused(method, options, back):
    scene = seen.corner(8)
    with pytest.raises(InputError, match="back"):
        bounced(method, scene, sent(scene, 1), options | {"back": back})


@pytest.mark.parametrize(
    "options", [{"directions": 3}, {"steps": 0}, {"radius": 0.0}, {"radius": np.inf}]
)
def test_bad_arguments_of_the_bitmask_are_refused(options):
    scene = seen.corner(8)
    with pytest.raises(InputError):
        bounced(bitmask_irradiance, scene, sent(scene, 1), options)


def test_light_of_another_image_is_refused(unchecked):
    scene = seen.corner(8)
    with pytest.raises(InputError, match="exitance"):
        bounced(bitmask_irradiance, scene, np.zeros((8, 9, 3), np.float32), {})

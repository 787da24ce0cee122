"""Blurred irradiance: what it must keep, how wide it is, and what it misses."""

import jax
import numpy as np
import pytest
import seen
from hypothesis import given, settings
from hypothesis import strategies as st

from ginn_jax.camera import orbit_camera
from ginn_jax.errors import InputError
from ginn_jax.irradiance import direct_irradiance, light_scene
from ginn_jax.lighting import PointLight
from ginn_jax.mesh import Mesh
from ginn_jax.screen_scattering import radiant_exitance
from ginn_jax.slab import external_reflectance
from ginn_jax.subsurface import Medium, subsurface_exitance

pytestmark = pytest.mark.usefixtures("cheap_compiling")

SIZE = 48
ALBEDO = np.array([0.9, 0.5, 0.2], np.float32)
ABOVE = orbit_camera(0.0, 89.0, 2.2, width=SIZE, height=SIZE)


def scattered(scene, light, extinction=20.0, ior=1.0, **options):
    given = {"extinction": extinction, "ior": ior} | options
    run = seen.compiled(of_albedo, scene.camera, *given.items())
    return np.asarray(run(*scene.surface, light))


def of_albedo(*images, **options):
    return radiant_exitance(*images, albedo=ALBEDO, **options)


def even(scene, value=2.0):
    return np.full((*scene.mask.shape, 3), value, np.float32)


@settings(max_examples=6)
@given(st.floats(0, 360), st.floats(10, 85), st.floats(1, 300), st.floats(1, 1.5))
def test_an_even_plane_gives_its_albedo(azimuth, elevation, extinction, ior):
    camera = orbit_camera(azimuth, elevation, width=SIZE, height=SIZE)
    scene = seen.see(camera, seen.FLOOR)
    entered = 1 - external_reflectance(ior) if ior > 1 else 1
    found = scattered(scene, even(scene), extinction, ior)
    np.testing.assert_allclose(
        found[scene.mask],
        np.broadcast_to(2 * entered * ALBEDO, found[scene.mask].shape),
        rtol=1e-4,
    )


@settings(max_examples=8)
@given(st.integers(0, 2**16), st.floats(2, 300), st.floats(0, 50))
def test_it_is_linear_and_stays_below_the_brightest(seed, extinction, factor):
    scene = seen.corner(SIZE, 40.0)
    first, second = np.random.default_rng(seed).random((2, SIZE, SIZE, 3), np.float32)
    factor = np.float32(factor)
    both, one, other = (
        scattered(scene, light, extinction)
        for light in (first + factor * second, first, second)
    )
    np.testing.assert_allclose(both, one + factor * other, rtol=1e-4, atol=1e-4)
    assert (one >= 0).all()
    assert (one <= ALBEDO * (1 + 1e-5)).all()


def spot(scene, width=0.04):
    """Light on a disk in the middle of what is seen."""
    near = np.hypot(scene.position[..., 0], scene.position[..., 2]) < width
    return np.where((near & scene.mask)[..., None], 1.0, 0).astype(
        np.float32
    ) * np.ones(3, np.float32)


def spread(scene, image):
    """Mean squared distance from the middle, of each channel."""
    square = scene.position[..., 0] ** 2 + scene.position[..., 2] ** 2
    return (image * square[..., None]).sum((0, 1)) / image.sum((0, 1))


def test_energy_stays_and_width_follows_the_mean_free_path():
    scene = seen.see(ABOVE, seen.FLOOR)
    light = spot(scene)
    widths = []
    for extinction in (30.0, 60.0, 120.0):
        found = scattered(scene, light, extinction, widening=1.0)
        total = found.sum((0, 1)) / (ALBEDO * light.sum((0, 1)))
        assert (total < 1.02).all()
        assert (total > 0.9).all()
        widths.append(spread(scene, found))
    assert (widths[0] > widths[1]).all()
    assert (widths[1] > widths[2]).all()
    assert (widths[2] > spread(scene, light)).all()


def test_a_spot_spreads_as_normalised_diffusion():
    """Energy within a distance of a small spot, against the profile's integral."""
    scene = seen.see(ABOVE, seen.FLOOR)
    extinction = 10.0
    light = spot(scene, 0.025)
    found = scattered(scene, light, extinction, widening=1.0) / ALBEDO
    length = 1 / extinction / np.array([1.035, 1.715, 2.96])  # of these albedos
    distance = np.hypot(scene.position[..., 0], scene.position[..., 2])
    for radius in (0.1, 0.2):
        within = found[distance < radius].sum(0) / light.sum((0, 1))
        r = radius / length
        truth = 1 - np.exp(-r) / 4 - 3 / 4 * np.exp(-r / 3)
        np.testing.assert_allclose(within, truth, atol=0.05)


def test_nothing_bleeds_over_a_gap_in_depth():
    high = ((-5.0, 0.3, -5.0), (0.0, 0.4, 5.0))
    scene = seen.see(ABOVE, seen.FLOOR, high)
    light = even(scene) * (scene.part == 1)[..., None]
    found = scattered(scene, light, 100.0, widening=1.0)
    assert found[scene.part == 0].max() < 1e-3
    ratio = found[scene.part == 1] / (2 * ALBEDO)
    np.testing.assert_allclose(ratio, np.ones_like(ratio), rtol=2e-2)


def test_background_never_counts():
    camera = orbit_camera(35.0, width=SIZE, height=SIZE)
    scene = seen.see(camera, ((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3)))
    light = np.random.default_rng(0).random((SIZE, SIZE, 3), np.float32)
    light = np.where(scene.mask[..., None], light, 0)
    found = scattered(scene, light)
    assert not found[~scene.mask].any()
    assert found[scene.mask].min() > 0
    nonsense = [
        np.where(scene.mask[..., None], a, np.nan) for a in (scene.position, light)
    ]
    poisoned = scene._replace(position=nonsense[0])
    np.testing.assert_array_equal(found, scattered(poisoned, nonsense[1]))


def test_an_edge_before_nothing_is_not_darkened():
    """The plate lies at depth 1, where the background is put."""
    camera = orbit_camera(0.0, 1e-3, 1.0, width=SIZE, height=SIZE)
    scene = seen.see(camera, ((-0.2, -0.2, -0.1), (0.2, 0.2, 0.0)))
    found = scattered(scene, even(scene)) / (2 * ALBEDO)
    np.testing.assert_allclose(found, scene.mask[..., None] * np.ones(3), rtol=1e-4)


def box(low, high):
    """The surface of a box, outward."""
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij"))
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    vertices = corners.reshape(3, -1).T.astype(np.float32)
    return Mesh(vertices, np.array(faces, np.int32), np.zeros(12, np.int32))


def test_light_through_a_sheet_is_missed():
    """A lamp behind a thin sheet: it glows, and the screen knows of no light."""
    ends = (-0.5, -0.5, -0.02), (0.5, 0.5, 0.02)
    camera = orbit_camera(0.0, 10.0, width=24, height=24)
    scene = seen.see(camera, ends)
    front = scene.normal[..., 2] > 0.5
    lit = light_scene(
        box(*ends), ALBEDO[None], PointLight(np.array([0, 0, -1.0]), np.ones(3))
    )
    points = scene.position[front], scene.normal[front]
    light = np.zeros((24, 24, 3), np.float32)
    light[front] = direct_irradiance(lit, *points, looks=4, seed=0)
    medium = Medium(ALBEDO, 20.0, 1.0)
    truth = subsurface_exitance(lit, medium, *points, paths=64, seed=0)[0].mean
    assert truth.mean() > 0.05
    assert not light.any()
    assert not scattered(scene, light).any()


def test_the_same_image_gives_the_same_under_jit():
    scene = seen.corner(24)
    light = np.random.default_rng(0).random((24, 24, 3), np.float32)

    @jax.jit
    def compiled(position, normal, mask, light):
        return scattered_raw(position, normal, mask, light, scene.camera)

    def scattered_raw(*ends):
        return radiant_exitance(*ends, albedo=ALBEDO, extinction=20.0, ior=1.3)

    eager = scattered_raw(*scene.surface, light, scene.camera)
    np.testing.assert_allclose(compiled(*scene.surface, light), eager, atol=1e-4)


@pytest.mark.parametrize(
    "options",
    [
        {"extinction": 0.0},
        {"extinction": np.inf},
        {"ior": 0.5},
        {"ior": np.nan},
        {"taps": 0},
        {"taps": 2.5},
        {"widening": -1.0},
        {"albedo": (0.5, 2.0, 0.5)},
        {"albedo": (0.5, np.nan, 0.5)},
    ],
)
def test_bad_arguments_are_refused(options, unchecked):
    scene = seen.corner(8)
    given = {"albedo": ALBEDO, "extinction": 20.0, "ior": 1.3} | options
    with pytest.raises(InputError, match=next(iter(options))):
        radiant_exitance(*scene.surface, even(scene), scene.camera, **given)

"""Environment maps made from a seed, and the irradiance that maps cause."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from strategies import SEEDS

from ginn_jax import lighting
from ginn_jax.lighting import (
    EnvironmentMap,
    constant_sky,
    irradiance_of,
    pixel_directions,
    procedural_environment,
    studio,
    sun_and_sky,
    turned,
)

RADIANCE = st.floats(0, 1e5, width=32)


def unit(*vector):
    return np.array(vector) / np.linalg.norm(vector)


@st.composite
def normals(draw):
    height = draw(st.floats(-1, 1))
    around = draw(st.floats(0, 2 * np.pi))
    level = np.sqrt(1 - height**2)
    return np.array([level * np.sin(around), height, level * np.cos(around)])


@st.composite
def maps(draw, height=16):
    """[height, 2 height, 3]: blocks of any radiance, dark or with suns."""
    blocks = draw(hnp.arrays(np.float32, (4, 8, 3), elements=RADIANCE))
    return EnvironmentMap(blocks.repeat(height // 4, 0).repeat(height // 4, 1))


# Irradiance


@given(normals(), st.floats(0.125, 1e4))
def test_constant_sky_gives_pi_times_its_radiance(normal, radiance):
    found = irradiance_of(constant_sky(radiance), normal)
    np.testing.assert_allclose(found, np.pi * radiance, rtol=1e-4)


@given(normals(), maps(), maps())
def test_irradiance_adds_up_and_is_not_negative(normal, one, two):
    both = EnvironmentMap(one.radiance.astype(float) + two.radiance)
    parts = [irradiance_of(light, normal) for light in (one, two)]
    assert np.min(parts) >= 0
    np.testing.assert_allclose(irradiance_of(both, normal), sum(parts), rtol=1e-6)


@given(maps(), st.integers(0, 31), st.integers(-32, 64))
def test_turned_map_lights_what_is_turned_along(light, start, columns):
    """Turned by columns, so that the pixels of both maps have the same directions."""
    share = columns / 32
    toward = pixel_directions(16)[5]
    before, after = toward[start], toward[(start + columns) % 32]
    np.testing.assert_allclose(
        irradiance_of(turned(light, share), after),
        irradiance_of(light, before),
        rtol=1e-5,
        atol=1e-6,
    )
    rest = turned(turned(light, share), -share)
    np.testing.assert_array_equal(rest.radiance, light.radiance)


def test_directions_are_unit_vectors_that_cover_the_sphere():
    toward = pixel_directions(64)
    np.testing.assert_allclose(np.linalg.norm(toward, axis=2), 1)
    assert (toward[:32, :, 1] > 0).all()
    assert (toward[32:, :, 1] < 0).all()
    # Column 0 looks to -z, a quarter of the width on to +x.
    np.testing.assert_allclose(toward[31, 0], [0, 0, -1], atol=0.1)
    np.testing.assert_allclose(toward[31, 32], [1, 0, 0], atol=0.1)


# Procedural ones


@pytest.fixture
def coarse(monkeypatch):
    """Maps of 32 rows, made in no time."""
    monkeypatch.setattr(lighting, "HEIGHT", 32)


def test_forty_seeds_give_forty_lights(coarse):
    """At 32 rows suns are missed, which leaves the skies less to differ by."""
    maps = [procedural_environment(seed).radiance for seed in range(40)]
    for radiance in maps:
        assert radiance.shape == (32, 64, 3)
        assert radiance.dtype == np.float32
        assert np.isfinite(radiance).all()
        assert 0 <= radiance.min() < radiance.max()
    # Neither are they multiples of each other.
    means = np.array([m.mean() for m in maps])
    flat = np.array([m.ravel() / m.mean() for m in maps])
    difference = np.abs(flat[:, None] - flat[None]).mean(axis=2)
    assert (difference + np.eye(40) > 1e-3).all()
    assert len(np.unique(means)) == 40


def test_seed_decides(coarse):
    for seed in range(8):
        one, two = (procedural_environment(seed).radiance for _ in range(2))
        np.testing.assert_array_equal(one, two)


@given(SEEDS)
def test_studios_are_lit(seed):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lighting, "HEIGHT", 32)
        radiance = studio(seed).radiance
    assert np.isfinite(radiance).all()
    assert radiance.min() > 0
    assert radiance.max() > 1.2 * radiance.min()


@pytest.mark.parametrize(
    "direction",
    [unit(0, 0.5, 0.8), unit(1, 0.2, 0), unit(-0.6, 0.3, -0.4), unit(0.3, 2, -0.5)],
)
def test_sun_is_where_it_is_asked_to_be(direction):
    """The brightest pixel, and the middle of all that are far brighter than the sky."""
    light = sun_and_sky(3.0, direction).radiance.sum(axis=2)
    dark = sun_and_sky(3.0, direction, sun_scale=0.0).radiance.sum(axis=2)
    toward = pixel_directions(lighting.HEIGHT)
    brightest = toward.reshape(-1, 3)[light.argmax()]
    assert np.degrees(np.arccos(brightest @ direction)) < 1
    assert light.max() > 500 * np.median(light)
    assert dark.max() < 0.01 * light.max()
    sun = np.where(light > 0.01 * light.max(), light, 0)[..., None]
    middle = (sun * toward).sum(axis=(0, 1))
    assert np.degrees(np.arccos(unit(*middle) @ direction)) < 0.5


def test_below_the_horizon_lies_ground_of_its_albedo():
    light = sun_and_sky(4.0, unit(0, 1, 1)).radiance
    ground = light[lighting.HEIGHT // 2 :]
    np.testing.assert_array_equal(ground, np.broadcast_to(ground[0, 0], ground.shape))
    arrives = irradiance_of(EnvironmentMap(light), unit(0, 1, 0))
    np.testing.assert_allclose(ground[0, 0], 0.3 * arrives / np.pi, rtol=1e-3)


def test_sky_is_all_above_the_horizon():
    """All around, in the lowest row too; and without a sun as bright on both sides."""
    sky = sun_and_sky(4.0, unit(1, 1, 0), sun_scale=0.0).radiance
    upper = sky[: lighting.HEIGHT // 2]
    assert upper.min() > 0.01 * upper.max()
    # Mirrored in the plane of the sun, z = 0: direction phi against pi - phi.
    mirrored = upper[:, (lighting.HEIGHT - 1 - np.arange(512)) % 512]
    np.testing.assert_allclose(mirrored, upper, rtol=1e-3)

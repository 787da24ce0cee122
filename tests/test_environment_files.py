"""Environment maps from files and arrays."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ginn_jax import lighting
from ginn_jax.lighting import (
    EnvironmentMap,
    find_environments,
    irradiance_of,
    load_environment,
    make_environment,
)
from ginn_jax.renderer import use_mitsuba

ASSETS = Path(__file__).parents[2] / "shared" / "assets" / "envmaps"


def dim_with_sun(height):
    """Random dim radiance, and a pixel of 1e5."""
    rng = np.random.default_rng(height)
    pixels = rng.uniform(0, 2, (height, 2 * height, 3)).astype(np.float32)
    pixels[height // 5, height // 3] = 1e5
    return pixels


def write(path, pixels):
    use_mitsuba()[0].Bitmap(pixels).write(str(path))
    return path


@pytest.mark.parametrize("ending", lighting.ENDINGS)
def test_file_comes_back(tmp_path, ending):
    """RGBE keeps 8 bits of the largest colour of a pixel, the others all."""
    pixels = dim_with_sun(64)
    found = load_environment(write(tmp_path / f"a{ending}", pixels)).radiance
    assert found.dtype == np.float32
    assert found.shape == pixels.shape
    if ending == ".hdr":
        rounding = pixels.max(axis=2, keepdims=True) / 128
        assert (np.abs(found - pixels) <= rounding).all()
    else:
        np.testing.assert_array_equal(found, pixels)


def over_the_sphere(radiance):
    """The mean over all directions, a row by the solid angle of its band."""
    edges = np.cos(np.linspace(0, np.pi, len(radiance) + 1))
    return -np.diff(edges) @ radiance.mean(axis=1, dtype=float) / 2


def test_a_sun_overhead_is_averaged_down_by_what_it_covers():
    pixels = np.zeros((1024, 64, 3), np.float32)
    pixels[0, 7] = 1e5
    light = make_environment(pixels)
    assert light.radiance.shape == (256, 16, 3)
    sun = over_the_sphere(pixels)
    np.testing.assert_allclose(over_the_sphere(light.radiance), sun, rtol=1e-5)
    # A quarter of the width, and of the cap, which goes with the square of its angle, a
    # sixteenth.
    assert light.radiance.max() == pytest.approx(1e5 / 4 / 16, rel=1e-3)


@pytest.mark.parametrize("ending", [".hdr", ".exr"])
def test_large_file_is_averaged_down_and_keeps_irradiance(tmp_path, ending):
    pixels = dim_with_sun(512)
    light = load_environment(write(tmp_path / f"a{ending}", pixels))
    assert light.radiance.shape == (256, 512, 3)
    rounding = 1e-2 if ending == ".hdr" else 1e-5
    whole = over_the_sphere(pixels)
    np.testing.assert_allclose(over_the_sphere(light.radiance), whole, rtol=rounding)
    for toward in ((0, 1, 0), (1, 2, -3), (-1, -0.2, 0.3)):
        normal = np.array(toward) / np.linalg.norm(toward)
        before = irradiance_of(EnvironmentMap(pixels), normal)
        after = irradiance_of(light, normal)
        np.testing.assert_allclose(after, before, rtol=max(rounding, 5e-3))


def test_grey_file_has_three_equal_channels(tmp_path):
    pixels = dim_with_sun(16)[..., :1]
    found = load_environment(write(tmp_path / "grey.exr", pixels)).radiance
    np.testing.assert_allclose(found, np.broadcast_to(pixels, (16, 32, 3)), rtol=1e-5)


@settings(max_examples=15)
@given(st.integers(1, 40), st.integers(1, 80), st.data())
def test_any_size_is_averaged_to_at_most_the_height(height, width, data):
    """The mean over all directions stays, and what is even stays even."""
    elements = {"elements": st.sampled_from([0, 0.5, 1, 1e5]), "fill": st.just(1)}
    pixels = data.draw(hnp.arrays(np.float32, (height, width, 3), **elements))
    pixels[0, 0] = 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lighting, "HEIGHT", 8)
        light = make_environment(pixels).radiance
        even = make_environment(np.full_like(pixels, 3)).radiance
    assert light.shape[0] == min(height, 8)
    if width == 2 * height:
        assert light.shape[1] == 2 * light.shape[0]
    whole = over_the_sphere(pixels)
    np.testing.assert_allclose(over_the_sphere(light), whole, rtol=1e-5)
    assert light.min() >= 0
    np.testing.assert_allclose(even, 3, rtol=1e-6)


def test_maps_are_found_in_folders_below(tmp_path):
    (tmp_path / "more" / "still").mkdir(parents=True)
    names = ["b.hdr", "a.EXR", "more/c.pfm", "more/still/a.hdr", "d.txt", "hdr"]
    for name in (*names, "._b.hdr"):
        (tmp_path / name).touch()
    (tmp_path / "folder.hdr").mkdir()
    found = find_environments(tmp_path)
    assert found == sorted(tmp_path / name for name in names[:4])
    assert find_environments(tmp_path / "d.txt") == [tmp_path / "d.txt"]


@pytest.mark.skipif(not ASSETS.is_dir(), reason="no environment maps beside the clone")
def test_maps_of_photographs_load():
    paths = find_environments(ASSETS)
    assert paths
    for path in paths:
        radiance = load_environment(path).radiance
        assert radiance.shape[0] <= 256
        assert radiance.shape[1] == 2 * radiance.shape[0]
        assert np.isfinite(radiance).all()
        assert 0 <= radiance.min() < radiance.mean()

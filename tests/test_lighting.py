"""Environment maps: files, procedural ones, and the irradiance that they cause."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from strategies import SEEDS

from ginn_jax import lighting
from ginn_jax.errors import InputError
from ginn_jax.lighting import (
    EnvironmentMap,
    constant_sky,
    find_environments,
    irradiance_of,
    load_environment,
    make_environment,
    pixel_directions,
    procedural_environment,
    studio,
    sun_and_sky,
    turned,
)
from ginn_jax.renderer import use_mitsuba

ASSETS = Path(__file__).parents[2] / "shared" / "assets" / "envmaps"
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


def dim_with_sun(height):
    """Random dim radiance, and a pixel of 1e5."""
    rng = np.random.default_rng(height)
    pixels = rng.uniform(0, 2, (height, 2 * height, 3)).astype(np.float32)
    pixels[height // 5, height // 3] = 1e5
    return pixels


def write(path, pixels):
    use_mitsuba()[0].Bitmap(pixels).write(str(path))
    return path


def assert_refused(path, message):
    """Loading ends in one line that names the file."""
    with pytest.raises(InputError) as caught:
        load_environment(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


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


def test_maps_of_other_proportions_have_no_irradiance():
    with pytest.raises(InputError, match="twice as wide"):
        irradiance_of(EnvironmentMap(np.ones((8, 8, 3))), unit(0, 1, 0))


def test_directions_are_unit_vectors_that_cover_the_sphere():
    toward = pixel_directions(64)
    np.testing.assert_allclose(np.linalg.norm(toward, axis=2), 1)
    assert (toward[:32, :, 1] > 0).all()
    assert (toward[32:, :, 1] < 0).all()
    # Column 0 looks to -z, a quarter of the width on to +x.
    np.testing.assert_allclose(toward[31, 0], [0, 0, -1], atol=0.1)
    np.testing.assert_allclose(toward[31, 32], [1, 0, 0], atol=0.1)


# Files


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


@pytest.mark.parametrize("ending", [".hdr", ".exr"])
def test_large_file_is_averaged_down_and_keeps_irradiance(tmp_path, ending):
    pixels = dim_with_sun(512)
    light = load_environment(write(tmp_path / f"a{ending}", pixels))
    assert light.radiance.shape == (256, 512, 3)
    rounding = 1e-2 if ending == ".hdr" else 1e-5
    mean = pixels.mean(axis=(0, 1), dtype=float)
    np.testing.assert_allclose(light.radiance.mean((0, 1)), mean, rtol=rounding)
    for normal in (unit(0, 1, 0), unit(1, 2, -3), unit(-1, -0.2, 0.3)):
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
    """The mean over all pixels stays, and what is even stays even."""
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
    np.testing.assert_allclose(
        light.mean((0, 1), dtype=float), pixels.mean((0, 1), dtype=float), rtol=1e-5
    )
    assert light.min() >= 0
    np.testing.assert_allclose(even, 3, rtol=1e-6)


@pytest.mark.parametrize(
    ("value", "message"),
    [(-1e-3, "negative"), (np.nan, "not finite"), (np.inf, "not finite")],
)
def test_bad_pixel_is_refused(tmp_path, value, message):
    pixels = dim_with_sun(16)
    pixels[3, 4, 1] = value
    assert_refused(write(tmp_path / "bad.exr", pixels), message)


def test_black_map_is_refused(tmp_path):
    black = np.zeros((16, 32, 3), np.float32)
    for ending in lighting.ENDINGS:
        assert_refused(write(tmp_path / f"black{ending}", black), "zero everywhere")


@pytest.mark.parametrize("shape", [(0, 0, 3), (4, 8), (4, 8, 4), (4, 0, 3)])
def test_arrays_that_are_no_map_are_refused(shape, unchecked):
    with pytest.raises(InputError, match="an environment map is"):
        make_environment(np.ones(shape, np.float32))


def test_missing_file_and_folder_are_refused(tmp_path):
    assert_refused(tmp_path / "gone.hdr", "no such file")
    assert_refused(tmp_path, "no such file")


@pytest.mark.parametrize("ending", [*lighting.ENDINGS, ".txt", ".png", ""])
@pytest.mark.parametrize("content", [b"", b"no image at all\n" * 20])
def test_garbage_is_refused(tmp_path, ending, content):
    path = tmp_path / f"garbage{ending}"
    path.write_bytes(content)
    assert_refused(path, "cannot be read")


@pytest.mark.parametrize("ending", lighting.ENDINGS)
@pytest.mark.parametrize("share", [0.001, 0.1, 0.5, 0.99])
def test_truncated_file_is_refused(tmp_path, ending, share):
    path = write(tmp_path / f"half{ending}", dim_with_sun(32))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert_refused(path, "cannot be read")


def test_maps_are_found_in_folders_below(tmp_path):
    (tmp_path / "more" / "still").mkdir(parents=True)
    names = ["b.hdr", "a.EXR", "more/c.pfm", "more/still/a.hdr", "d.txt", "hdr"]
    for name in names:
        (tmp_path / name).touch()
    found = find_environments(tmp_path)
    assert found == sorted(tmp_path / name for name in names[:4])
    assert find_environments(tmp_path / "d.txt") == [tmp_path / "d.txt"]


def test_folder_without_maps_and_no_folder_are_refused(tmp_path):
    (tmp_path / "photo.jpg").touch()
    for path, message in [(tmp_path, "no .hdr"), (tmp_path / "gone", "no such")]:
        with pytest.raises(InputError, match=message) as caught:
            find_environments(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


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

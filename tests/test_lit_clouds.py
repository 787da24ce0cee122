"""Clouds in colour come back from disk, and become what a network takes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from strategies import unit_rows

from ginn_jax.dataset import ShadedPoints, load_cloud, save_arrays, save_cloud
from ginn_jax.errors import InputError
from ginn_jax.lit_clouds import (
    DENSE,
    LIGHTS,
    LitCloud,
    channel_of,
    load_lit_cloud,
    network_numbers,
    save_lit_cloud,
    split_points,
    to_octahedron,
)

ORIGIN = {"seed": 3, "effect": "illumination", "object": "shape_3"}
DIM = st.floats(0, 4, width=32)
SUNS = st.sampled_from([0, 1e-3, 1, 1e5])
ANY = st.floats(width=32, allow_nan=False, allow_infinity=False)
SHARE = st.floats(0, 1, width=32)


@st.composite
def lit_clouds(draw, media=(0, 2)):
    """1 to 12 points of up to 3 materials, under any light, or none."""
    n, k = draw(st.integers(1, 12)), draw(st.integers(1, 3))

    def array(shape, elements):
        return draw(hnp.arrays(np.float32, shape, elements=elements))

    medium = (draw(st.floats(0, 500)), draw(st.floats(1, 1.5)))
    return LitCloud(
        array((n, 3), ANY),
        unit_rows(array((n, 3), st.floats(-1, 1, width=32))),
        draw(hnp.arrays(np.int32, n, elements=st.integers(0, k - 1))),
        *(array((n, 3), draw(st.sampled_from([DIM, DIM | SUNS]))) for _ in LIGHTS),
        array((k, 3), SHARE),
        np.array(medium[: draw(st.sampled_from(media))], np.float64),
    )


def cloud_of(count, seed=0, medium=()):
    """Random points, two materials, light as of a sky."""
    rng = np.random.default_rng(seed)
    return LitCloud(
        rng.normal(size=(count, 3)).astype(np.float32),
        unit_rows(rng.normal(size=(count, 3))),
        rng.integers(0, 2, count).astype(np.int32),
        *(rng.exponential(1, (count, 3)).astype(np.float32) for _ in LIGHTS),
        rng.uniform(0, 1, (2, 3)).astype(np.float32),
        np.array(medium),
    )


def again(folder, cloud):
    path = folder / "cloud.npz"
    save_lit_cloud(path, cloud, ORIGIN)
    return load_lit_cloud(path, ORIGIN)


def assert_light_close(found, light):
    """To 2^-11, by half-precision numbers in units of the mean, or 2^-25 of that.

    Light of mean 1e-30 is darkness.
    """
    assert found.dtype == np.float32
    light = light.astype(np.float64)
    error = np.abs(found - light)
    assert (error <= 1e-3 * light + 1e-7 * light.mean() + 1e-30).all()


def assert_refused(load, path, origin=None):
    """Loading ends in one line that names the file."""
    with pytest.raises(InputError) as caught:
        load(path, origin)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


# On disk


@given(lit_clouds())
def test_cloud_comes_back(tmp_path_factory, cloud):
    found = again(tmp_path_factory.mktemp("lit"), cloud)
    for name in ("position", "material", "albedo", "medium"):
        np.testing.assert_array_equal(getattr(found, name), getattr(cloud, name))
        assert getattr(found, name).dtype == getattr(cloud, name).dtype
    np.testing.assert_allclose(found.normal, cloud.normal, atol=2e-4)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1, rtol=1e-6)
    for name in LIGHTS:
        assert_light_close(getattr(found, name), getattr(cloud, name))


def test_point_takes_at_most_forty_bytes(tmp_path):
    again(tmp_path, cloud_of(20_000))
    assert (tmp_path / "cloud.npz").stat().st_size <= 40 * 20_000
    assert list(tmp_path.iterdir()) == [tmp_path / "cloud.npz"]


@pytest.mark.parametrize("suns", [1, 200])
def test_suns_beside_dim_points_survive(tmp_path, suns):
    """Even one point of 20,000 lit by one colour: all of the light."""
    cloud = cloud_of(20_000)
    light = np.random.default_rng(1).uniform(0.01, 0.02, (20_000, 3))
    light[:suns] = [1e5, 0, 0]
    found = again(tmp_path, cloud._replace(irradiance=light.astype(np.float32)))
    np.testing.assert_allclose(found.irradiance, light, rtol=1e-3)
    alone = np.zeros((20_000, 3), np.float32)
    alone[7, 1] = 1e5
    found = again(tmp_path, cloud._replace(target=alone))
    np.testing.assert_allclose(found.target, alone, rtol=1e-3)


def test_a_firefly_among_many_points_survives(tmp_path):
    """All of the light in one of 90,000 numbers is more than a half-precision one."""
    alone = np.zeros((30_000, 3), np.float32)
    alone[7, 1] = 3.0
    found = again(tmp_path, cloud_of(30_000)._replace(variance=alone))
    np.testing.assert_allclose(found.variance, alone, rtol=1e-3)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_light_of_any_scale_survives(tmp_path, scale):
    cloud = cloud_of(500)
    light = (cloud.irradiance * scale).astype(np.float32)
    found = again(tmp_path, cloud._replace(irradiance=light))
    assert_light_close(found.irradiance, light)


def test_darkness_survives(tmp_path):
    dark = np.zeros((9, 3), np.float32)
    found = again(tmp_path, cloud_of(9)._replace(irradiance=dark, target=dark))
    np.testing.assert_array_equal(found.irradiance, 0)
    np.testing.assert_array_equal(found.target, 0)
    assert found.variance.min() > 0


def test_missing_and_other_file_is_refused(tmp_path):
    assert_refused(load_lit_cloud, tmp_path / "gone.npz")
    (tmp_path / "text.npz").write_text("no cloud")
    assert_refused(load_lit_cloud, tmp_path / "text.npz")


def test_other_origin_is_refused(tmp_path):
    again(tmp_path, cloud_of(5))
    for other in (ORIGIN | {"seed": 4}, ORIGIN | {"points": 5}, {}):
        assert_refused(load_lit_cloud, tmp_path / "cloud.npz", other)
    load_lit_cloud(tmp_path / "cloud.npz")


@pytest.mark.parametrize("share", [0, 0.01, 0.5, 0.95, 0.999])
def test_truncated_file_is_refused(tmp_path, share):
    again(tmp_path, cloud_of(50))
    path = tmp_path / "cloud.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert_refused(load_lit_cloud, path, ORIGIN)


def test_no_flipped_byte_goes_unnoticed(tmp_path):
    cloud = again(tmp_path, cloud_of(50))
    path = tmp_path / "cloud.npz"
    whole, caught = path.read_bytes(), 0
    for place in np.random.default_rng(0).permutation(len(whole))[:200]:
        flipped = bytearray(whole)
        flipped[place] ^= 0xFF
        path.write_bytes(flipped)
        try:
            found = load_lit_cloud(path, ORIGIN)
            for a, b in zip(found, cloud, strict=True):
                np.testing.assert_array_equal(a, b)
        except InputError:
            caught += 1
    assert caught > 100


def test_another_kind_of_cloud_is_refused_both_ways(tmp_path):
    cloud = cloud_of(5)
    grey = ShadedPoints(*cloud[:2], cloud.target[:, 0], cloud.variance[:, 0])
    save_cloud(tmp_path / "grey.npz", grey, ORIGIN)
    assert_refused(load_lit_cloud, tmp_path / "grey.npz", ORIGIN)
    again(tmp_path, cloud)
    assert_refused(load_cloud, tmp_path / "cloud.npz", ORIGIN)


@pytest.mark.parametrize("lacks", ["variance_unit", "normal", "albedo", "medium"])
def test_file_that_lacks_something_is_refused(tmp_path, lacks):
    cloud = again(tmp_path, cloud_of(5))
    units = {f"{name}_unit": np.float64(1) for name in LIGHTS}
    fields = cloud._asdict() | units | {"normal": to_octahedron(cloud.normal)}
    path = tmp_path / "old.npz"
    save_arrays(path, fields, ORIGIN)
    load_lit_cloud(path, ORIGIN)
    del fields[lacks]
    save_arrays(path, fields, ORIGIN)
    assert_refused(load_lit_cloud, path, ORIGIN)


# What the network takes


@given(lit_clouds(media=(0,)))
def test_diffuse_points_send_out_albedo_times_irradiance(cloud):
    material, light = network_numbers(cloud)
    n = len(cloud.position)
    assert material.shape == light.shape == (3, n, 1)
    assert material.dtype == light.dtype == np.float32
    for i in range(n):
        albedo = cloud.albedo[cloud.material[i]]
        np.testing.assert_array_equal(material[:, i, 0], albedo)
        np.testing.assert_array_equal(light[:, i, 0], albedo * cloud.irradiance[i])


@given(lit_clouds(media=(2,)))
def test_translucent_points_take_three_numbers_and_irradiance(cloud):
    material, light = network_numbers(cloud)
    n = len(cloud.position)
    assert material.shape == (3, n, 3)
    assert material.dtype == np.float32
    np.testing.assert_array_equal(light, cloud.irradiance.T[..., None])
    np.testing.assert_array_equal(material[..., 0], cloud.albedo[cloud.material].T)
    extinction, ior = cloud.medium
    dense = np.log(1 + extinction) / np.log(1 + DENSE)
    np.testing.assert_allclose(material[..., 1], dense, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(material[..., 2], ior - 1, rtol=1e-5, atol=1e-6)


@given(lit_clouds(), st.integers(0, 2))
def test_channel_is_one_colour_of_everything(cloud, channel):
    found = channel_of(cloud, channel)
    material, light = network_numbers(cloud)
    expected = (
        cloud.position,
        cloud.normal,
        cloud.target[:, channel],
        cloud.variance[:, channel],
        material[channel],
        light[channel],
    )
    for one, two in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, two)


def test_cloud_without_colour_has_one_channel():
    cloud = cloud_of(5)
    grey = ShadedPoints(*cloud[:2], cloud.target[:, 0], cloud.variance[:, 0])
    assert all(channel_of(grey, c) is grey for c in range(3))


@given(lit_clouds(), st.integers(0, 12))
def test_parts_are_the_whole(cloud, count):
    first, rest = split_points(cloud, count)
    assert len(first.position) == min(count, len(cloud.position))
    for name, whole in cloud._asdict().items():
        one, two = getattr(first, name), getattr(rest, name)
        if name in ("albedo", "medium"):
            np.testing.assert_array_equal(one, whole)
            np.testing.assert_array_equal(two, whole)
        else:
            np.testing.assert_array_equal(np.concatenate([one, two]), whole)

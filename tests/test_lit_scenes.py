"""From a source to a lit cloud, and to a file that is made once."""

import re
import warnings

import numpy as np
import pytest
import tiny
import trimesh
from hypothesis import given
from strategies import SEEDS

from ginn_jax import scenes
from ginn_jax.errors import InputError, InputWarning
from ginn_jax.lit_clouds import DENSE, load_lit_cloud
from ginn_jax.lit_scenes import (
    Illumination,
    Scattering,
    draw_albedo,
    draw_medium,
    light_mesh,
    light_up,
    lit_cloud,
    transport,
)
from ginn_jax.objects import (
    file_sources,
    load_light,
    load_object,
    point_lights,
    procedural_lights,
)
from ginn_jax.pairing import pair_up
from ginn_jax.scenes import cloud_origin, cloud_path, make_cloud, read_clouds

SMALL = {"points": 300, "paths": 4, "looks": 16}
EFFECTS = [Illumination(**SMALL), Scattering(**SMALL)]
both = pytest.mark.parametrize("settings", EFFECTS)


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """A sphere and a stretched box under a studio and a point light."""
    folder = tmp_path_factory.mktemp("meshes")
    trimesh.creation.icosphere(subdivisions=3).export(folder / "ball.ply")
    trimesh.creation.box((1, 2, 1)).export(folder / "crate.ply")
    things = file_sources([folder / "ball.ply", folder / "crate.ply"])
    return pair_up(things, procedural_lights(1, 2) + point_lights(1, 0), 2)


def contents(folder):
    """Bytes and time of each file."""
    return {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.iterdir()}


# Clouds


@both
def test_cloud_has_all_that_a_network_takes(sources, settings):
    for source in sources:
        cloud = lit_cloud(source, settings)
        shapes = [np.shape(a) for a in cloud[:6]]
        assert shapes == [(300, 3), (300, 3), (300,), (300, 3), (300, 3), (300, 3)]
        assert all(np.isfinite(a).all() for a in cloud)
        np.testing.assert_allclose(np.linalg.norm(cloud.normal, axis=1), 1, atol=1e-5)
        assert (cloud.irradiance >= 0).all()
        assert cloud.irradiance.max() > 0
        assert (cloud.target >= 0).all()
        assert cloud.target.max() > 0
        assert (cloud.variance >= 0).all()
        if isinstance(settings, Illumination):
            assert set(cloud.material) == {0, 1}
            assert cloud.albedo.shape == (2, 3)
            assert cloud.medium.shape == (0,)
        else:
            assert set(cloud.material) == {0}
            assert cloud.albedo.shape == (1, 3)
            assert cloud.medium.shape == (2,)


@both
def test_only_the_last_points_have_targets(sources, settings):
    """The others are as they are without: positions, and the light on them."""
    few = type(settings)(**SMALL, targets=40)
    cloud, whole = lit_cloud(sources[0], few), lit_cloud(sources[0], settings)
    for name in ("target", "variance"):
        np.testing.assert_array_equal(getattr(cloud, name)[:260], 0)
        assert getattr(cloud, name)[260:].max() > 0
        assert getattr(whole, name)[:260].max() > 0
    assert tiny.identical(cloud[:4], whole[:4])


@both
def test_second_making_is_the_same_and_another_seed_is_not(sources, settings):
    one, two = (lit_cloud(sources[0], settings) for _ in range(2))
    assert tiny.identical(one, two)
    other = lit_cloud(sources[2], settings)
    assert not np.array_equal(one.albedo, other.albedo)
    assert not np.array_equal(one.position, other.position)


@both
def test_nothing_sends_out_more_light_than_there_is(sources, settings):
    """Less than pi times the greatest radiance, within the targets' own error.

    What a medium sends out is not more than what arrives either, on average.
    """
    cloud = lit_cloud(sources[0], settings)
    most = np.pi * load_light(sources[0]).radiance.max(axis=(0, 1))
    error = np.sqrt(cloud.variance.sum(0)) / len(cloud.target)
    assert (cloud.irradiance <= 1.05 * most).all()
    assert (cloud.target.mean(0) <= most + 4 * error).all()
    if isinstance(settings, Scattering):
        arrives = cloud.irradiance.mean(0)
        assert (cloud.target.mean(0) <= arrives + 4 * error).all()


def test_scattering_needs_no_ground_and_illumination_has_one(sources):
    gi, sss = (light_up(sources[0], s) for s in EFFECTS)
    assert set(gi.scene.mesh.material) == {0, 1}
    assert set(sss.scene.mesh.material) == {0}
    np.testing.assert_array_equal(gi.albedo[:1], sss.albedo)


def test_ball_is_lit_from_the_ground_below(sources):
    """A face that looks up still sees ground beside it, but less than one below."""
    cloud = lit_cloud(sources[0], Illumination(points=300, paths=32, looks=1))
    top = (cloud.normal[:, 1] > 0.2) & (cloud.material == 0)
    under = (cloud.normal[:, 1] < -0.3) & (cloud.material == 0)
    assert top.sum() > 20
    assert under.sum() > 20
    assert cloud.target[top].mean() < 0.5 * cloud.target[under].mean()


# Materials


@given(SEEDS)
def test_materials_are_in_their_ranges(seed):
    albedo = draw_albedo(seed)
    assert albedo.shape == (2, 3)
    assert albedo.min() >= 0
    assert albedo.max() <= 1
    np.testing.assert_array_equal(draw_albedo(seed), albedo)
    extinction, ior = draw_medium(albedo[0], seed, Scattering())
    assert 1 <= extinction <= DENSE
    assert 1 <= ior <= 1.5
    twice = draw_medium(albedo[0], seed, Scattering(size=200.0))
    np.testing.assert_allclose(twice, [min(2 * extinction, DENSE), ior])


def test_materials_are_drawn_as_the_paper_says():
    """Uniform, and absorption exponential of mean .1 per mm but for its limits.

    Nothing scatters in a black medium: there, extinction is absorption.
    """
    albedo = np.array([draw_albedo(s) for s in range(500)]).reshape(500, 6)
    assert np.abs(albedo.mean(0) - 0.5).max() < 4 / np.sqrt(12 * 500)
    assert np.abs(np.corrcoef(albedo.T) - np.eye(6)).max() < 4.5 / np.sqrt(500)
    media = [draw_medium(np.zeros(3), s, Scattering()) for s in range(500)]
    extinction, ior = np.array(media).T
    assert ior.mean() == pytest.approx(1.25, abs=4 * 0.5 / np.sqrt(12 * 500))
    for share in (0.3, 1.0, 3.0):
        kept = np.exp(-share)
        error = 4 * np.sqrt(kept * (1 - kept) / 500)
        assert (extinction > 10 * share).mean() == pytest.approx(kept, abs=error)


def test_a_mesh_that_does_not_hold_its_medium_is_told(sources):
    source = sources[0]
    ball = load_object(source, ground=False)
    half = ball._replace(faces=ball.faces[ball.vertices[ball.faces, 1].mean(1) < 0])
    half = half._replace(material=half.material[: len(half.faces)])
    thin = Scattering(size=1.0, **SMALL)
    for mesh, loses in ((ball, False), (half, True)):
        lit = light_mesh(mesh, load_light(source), thin, seed=0)
        low = mesh.vertices[mesh.vertices[:, 1] < -0.3]
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            transport(lit, low, 2 * low, paths=8, seed=0)
        assert [w.category for w in told] == [InputWarning] * loses
        assert all(
            re.search(r"\d+% of the walks .* holes", str(w.message)) for w in told
        )


# Files


@both
def test_right_file_is_not_touched(sources, settings, tmp_path, monkeypatch):
    path = cloud_path(tmp_path, sources[0])
    make_cloud(sources[0], settings, path)
    before = contents(tmp_path)
    assert list(before) == [path.name]
    monkeypatch.setattr(scenes, "lit_cloud", None)
    make_cloud(sources[0], settings, path)
    assert contents(tmp_path) == before


@both
@pytest.mark.parametrize("damage", ["truncated", "settings", "effect", "object"])
def test_unusable_file_is_made_again(sources, settings, tmp_path, damage):
    source, path = sources[1], tmp_path / "cloud.npz"
    make_cloud(source, settings, path)
    good = load_lit_cloud(path, cloud_origin(source, settings))
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:700])
    elif damage == "settings":
        make_cloud(source, type(settings)(points=20, paths=2, looks=2), path)
        assert len(load_lit_cloud(path).position) == 20
    elif damage == "effect":
        [other] = [e for e in EFFECTS if e != settings]
        make_cloud(source, other, path)
        assert not tiny.identical(load_lit_cloud(path), good)
    else:
        make_cloud(sources[3], settings, path)
        assert not tiny.identical(load_lit_cloud(path), good)
    with pytest.raises(InputError):
        load_lit_cloud(path, cloud_origin(source, settings))
    make_cloud(source, settings, path)
    assert tiny.identical(load_lit_cloud(path), good)
    assert list(tmp_path.iterdir()) == [path]


def test_file_of_occlusion_is_made_again(sources, tmp_path):
    path = tmp_path / "cloud.npz"
    make_cloud(sources[0], scenes.Occlusion(points=20, rays=2), path)
    make_cloud(sources[0], EFFECTS[0], path)
    assert load_lit_cloud(path).position.shape == (300, 3)
    make_cloud(sources[0], scenes.Occlusion(points=20, rays=2), path)
    with pytest.raises(InputError, match="other settings"):
        scenes.read_cloud(sources[0], EFFECTS[0], path)


def test_every_setting_and_light_is_in_the_origin(sources):
    changes = [{}, {"points": 2}, {"paths": 2}, {"looks": 2}, {"targets": 2}]
    made = [Illumination(**c) for c in changes]
    made += [Scattering(**c) for c in [*changes, {"size": 2.0}, {"absorption": 2.0}]]
    found = [str(cloud_origin(sources[0], s)) for s in made]
    found += [str(cloud_origin(s, made[0])) for s in sources[1:]]
    assert len(set(found)) == len(found) == 15


def test_worker_makes_the_same_clouds(sources, tmp_path):
    folder, settings = tmp_path / "clouds", EFFECTS[0]
    with pytest.raises(InputError, match="no such file"):
        read_clouds(sources[:2], settings, folder)
    done = list(scenes.make_clouds(sources[:2], settings, folder, 1))
    assert sorted(done) == sorted(folder.iterdir())
    assert sorted(done) == sorted(cloud_path(folder, s) for s in sources[:2])
    for source, cloud in zip(
        sources, read_clouds(sources[:2], settings, folder), strict=False
    ):
        path = cloud_path(tmp_path, source)
        make_cloud(source, settings, path)
        assert tiny.identical(cloud, load_lit_cloud(path))

"""The lights that objects are given, and what tells one source from another."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from strategies import SEEDS

from ginn_jax import lighting, objects
from ginn_jax.errors import InputError
from ginn_jax.lighting import EnvironmentMap, PointLight
from ginn_jax.objects import (
    Source,
    file_lights,
    file_sources,
    load_light,
    origin_of,
    point_lights,
    procedural_lights,
    procedural_sources,
    random_point_light,
)
from ginn_jax.pairing import pair_up
from ginn_jax.renderer import use_mitsuba


def sky_file(path, radiance=1.0):
    rng = np.random.default_rng(0)
    pixels = radiance * rng.uniform(0, 1, (8, 16, 3)).astype(np.float32)
    use_mitsuba()[0].Bitmap(pixels).write(str(path))
    return path


# Lights


def test_each_kind_of_light_loads(tmp_path, monkeypatch):
    monkeypatch.setattr(lighting, "HEIGHT", 16)
    lights = [
        *file_lights([sky_file(tmp_path / "sky.exr")]),
        *procedural_lights(1, 3),
        *point_lights(1, 3),
    ]
    assert len({light.name for light in lights}) == 3
    [thing] = procedural_sources(1, 0)
    file, sky, point = (load_light(s) for s in pair_up([thing], lights, 3))
    assert isinstance(file, EnvironmentMap)
    assert isinstance(sky, EnvironmentMap)
    assert isinstance(point, PointLight)


def test_light_from_a_file_is_turned_by_the_seed(tmp_path):
    """About the vertical: each row keeps its pixels, in turn."""
    path = sky_file(tmp_path / "sky.exr")
    plain = lighting.load_environment(path).radiance
    [light] = file_lights([path])
    columns = set()
    for seed in range(20):
        source = Source("thing", None, seed, light)
        found = load_light(source).radiance
        rolls = [(np.roll(plain, c, axis=1) == found).all() for c in range(16)]
        assert sum(rolls) == 1
        columns.add(rolls.index(True))
        np.testing.assert_array_equal(load_light(source).radiance, found)
    assert len(columns) > 6


def test_object_without_light_has_none():
    with pytest.raises(InputError, match=r"^[^\n]*shape_4: no light[^\n]*$"):
        load_light(procedural_sources(1, 4)[0])


def test_missing_environment_is_refused_on_loading(tmp_path):
    [light] = file_lights([tmp_path / "gone.hdr"])
    with pytest.raises(InputError, match=r"^[^\n]*gone\.hdr[^\n]*$"):
        load_light(objects.Source("thing", None, 0, light))


@given(SEEDS)
def test_point_light_is_above_and_out_of_the_unit_box(seed):
    light = random_point_light(seed)
    x, y, z = light.position
    assert 0.5 < y < 2
    assert np.hypot(x, z) > 0.5 * np.sqrt(2)
    assert (light.intensity > 0).all()
    again = random_point_light(seed)
    np.testing.assert_array_equal(light.position, again.position)


def test_point_lights_differ():
    places = np.array([random_point_light(s).position for s in range(20)])
    assert len(np.unique(places, axis=0)) == 20
    assert np.abs(places[:, [0, 2]].mean(0)).max() < 0.8


# Origins


def test_origin_knows_the_contents_of_files(tmp_path):
    sky, thing = sky_file(tmp_path / "sky.exr"), tmp_path / "box.ply"
    trimesh.creation.box((1, 1, 1)).export(thing)
    [pair] = pair_up(file_sources([thing]), file_lights([sky]), 1)
    first = origin_of(pair)
    assert origin_of(pair) == first
    sky_file(sky, 2.0)
    second = origin_of(pair)
    assert second != first
    assert second["object"] == first["object"]
    trimesh.creation.box((1, 1, 2)).export(thing)
    third = origin_of(pair)
    assert third != second
    assert third["light"] == second["light"]
    # Files that were moved are the same.
    (tmp_path / "elsewhere").mkdir()
    moved = sky.rename(tmp_path / "elsewhere" / "sky.exr")
    [pair] = pair_up(file_sources([thing]), file_lights([moved]), 1)
    assert origin_of(pair) == third


def test_origins_of_seeds_differ():
    things, lights = procedural_sources(3, 0), procedural_lights(2, 0)
    pairs = pair_up(things, lights + point_lights(2, 0), 4)
    found = [str(sorted(origin_of(p).items())) for p in [*things, *pairs]]
    assert len(set(found)) == len(found) == 15


@pytest.mark.parametrize("gone", ["object", "light"])
def test_origin_of_a_missing_file_is_refused(tmp_path, gone):
    sky, thing = sky_file(tmp_path / "sky.exr"), tmp_path / "box.ply"
    trimesh.creation.box((1, 1, 1)).export(thing)
    [pair] = pair_up(file_sources([thing]), file_lights([sky]), 1)
    missing = {"object": thing, "light": sky}[gone]
    missing.unlink()
    with pytest.raises(InputError) as caught:
        origin_of(pair)
    assert str(missing) in str(caught.value)
    assert "\n" not in str(caught.value)

import signal
import subprocess
import sys

import numpy as np
import pytest
import tiny
import trimesh

from ginn_jax import objects, scenes
from ginn_jax.dataset import load_cloud
from ginn_jax.errors import InputError, InputWarning, naming, warn
from ginn_jax.reference import build_scene
from ginn_jax.shapes import random_shape
from ginn_jax.visible import visible_samples

SETTINGS = scenes.Occlusion(points=300, rays=4, radius=0.2)


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """A mesh file of a stretched box far from the origin, and a procedural shape."""
    path = tmp_path_factory.mktemp("meshes") / "crate.ply"
    box = trimesh.creation.box((1.0, 4.0, 2.0))
    box.apply_translation([7, 8, 9]).export(path)
    return objects.file_sources([path]) + objects.procedural_sources(1, 5)


@pytest.fixture(scope="module")
def made(sources, tmp_path_factory):
    """The clouds of both, made in this process."""
    folder = tmp_path_factory.mktemp("clouds")
    for source in sources:
        scenes.make_cloud(source, SETTINGS, scenes.cloud_path(folder, source))
    return folder


def contents(folder):
    """Bytes and time of each file."""
    return {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.iterdir()}


def test_object_fills_its_unit_box_on_the_ground(sources):
    for source in sources:
        mesh = objects.load_object(source)
        thing = mesh.vertices[np.unique(mesh.faces[mesh.material == 0])]
        ground = mesh.vertices[np.unique(mesh.faces[mesh.material == 1])]
        np.testing.assert_allclose(np.ptp(thing, axis=0).max(), 1, atol=1e-5)
        np.testing.assert_allclose(ground[:, 1], thing[:, 1].min(), atol=2e-4)
        assert (ground.min(axis=0)[[0, 2]] < thing.min(axis=0)[[0, 2]]).all()
        assert (ground.max(axis=0)[[0, 2]] > thing.max(axis=0)[[0, 2]]).all()
    crate = objects.load_object(sources[0])
    sides = np.ptp(crate.vertices[np.unique(crate.faces[crate.material == 0])], axis=0)
    np.testing.assert_allclose(sides, [0.25, 1, 0.5], atol=1e-5)


def test_no_sample_lies_under_a_flat_base(sources):
    """Not on the crate's bottom, where it stands, nor on the ground under it."""
    mesh = objects.load_object(sources[0])
    samples = visible_samples(build_scene(mesh), 3000, seed=1)
    low = mesh.vertices[:, 1].min()
    near = samples.position[:, 1] < low + 0.01
    assert (samples.normal[near, 1] >= 0).all()
    within = (np.abs(samples.position[:, [0, 2]]) < [0.12, 0.24]).all(axis=1)
    assert not (near & within).any()


def test_sources_have_names_and_seeds_of_their_own(tmp_path):
    shapes = objects.procedural_sources(3, 40)
    assert [s.seed for s in shapes] == [40, 41, 42]
    assert len({s.name for s in shapes}) == 3
    assert all(s.path is None for s in shapes)
    one = objects.load_object(shapes[0])
    np.testing.assert_array_equal(
        one.faces[one.material == 0].shape, random_shape(40).faces.shape
    )
    files = objects.file_sources([tmp_path / "a.ply", tmp_path / "b.obj"])
    assert [s.name for s in files] == ["a", "b"]


def test_cloud_has_samples_of_the_scene(sources, made):
    for cloud in scenes.read_clouds(sources, SETTINGS, made):
        assert cloud.position.shape == (300, 3)
        np.testing.assert_allclose(np.linalg.norm(cloud.normal, axis=1), 1, atol=1e-5)
        assert 0 <= cloud.target.min() < 0.9
        assert 0.5 < cloud.target.max() <= 1
        assert (cloud.variance >= 0).all()
        assert len(np.unique(cloud.position, axis=0)) == 300


def test_many_clouds_stay_in_their_files(sources, made, monkeypatch):
    held = scenes.read_clouds(sources, SETTINGS, made)
    assert isinstance(held, list)
    monkeypatch.setattr(scenes, "IN_MEMORY", 2 * 300 * 4 * 8 - 1)
    read = scenes.read_clouds(sources, SETTINGS, made)
    assert not isinstance(read, list)
    assert tiny.identical(list(read), held)
    assert tiny.identical(read[np.int64(1)], held[1])
    assert read[0] is not read[0]


def test_second_making_is_the_same(sources, made, tmp_path):
    path = scenes.cloud_path(tmp_path, sources[1])
    scenes.make_cloud(sources[1], SETTINGS, path)
    assert tiny.identical(load_cloud(path), load_cloud(made / path.name))


def test_cached_cloud_is_not_written_again(sources, made, monkeypatch):
    before = contents(made)
    monkeypatch.setattr(scenes, "load_object", None)
    for source in sources:
        scenes.make_cloud(source, SETTINGS, scenes.cloud_path(made, source))
    assert contents(made) == before


@pytest.mark.parametrize("damage", ["truncated", "other settings"])
def test_unusable_cached_cloud_is_made_again(sources, made, tmp_path, damage):
    source = sources[1]
    path = scenes.cloud_path(tmp_path, source)
    if damage == "truncated":
        path.write_bytes((made / path.name).read_bytes()[:500])
    else:
        fewer = scenes.Occlusion(points=20, rays=2, radius=0.2)
        scenes.make_cloud(source, fewer, path)
        assert len(load_cloud(path).target) == 20
    scenes.make_cloud(source, SETTINGS, path)
    assert tiny.identical(load_cloud(path), load_cloud(made / path.name))


def test_changed_mesh_file_is_another_origin(tmp_path):
    path = tmp_path / "thing.ply"
    trimesh.creation.box((1, 1, 1)).export(path)
    [source] = objects.file_sources([path])
    before = scenes.cloud_origin(source, SETTINGS)
    assert scenes.cloud_origin(source, SETTINGS) == before
    trimesh.creation.box((1, 1, 2)).export(path)
    assert scenes.cloud_origin(source, SETTINGS) != before


def test_changed_numbers_of_a_gltf_are_another_origin(tmp_path):
    """They lie in a file of their own beside it."""
    trimesh.creation.box().export(tmp_path / "a b.gltf")
    source = objects.file_sources([tmp_path / "a b.gltf"])[0]
    before = objects.origin_of(source)
    part = next(tmp_path.glob("*.bin"))
    assert objects.origin_of(source) == before
    part.write_bytes(part.read_bytes()[::-1])
    assert objects.origin_of(source) != before


def test_two_objects_of_one_name_are_refused(tmp_path):
    trimesh.creation.box().export(tmp_path / "shape_1.ply")
    both = objects.procedural_sources(2, 0)
    both += objects.file_sources([tmp_path / "shape_1.ply"])
    with pytest.raises(InputError, match="two objects are called shape_1: rename"):
        list(scenes.make_clouds(both, SETTINGS, tmp_path / "clouds", 1))


def test_workers_make_the_same_and_keep_what_is_done(sources, made, tmp_path):
    done = list(scenes.make_clouds(sources, SETTINGS, tmp_path / "new", 2))
    assert sorted(done) == sorted((tmp_path / "new").iterdir())
    assert len(done) == 2
    for path in done:
        assert tiny.identical(load_cloud(path), load_cloud(made / path.name))
    before = contents(tmp_path / "new")
    broken = tmp_path / "broken.ply"
    broken.write_text("ply\nnot really")
    more = [*sources, *objects.file_sources([broken])]
    with pytest.raises(InputError, match=r"^[^\n]*broken\.ply[^\n]*$"):
        list(scenes.make_clouds(more, SETTINGS, tmp_path / "new", 1))
    assert contents(tmp_path / "new") == before


KILLED = """
import os, signal, sys
from pathlib import Path
from ginn_jax import objects, scenes

if __name__ == "__main__":
    sources = objects.procedural_sources(3, 5)
    settings = scenes.Occlusion(points=300, rays=4, radius=0.2)
    for path in scenes.make_clouds(sources, settings, Path(sys.argv[1]), 1):
        os.kill(os.getpid(), signal.SIGKILL)
"""


def test_workers_end_with_the_run_that_is_killed(tmp_path):
    script = tmp_path / "killed.py"
    script.write_text(KILLED)
    given = [sys.executable, script, tmp_path / "clouds"]
    # Its output ends when the last process that holds it has ended.
    done = subprocess.run(given, stdout=subprocess.PIPE, timeout=120)
    assert done.returncode == -signal.SIGKILL
    assert list((tmp_path / "clouds").glob("*.npz"))


def test_no_process_makes_more_than_its_share(monkeypatch, tmp_path):
    """A pool that replaces its processes as they tire may wait for one forever."""
    pools = []

    class Pool(tiny.Here):
        def __init__(self, workers, *_):
            pools.append((workers, []))

        def submit(self, function, source, settings, path):
            pools[-1][1].append(source.name)
            return super().submit(path.touch)

    monkeypatch.setattr(scenes, "ProcessPoolExecutor", Pool)
    monkeypatch.setattr(scenes, "SCENES_PER_WORKER", 3)
    many = objects.procedural_sources(14, 0)
    done = list(scenes.make_clouds(many, SETTINGS, tmp_path, 2))
    assert sorted(done) == sorted(scenes.cloud_path(tmp_path, s) for s in many)
    assert [(workers, len(names)) for workers, names in pools] == [
        (2, 6),
        (2, 6),
        (2, 2),
    ]


def test_missing_mesh_is_refused(tmp_path):
    [source] = objects.file_sources([tmp_path / "gone.ply"])
    with pytest.raises(InputError, match=r"^[^\n]*gone\.ply[^\n]*$"):
        scenes.make_cloud(source, SETTINGS, tmp_path / "gone.npz")
    assert list(tmp_path.iterdir()) == []


def test_missing_clouds_are_refused(sources, tmp_path):
    with pytest.raises(InputError, match="crate"):
        scenes.read_clouds(sources, SETTINGS, tmp_path)


def test_what_is_wrong_with_an_object_names_it(sources, tmp_path, monkeypatch):
    """What worker processes say has to tell one of many files."""

    def fail(*_):
        raise InputError("all is sealed: mend it")

    monkeypatch.setattr(scenes, "visible_samples", fail)
    with pytest.raises(InputError, match=r"^crate: all is sealed: mend it$"):
        scenes.make_cloud(sources[0], SETTINGS, tmp_path / "cloud.npz")
    with pytest.warns(InputWarning, match="^crate: a tenth"), naming("crate"):
        warn("a tenth leaks")
    named = InputError("crate is empty")
    with (
        pytest.raises(InputError, match=r"^crate is empty$"),
        naming("crate"),
    ):
        raise named

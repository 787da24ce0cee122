"""Meshes from files and folders."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from triangles import signed_volume

from ginn_jax import mesh as gm
from ginn_jax import samples as gs
from ginn_jax.errors import InputWarning

ASSETS = Path(__file__).parents[2] / "shared" / "assets" / "meshes"


@pytest.mark.parametrize("ending", ["obj", "ply", "glb", "stl"])
def test_scenes_survive_the_trip_through_a_file(tmp_path, ending):
    first, second = trimesh.creation.box(), trimesh.creation.icosphere(2, 0.4)
    scene = trimesh.Scene()
    scene.add_geometry(first)
    move = trimesh.transformations.translation_matrix([3, 0, 0])
    scene.add_geometry(second, transform=move)
    path = tmp_path / f"scene.{ending}"
    (scene if ending in ("obj", "glb") else scene.to_mesh()).export(path)
    mesh = gm.load_mesh(path)
    assert len(mesh.faces) == len(first.faces) + len(second.faces)
    assert signed_volume(mesh) == pytest.approx(first.volume + second.volume, rel=1e-4)
    np.testing.assert_allclose(mesh.vertices.max(0), [3.4, 0.5, 0.5], atol=1e-5)
    assert gm.find_meshes(tmp_path) == gm.find_meshes(path) == [path]


def test_warnings_of_a_file_name_it(tmp_path):
    solid = trimesh.creation.box()
    solid.invert()
    solid.export(tmp_path / "inverted.ply")
    with pytest.warns(InputWarning, match=r"^.*inverted\.ply: turned 1 closed.*\Z"):
        gm.load_mesh(tmp_path / "inverted.ply")


def test_folders_are_searched_and_sorted(tmp_path):
    (tmp_path / "sub").mkdir()
    for name in ("b.ply", "a.OBJ", "sub/c.glb", "notes.md"):
        (tmp_path / name).touch()
    found = [p.relative_to(tmp_path).as_posix() for p in gm.find_meshes(tmp_path)]
    assert found == ["a.OBJ", "b.ply", "sub/c.glb"]


@pytest.mark.skipif(not ASSETS.exists(), reason="the shared assets are not here")
@pytest.mark.filterwarnings("ignore::ginn_jax.errors.InputWarning")
def test_real_meshes_load_and_sample():
    for path in gm.find_meshes(ASSETS)[::20]:
        mesh = gm.fit_unit_box(gm.load_mesh(path))
        samples = gs.sample_surface(gm.add_ground(mesh), 2000, seed=0)
        assert np.isfinite(samples.position).all()
        assert set(samples.material) == {0, 1}

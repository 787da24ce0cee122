"""Meshes from files and folders."""

import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import trimesh
from triangles import signed_volume

from ginn_jax import mesh as gm
from ginn_jax import samples as gs
from ginn_jax.errors import InputError, InputWarning

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


def test_threads_that_load_leave_the_warnings_of_others_alone(tmp_path, recwarn):
    solid = trimesh.creation.box()
    solid.invert()
    paths = [tmp_path / f"{i}.ply" for i in range(40)]
    for path in paths:
        solid.export(path)
    before = list(warnings.filters)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(gm.load_mesh, paths))
    assert list(warnings.filters) == before
    told = sorted(str(w.message).partition(":")[0] for w in recwarn)
    assert told == sorted(map(str, paths))


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


def test_what_lies_far_away_keeps_its_shape(tmp_path):
    """Coordinates of a survey: float32 has steps of half a metre there."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=5.0)
    here = gm.fit_unit_box(gm.make_mesh(ball.vertices, ball.faces))
    ball.apply_translation([500_000.1, 5_400_000.5, 120])
    path = tmp_path / "tower.obj"
    ball.export(path, digits=12)
    with pytest.warns(InputWarning, match=r"^[^\n]*tower\.obj: mesh: too far away"):
        there = gm.fit_unit_box(gm.load_mesh(path))
    np.testing.assert_allclose(there.vertices, here.vertices, atol=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        near = ball.vertices - [500_000.1, 5_400_000.5, 20]
        np.testing.assert_array_equal(gm.near_origin(near, "mesh"), near)


def test_what_is_small_and_far_away_keeps_its_shape():
    """A millionth wide, a hundred thousand away."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=5e-7)
    there = np.add(ball.vertices, [100_000.5, 7.5, 3.5])
    with pytest.warns(InputWarning, match="too far away"):
        moved = gm.near_origin(there, "mesh").astype(np.float32)
    away = np.linalg.norm(moved.astype(float) - moved.mean(axis=0), axis=1)
    # float64 has steps of 1.5e-11 there.
    np.testing.assert_allclose(away, 5e-7, rtol=1e-4)


def test_notes_of_the_system_and_points_are_no_meshes(tmp_path):
    box = trimesh.creation.box((1, 1, 1))
    box.export(tmp_path / "box.ply")
    (tmp_path / "._box.ply").write_bytes(b"notes")
    (tmp_path / "scan.xyz").write_text("0 0 0\n")
    (tmp_path / "folder.obj").mkdir()
    assert gm.find_meshes(tmp_path) == [tmp_path / "box.ply"]


def test_triangles_on_a_line_have_no_area():
    line = np.float32([[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    mesh = gm.Mesh(line, np.int32([[0, 1, 2]]), np.zeros(1, np.int32))
    with pytest.raises(InputError, match="all faces have zero area"):
        gm.check_mesh(mesh)


def test_a_binary_file_of_triangles_and_quads_is_explained(tmp_path):
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 5\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    places = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]])
    faces = b"\x04" + np.int32([0, 1, 2, 3]).tobytes()
    faces += b"\x03" + np.int32([1, 4, 2]).tobytes()
    path = tmp_path / "mixed.ply"
    path.write_bytes(head.encode() + places.tobytes() + faces)
    with pytest.raises(InputError, match="triangles and larger polygons mixed"):
        gm.load_mesh(path)


def test_vertices_on_a_plane_of_two_axes_are_refused(tmp_path):
    path = tmp_path / "flat.obj"
    path.write_text("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"flat\.obj: vertices have no three coord"):
        gm.load_mesh(path)

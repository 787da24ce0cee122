import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ginn_jax import mesh as gm
from ginn_jax.errors import InputError, InputWarning

ASSETS = Path(__file__).parents[2] / "shared" / "assets" / "meshes"
COORDINATE = st.floats(-10, 10, width=32)
CORNERS = hnp.arrays(
    np.float64,
    st.tuples(st.integers(1, 12), st.just(3), st.just(3)),
    elements=COORDINATE,
)


def soup(corners):
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


def heron(corners):
    a, b, c = (
        np.linalg.norm(corners[:, i] - corners[:, i - 1], axis=1) for i in range(3)
    )
    s = (a + b + c) / 2
    return np.sqrt(np.maximum(s * (s - a) * (s - b) * (s - c), 0))


def clear_cut(corners):
    """No triangle is nearly, but not exactly, without area."""
    return corners[heron(corners) > 1e-2 * max(np.ptp(corners), 1)]


def signed_volume(mesh):
    return sum(np.linalg.det(mesh.vertices[f].astype(float)) for f in mesh.faces) / 6


def cube(size=1.0, inside_out=False):
    solid = trimesh.creation.box((size, size, size))
    faces = solid.faces[:, ::-1] if inside_out else solid.faces
    return np.asarray(solid.vertices), np.asarray(faces)


def joined(*parts):
    shift = np.cumsum([0, *(len(v) for v, _ in parts)])
    faces = [f + s for (_, f), s in zip(parts, shift, strict=False)]
    return np.concatenate([v for v, _ in parts]), np.concatenate(faces)


def one_line(message):
    return "^" + message + r"[^\n]*\Z"


@given(CORNERS, st.lists(st.integers(0, 11), max_size=5))
def test_degenerate_faces_are_dropped_and_counted(corners, repeated):
    corners = clear_cut(corners)
    assume(len(corners))
    vertices, faces = soup(corners)
    bad = np.array([[faces[i % len(faces), 0]] * 2 + [0] for i in repeated], int)
    material = np.arange(len(faces) + len(bad))
    both = np.concatenate([faces, bad.reshape(-1, 3)])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = gm.make_mesh(vertices, both, material)
    told = [str(w.message) for w in caught if "dropped" in str(w.message)]
    expected = f"dropped {len(bad)} of {len(both)} faces: they have zero area"
    assert told == ([expected] if repeated else [])
    assert mesh.vertices.dtype == np.float32
    assert mesh.faces.dtype == mesh.material.dtype == np.int32
    np.testing.assert_array_equal(mesh.material, np.arange(len(faces)))
    np.testing.assert_allclose(
        np.sort(mesh.vertices[mesh.faces], axis=1), np.sort(corners, axis=1), rtol=1e-6
    )


@pytest.mark.parametrize(
    ("vertices", "faces", "material", "message"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3), int), None, "mesh: empty"),
        (np.eye(3), np.zeros((0, 3), int), None, "mesh: empty"),
        (np.eye(2), np.array([[0, 1, 1]]), None, "mesh: wrong shape"),
        (np.eye(3), np.array([[0, 1, 2]]) + 0.5, None, "mesh: wrong shape"),
        (
            np.eye(3) * [np.nan, 1, 1],
            np.array([[0, 1, 2]]),
            None,
            "mesh: 3 vertices are",
        ),
        (
            np.diag([1, 1, 1e300]),
            np.array([[0, 1, 2]]),
            None,
            "mesh: 1 vertices are not",
        ),
        (
            np.eye(3),
            np.array([[0, 1, 3]]),
            None,
            r"mesh: a face index is outside 0\.\.2",
        ),
        (np.eye(3), np.array([[0, 1, -1]]), None, "mesh: a face index is outside"),
        (np.eye(3), np.array([[0, 1, 1]]), None, "mesh: all faces have zero area"),
        (
            np.eye(3),
            np.array([[0, 1, 2]]),
            np.zeros(2),
            "mesh: give one material a face",
        ),
    ],
)
def test_bad_arrays_are_refused_in_one_line(vertices, faces, material, message):
    with pytest.raises(InputError, match=one_line(message)):
        gm.make_mesh(vertices, faces, material)


@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_inside_out_parts_are_turned(offset):
    vertices, faces = cube(inside_out=True)
    with pytest.warns(InputWarning, match="^turned 1 closed"):
        mesh = gm.make_mesh(vertices + offset, faces)
    assert signed_volume(mesh) == pytest.approx(1, abs=1e-3)
    far = cube()[0] + [3, 0, 0], cube()[1]
    with pytest.warns(InputWarning, match="^turned 1 closed"):
        mesh = gm.make_mesh(*joined((2 * vertices, faces), far))
    assert signed_volume(mesh) == pytest.approx(9)


@pytest.mark.parametrize("inside_out", [False, True])
def test_cavities_stay_cavities(inside_out):
    parts = joined(cube(2, inside_out), cube(1, not inside_out))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if inside_out else "error")
        mesh = gm.make_mesh(*parts)
    assert signed_volume(mesh) == pytest.approx(7)


def test_open_and_right_meshes_are_left_alone():
    vertices, faces = cube(inside_out=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = gm.make_mesh(vertices, faces[1:])
        np.testing.assert_array_equal(mesh.faces, faces[1:])
        apart = gm.make_mesh(*soup(np.array(cube()[0][cube()[1]])))
    assert signed_volume(apart) == pytest.approx(1)


@given(CORNERS)
def test_unit_box_has_longest_side_one_and_is_idempotent(corners):
    corners = clear_cut(corners)
    assume(len(corners))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mesh = gm.fit_unit_box(gm.make_mesh(*soup(corners)))
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    assert (high - low).max() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(low, -high, atol=1e-6)
    again = gm.fit_unit_box(mesh)
    np.testing.assert_allclose(again.vertices, mesh.vertices, atol=1e-6)
    cloud = gm.Samples(
        mesh.vertices * 3 + 1, mesh.vertices, np.zeros(len(mesh.vertices))
    )
    fitted = gm.fit_unit_box_points(cloud)
    np.testing.assert_allclose(fitted.position, mesh.vertices, atol=1e-5)
    np.testing.assert_array_equal(fitted.normal, cloud.normal)


def test_unit_box_refuses_a_point():
    point = gm.Samples(np.ones((4, 3), "f4"), np.ones((4, 3), "f4"), np.zeros(4, "i4"))
    with pytest.raises(InputError, match=one_line("object: all points coincide")):
        gm.fit_unit_box_points(point)


@given(CORNERS, st.integers(0, 2**32))
def test_samples_lie_on_their_triangles(corners, seed):
    corners = clear_cut(corners)
    assume(len(corners))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # The material tells which triangle a sample is from.
        mesh = gm.make_mesh(*soup(corners), np.arange(len(corners)))
    samples = gm.sample_surface(mesh, 64, seed=seed)
    a, b, c = np.moveaxis(
        mesh.vertices[mesh.faces].astype(float)[samples.material], 1, 0
    )
    basis = np.stack([b - a, c - a, samples.normal], -1)
    u, v, w = np.linalg.solve(basis, (samples.position - a)[..., None])[..., 0].T
    assert np.abs(w).max() < 1e-4
    assert min(u.min(), v.min(), (1 - u - v).min()) > -1e-3
    np.testing.assert_allclose(np.linalg.norm(samples.normal, axis=1), 1, atol=1e-5)
    for edge in (b - a, c - a):
        assert np.abs((samples.normal * edge).sum(-1)).max() < 1e-4
    assert (np.linalg.det(basis) > 0).all()
    same = gm.sample_surface(mesh, 64, seed=seed)
    np.testing.assert_array_equal(samples.position, same.position)


@settings(max_examples=20)
@given(CORNERS)
def test_samples_are_uniform_by_area(corners):
    corners = clear_cut(corners)
    assume(len(corners))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mesh = gm.make_mesh(*soup(corners), np.arange(len(corners)))
    count, share = 20_000, heron(corners) / heron(corners).sum()
    samples = gm.sample_surface(mesh, count, seed=7)
    found = np.bincount(samples.material, minlength=len(corners))
    deviation = np.sqrt(count * share * (1 - share))
    assert (np.abs(found - count * share) <= 6 * deviation + 1).all()
    middle = mesh.vertices[mesh.faces].astype(float).mean(1)[samples.material]
    spread = np.ptp(corners)
    assert np.abs((samples.position - middle).mean(0)).max() < 6 * spread / count**0.5


@given(st.floats(0.1, 3), st.floats(-2, 2))
def test_ground_faces_up_just_below_the_lowest_vertex(half_extent, lowest):
    vertices, faces = cube()
    mesh = gm.make_mesh(np.add(vertices, [0, lowest + 0.5, 0]), faces)
    both = gm.add_ground(mesh, half_extent)
    assert both.vertices.dtype == np.float32
    np.testing.assert_array_equal(both.material, [0] * len(faces) + [1, 1])
    corners = both.vertices[both.faces[-2:]].astype(float)
    gap = mesh.vertices[:, 1].min() - corners[..., 1]
    np.testing.assert_allclose(gap, gm.GROUND_GAP, atol=1e-6)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normal[:, 1] > 0).all()
    assert heron(corners).sum() == pytest.approx(4 * half_extent**2, rel=1e-4)
    np.testing.assert_allclose(np.abs(corners[..., [0, 2]]), half_extent, rtol=1e-6)


def test_ground_samples_match_the_density_of_the_cloud():
    mesh = gm.make_mesh(*cube())
    cloud = gm.sample_surface(mesh, 6000, seed=1)  # 1000 a unit of area
    both = gm.add_ground_samples(cloud, 0.8, seed=2)
    ground = both.position[both.material == 1]
    assert len(ground) == pytest.approx(1000 * 1.6**2, rel=0.2)
    np.testing.assert_array_equal(
        both.normal[both.material == 1], [[0, 1, 0]] * len(ground)
    )
    np.testing.assert_allclose(ground[:, 1], -0.5, atol=1e-3)
    assert 0.75 < np.abs(ground[:, [0, 2]]).max() <= 0.8
    with pytest.raises(InputError, match=one_line("point cloud: fewer than 9")):
        gm.add_ground_samples(gm.Samples(*(a[:8] for a in cloud)), seed=0)


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


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.ply", None, "no such file"),
        ("empty.obj", b"", "cannot be read"),
        (
            "cut.ply",
            trimesh.creation.box().export(file_type="ply")[:300],
            "cannot be read",
        ),
        ("wrong.glb", b"glTF\0\0\0\0", "cannot be read"),
        ("note.txt", b"hello", "cannot be read"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, name, content, message):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(
        InputError, match=one_line(f"{re.escape(str(path))}: {message}")
    ):
        gm.load_mesh(path)


def test_messages_of_a_file_name_it(tmp_path):
    solid = trimesh.creation.box()
    solid.invert()
    solid.export(tmp_path / "inverted.ply")
    with pytest.warns(
        InputWarning, match=one_line(r".*inverted\.ply: turned 1 closed")
    ):
        gm.load_mesh(tmp_path / "inverted.ply")
    solid.vertices[0] = np.nan
    solid.export(tmp_path / "nan.ply")
    with pytest.raises(
        InputError, match=one_line(r".*nan\.ply: mesh: 1 vertices are not")
    ):
        gm.load_mesh(tmp_path / "nan.ply")


def write_points(path, rows, names=("x", "y", "z", "nx", "ny", "nz")):
    head = [f"element vertex {len(rows)}", *(f"property float {n}" for n in names)]
    body = [" ".join(f"{value:.9g}" for value in row) for row in rows]
    lines = ["ply", "format ascii 1.0", *head, "end_header", *body]
    path.write_text("\n".join(lines) + "\n")
    return path


@settings(max_examples=25)
@given(
    hnp.arrays(
        np.float32, st.tuples(st.integers(2, 9), st.just(6)), elements=COORDINATE
    )
)
def test_point_clouds_load_with_unit_normals(tmp_path_factory, rows):
    assume((np.linalg.norm(rows[:, 3:].astype(float), axis=1) > 1e-3).all())
    path = write_points(tmp_path_factory.mktemp("points") / "cloud.ply", rows)
    samples = gm.load_points(path)
    np.testing.assert_allclose(samples.position, rows[:, :3], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(samples.normal, axis=1), 1, atol=1e-5)
    assert ((samples.normal * rows[:, 3:]).sum(1) > 0).all()
    np.testing.assert_allclose(np.cross(samples.normal, rows[:, 3:]), 0, atol=1e-4)
    np.testing.assert_array_equal(samples.material, 0)


def test_bad_point_clouds_are_refused_in_one_line(tmp_path):
    rows = np.arange(24.0).reshape(4, 6)
    bare = write_points(tmp_path / "bare.ply", rows[:, :3], ("x", "y", "z"))
    with pytest.raises(
        InputError, match=one_line(".*: the points have no normals; est")
    ):
        gm.load_points(bare)
    with pytest.raises(
        InputError, match=one_line(".*a point cloud, no triangles; use lo")
    ):
        gm.load_mesh(bare)
    trimesh.creation.box().export(tmp_path / "box.ply")
    with pytest.raises(
        InputError, match=one_line(".*a mesh, not a point cloud; use load")
    ):
        gm.load_points(tmp_path / "box.ply")
    rows[0, 3:], rows[1, 4], rows[2, 0] = 0, np.nan, np.inf
    with pytest.raises(
        InputError, match=one_line(".*: 3 points have a non-finite value")
    ):
        gm.load_points(write_points(tmp_path / "bad.ply", rows))


def test_folders_are_searched_and_sorted(tmp_path):
    with pytest.raises(InputError, match=one_line(".*: no mesh in this folder")):
        gm.find_meshes(tmp_path)
    with pytest.raises(InputError, match=one_line(".*: no such file or folder")):
        gm.find_meshes(tmp_path / "none")
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
        samples = gm.sample_surface(gm.add_ground(mesh), 2000, seed=0)
        assert np.isfinite(samples.position).all()
        assert set(samples.material) == {0, 1}

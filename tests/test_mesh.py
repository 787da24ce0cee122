"""Meshes made of arrays, the unit box and the ground."""

import warnings

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from triangles import CORNERS, clear_cut, cube, heron, soup

from ginn_jax import mesh as gm
from ginn_jax import samples as gs


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
    cloud = gs.Samples(
        mesh.vertices * 3 + 1, mesh.vertices, np.zeros(len(mesh.vertices))
    )
    fitted = gs.fit_unit_box_points(cloud)
    np.testing.assert_allclose(fitted.position, mesh.vertices, atol=1e-5)
    np.testing.assert_array_equal(fitted.normal, cloud.normal)


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


def test_a_mesh_made_by_hand_becomes_arrays():
    vertices, faces = cube()
    by_hand = gm.Mesh(
        np.asarray(vertices).tolist(), np.asarray(faces, np.uint8), np.zeros(12)
    )
    mesh = gm.check_mesh(by_hand)
    assert mesh.vertices.dtype == np.float32
    assert mesh.faces.dtype == mesh.material.dtype == np.int32
    made = gm.make_mesh(vertices, faces)
    for found, expected in zip(mesh, made, strict=True):
        np.testing.assert_array_equal(found, expected)
    seen = [gs.sample_surface(m, 50, seed=0).position for m in (by_hand, made)]
    np.testing.assert_array_equal(*seen)

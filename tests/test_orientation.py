"""Closed parts face outward."""

import warnings

import numpy as np
import pytest
from triangles import cube, signed_volume, soup

from ginn_jax import mesh as gm
from ginn_jax.errors import InputWarning
from ginn_jax.orientation import _closed


def joined(*parts):
    shift = np.cumsum([0, *(len(v) for v, _ in parts)])
    faces = [f + s for (_, f), s in zip(parts, shift, strict=False)]
    return np.concatenate([v for v, _ in parts]), np.concatenate(faces)


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


@pytest.mark.parametrize("wrong", [(True, True), (True, False), (False, True)])
def test_bodies_that_touch_are_turned_each_by_itself(wrong):
    """A face between them has four faces at each of its edges."""
    (vertices, faces), (_, other) = (cube(inside_out=w) for w in wrong)
    beside = vertices + np.array([np.ptp(vertices[:, 0]), 0, 0])
    with pytest.warns(InputWarning, match=f"^turned {sum(wrong)} closed"):
        mesh = gm.make_mesh(*joined((vertices, faces), (beside, other)))
    assert signed_volume(mesh) == pytest.approx(2)


def test_many_inside_out_parts_are_turned_at_once():
    """Each is compared with what is around it, not with all: no part is, of these."""
    vertices, faces = cube(0.5, inside_out=True)
    parts = [(vertices + np.array([3 * i, 0, 0]), faces) for i in range(40)]
    parts += [(vertices + np.array([3 * i, 3, 0]), faces[:, ::-1]) for i in range(60)]
    with pytest.warns(InputWarning, match="^turned 40 closed"):
        mesh = gm.make_mesh(*joined(*parts))
    assert signed_volume(mesh) == pytest.approx(100 * 0.5**3, rel=1e-4)


def test_edges_of_many_parts_are_told_apart():
    """Parts times edges would be beyond 64 bits if all were numbered together."""
    faces = np.array([[0, 1, 2], [2, 1, 0], [0, 1, 2]], np.int64)
    faces[2] += 4_000_000
    closed = _closed(faces, np.array([0, 0, 3_000_000]))
    assert len(closed) == 3_000_001
    assert closed[0]
    assert not closed[3_000_000]

"""Closed parts face outward."""

import warnings

import numpy as np
import pytest
from triangles import cube, signed_volume, soup

from ginn_jax import mesh as gm
from ginn_jax.errors import InputWarning


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

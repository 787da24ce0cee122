"""Normals as they are stored: two numbers on an unfolded octahedron."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from strategies import unit_rows

from ginn_jax.lit_clouds import from_octahedron, to_octahedron

AXES = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)


def test_axes_are_exact():
    code = to_octahedron(AXES)
    assert code.dtype == np.int16
    assert len(np.unique(code, axis=0)) == 6
    np.testing.assert_array_equal(from_octahedron(code), AXES)


@given(hnp.arrays(np.float32, (20, 3), elements=st.floats(-1, 1, width=32)))
def test_octahedron_keeps_directions(rows):
    """Also where it is folded: edges, and components that are zero or tiny."""
    normals = unit_rows(rows)
    found = from_octahedron(to_octahedron(normals))
    assert np.abs(found.astype(float) - normals).max() < 1e-4


def test_every_code_is_a_direction_of_its_own():
    """All of a coarse grid of codes come back, but the corners, which are one point."""
    grid = np.linspace(-32766, 32766, 81).astype(np.int16)
    code = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(to_octahedron(from_octahedron(code)), code, atol=1)

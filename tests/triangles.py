"""Triangles as hypothesis draws them, and a cube; their areas and volumes."""

import numpy as np
import trimesh
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

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

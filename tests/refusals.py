"""Tables of arguments that cannot be meant, and the one way they are refused."""

from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
import trimesh

from ginn_jax import mesh
from ginn_jax.errors import InputError

KEY = jax.random.key(0)
NAN, INF = float("nan"), float("inf")
POINTS = np.random.default_rng(0).uniform(size=(20, 3)).astype(np.float32)
UP = np.tile(np.float32([0, 1, 0]), (20, 1))
WORDS = np.array([["a", "b", "c"]] * 20)
RAGGED = [[1.0, 2, 3], [1.0, 2]]
SHAPE = trimesh.creation.box()
BOX = mesh.make_mesh(SHAPE.vertices, SHAPE.faces)

# What no points with normals may be.
PLACES = [
    (
        {"points": POINTS[:, :2]},
        r"points \(20, 2\) and normals .* must both be \[N, 3\]",
    ),
    ({"normals": UP[:5]}, r"normals \(5, 3\) must both be \[N, 3\]"),
    ({"points": POINTS * NAN}, "points holds non-finite .*: drop"),
    ({"normals": UP * NAN}, "normals are non-finite or not of unit length"),
    ({"normals": UP / 2}, "normals are .* not of unit length: divide"),
]

# For each function: what it is told, by name or in order, and what it says to that.
Table = dict[Any, list[tuple[Any, str]]]


class Row(NamedTuple):
    """What is called, with what, what is said."""

    call: Any
    given: Any
    message: str


def each_row(table: Table):
    """A test of every row."""
    rows = [
        Row(call, given, said) for call, rows in table.items() for given, said in rows
    ]
    return pytest.mark.parametrize("row", rows, ids=lambda row: f"{row.message[:30]}")


def assert_refused(row):
    """In one line that names the argument."""
    named = isinstance(row.given, dict)
    names, rest = (row.given, ()) if named else ({}, row.given)
    with pytest.raises(InputError, match=row.message) as caught:
        row.call(*rest, **names)
    assert str(caught.value).isprintable()

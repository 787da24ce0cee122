"""Clouds as hypothesis draws them, padded to fixed shapes: one compile serves all."""

from typing import NamedTuple

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ginn_jax.packets import EdgeLimit

POINTS, QUERIES = 32, 16
RADII = st.sampled_from([0.25, 0.1, 1.0])
# Enough for every pair that padded clouds can have, and all columns of a grid.
ALL_PAIRS = EdgeLimit(1 << 16, POINTS * POINTS, 64, POINTS * POINTS)
SEEDS = st.integers(0, 2**31 - 1)
UNIT = st.floats(-1, 1, width=32, allow_subnormal=False)
# Multiples of the radii: on the faces of cells, and at exactly the radius.
FACES = st.integers(-8, 8).map(lambda k: k * 0.125) | st.integers(-10, 10).map(
    lambda k: k * 0.1
)
FAR = st.sampled_from([1e4, -1e4, -37.5])


class Cloud(NamedTuple):
    """Points padded to a fixed number of rows, and which rows count."""

    position: np.ndarray
    mask: np.ndarray

    def real(self):
        """Position in float64 and row number of every point that counts."""
        rows = np.flatnonzero(self.mask)
        return np.asarray(self.position, np.float64)[rows], rows


def coordinates(elements, min_rows=0, max_rows=POINTS):
    rows = st.integers(min_rows, max_rows)
    return rows.flatmap(lambda n: hnp.arrays(np.float32, (n, 3), elements=elements))


def lines(max_rows=POINTS):
    """Collinear points at equal and unequal steps."""
    steps = hnp.arrays(np.float32, st.integers(1, max_rows), elements=FACES | UNIT)
    direction = hnp.arrays(np.float32, 3, elements=st.sampled_from([-1, 0, 0.5, 1]))
    return st.builds(np.outer, steps, direction)


@st.composite
def clouds(draw, max_rows=POINTS):
    """[n, 3] float32: scattered, on cell faces, collinear, repeated, with outliers."""
    kinds = (
        coordinates(UNIT, 0, max_rows),
        coordinates(FACES, 0, max_rows),
        coordinates(UNIT | FACES, 0, max_rows),
        coordinates(UNIT | FACES | FAR, 0, max_rows),
        lines(max_rows),
    )
    cloud = draw(st.one_of(*kinds))
    if len(cloud) and draw(st.booleans()):
        row = st.integers(0, len(cloud) - 1)
        cloud = cloud[draw(st.lists(row, min_size=1, max_size=max_rows))]
    return cloud.astype(np.float32)


@st.composite
def padded(draw, rows=POINTS, source=None):
    """A cloud of a fixed number of rows, some masked, the padding full of garbage."""
    cloud = draw(clouds(rows) if source is None else source)
    garbage = draw(st.sampled_from([0.0, 0.25, 1e9, np.nan]))
    return pad(cloud, rows, draw(hnp.arrays(bool, rows)), garbage)


def pad(cloud, rows, wanted=True, garbage=0.0):
    """Append rows of garbage; rows that are not wanted become garbage too."""
    mask = (np.arange(rows) < len(cloud)) & wanted
    position = np.full((rows, 3), garbage, np.float32)
    position[: len(cloud)] = cloud
    position[~mask] = garbage
    return Cloud(position, mask)


def lattice(rows, min_rows=0):
    """Points on a grid of 2^-8, so that moving or doubling them rounds nothing."""
    steps = st.integers(-256, 256).map(lambda k: k / 256)
    return coordinates(steps, min_rows, rows)


def unit_rows(rows):
    """Rows of unit length, up where they are nearly nothing."""
    rows = rows.astype(np.float64)
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = np.where(length < 1e-3, [0, 1, 0], rows / np.maximum(length, 1e-3))
    return rows.astype(np.float32)

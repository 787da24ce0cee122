"""Points by cell, in NumPy: a plain table for loops that search it point by point."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

# Cells an axis: rounding moves a point by less than `MARGIN` of so many cells. And in
# all: an empty cell costs a word.
LONGEST, MOST, MARGIN = 1000, 1 << 19, 1e-3


class Cells(NamedTuple):
    """Points sorted by cell, z fastest; rows start[c] : start[c + 1] are in cell c.

    A point at `position` is in the cell floor((position - low) * rate) of each axis.
    """

    order: Int[np.ndarray, "N"]
    start: Int[np.ndarray, "T"]
    low: Float[np.ndarray, "3"]
    rate: np.float32
    shape: Int[np.ndarray, "3"]


def sort_into_cells(position: Float[np.ndarray, "N 3"], radius: float) -> Cells:
    """Cells at least so wide that all points within `radius` of any place lie in its
    own cell and the 26 around it."""
    along = np.ascontiguousarray(position.T)
    low, high = along.min(axis=1), along.max(axis=1)
    extent = high.astype(np.float64) - low
    width = max((1 + MARGIN) * radius, extent.max() / LONGEST)
    while np.prod(np.floor(extent / width) + 1) > MOST:
        width *= 1.25
    rate = np.float32(1 / width)
    x, y, z = np.floor((along - low[:, None]) * rate).astype(np.int64)
    shape = np.array([x.max(), y.max(), z.max()], np.int32) + 1
    number = (x * shape[1] + y) * shape[2] + z
    # Cell and row in one word: NumPy sorts numbers faster than it finds their order.
    bits = len(position).bit_length()
    order = np.sort((number << bits) + np.arange(len(position))) & ((1 << bits) - 1)
    start = np.zeros(np.prod(shape) + 1, np.int32)
    np.cumsum(np.bincount(number, minlength=len(start) - 1), out=start[1:])
    return Cells(order, start, low, rate, shape)

"""Points by cell, in NumPy: a plain table for loops that search it point by point."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from ginn_jax.outlying import box_of_most

# Cells an axis: rounding moves a point by less than `MARGIN` of so many cells. And in
# all: an empty cell costs a word.
LONGEST, MOST, MARGIN = 1000, 1 << 19, 1e-3


class Cells(NamedTuple):
    """Points sorted by the number of their cell, z fastest; rows start[c] :
    start[c + 1] are in cell c.

    A point at `position` is in the cell floor((position - low) * rate) of each axis, in
    the first or the last where that is beyond them.
    """

    order: Int[np.ndarray, "N"]
    number: Int[np.ndarray, "N"]
    start: Int[np.ndarray, "T"]
    low: Float[np.ndarray, "3"]
    rate: np.float32
    shape: Int[np.ndarray, "3"]


def sort_into_cells(position: Float[np.ndarray, "N 3"], radius: float) -> Cells:
    """Cells at least so wide that all points within `radius` of any place lie in its
    own cell and the 26 around it. What lies far from most is in cells of the border."""
    along = np.ascontiguousarray(position.T)
    low, high = along.min(axis=1), along.max(axis=1)
    box = box_of_most(position, (low, high), radius)
    if box is not None:
        low, high = np.maximum(low, box[0]), np.minimum(high, box[1])
        along = np.clip(along, low[:, None], high[:, None])
    # A little more, so that rounding below adds no cell.
    extent = (high.astype(np.float64) - low) * (1 + 1e-6)
    width = max((1 + MARGIN) * radius, extent.max() / LONGEST)
    most = max(MOST, 8 * len(position))
    while np.prod(np.floor(extent / width) + 1) > most:
        width *= 1.25
    rate = np.float32(1 / width)
    x, y, z = ((along - low[:, None]) * rate).astype(np.int32)
    shape = np.array([x.max(), y.max(), z.max()], np.int32) + 1
    number = (x * shape[1] + y) * shape[2] + z
    # Cell and row in one word: NumPy sorts numbers faster than it finds their order.
    bits = len(position).bit_length()
    words = np.sort((number.astype(np.int64) << bits) | np.arange(len(position)))
    order = words & ((1 << bits) - 1)
    number = (words >> bits).astype(np.int32)
    start = _starts(number, int(np.prod(shape)))
    return Cells(order, number, start, low, rate, shape)


def _starts(number: Int[np.ndarray, "N"], count: int) -> Int[np.ndarray, "T"]:
    """Of so many cells and the end, the first of these sorted points that is not before
    it. Most cells are empty: runs of them are written, points are not counted."""
    starts = np.ones(len(number), bool)
    np.not_equal(number[1:], number[:-1], out=starts[1:])
    first = np.flatnonzero(starts).astype(np.int32)
    ends = np.append(first, np.int32(len(number)))
    cells = np.concatenate([[-1], number[first], [count]])
    start = aligned(1, count + 1).view(np.int32)[0]
    start[:] = np.repeat(ends, np.diff(cells))
    return start


def thinned(cells: Cells, rows: Int[np.ndarray, "M"]) -> Cells:
    """The same cells with some of the sorted points only, given in ascending order."""
    number = cells.number.take(rows)
    start = _starts(number, len(cells.start) - 1)
    return cells._replace(order=cells.order.take(rows), number=number, start=start)


def aligned(rows: int, width: int) -> Float[np.ndarray, "M _"]:
    """Memory from where Dr.Jit can read packets: the start of a cache line."""
    memory = np.empty(rows * width + 16, np.float32)
    first = -memory.ctypes.data % 64 // 4
    return memory[first : first + rows * width].reshape(rows, width)


def rows_of(
    numbers: Float[np.ndarray, "N K"], rows: Int[np.ndarray, "M"]
) -> Float[np.ndarray, "M K"]:
    """Some rows of numbers in single precision, in `aligned` memory."""
    memory = aligned(len(rows), numbers.shape[1])
    # With "raise", NumPy would write them elsewhere first.
    return np.take(numbers, rows, 0, memory, "clip")


def in_line(numbers: Shaped[np.ndarray, "N"]) -> Shaped[np.ndarray, "N"]:
    """Numbers of 4 or 8 bytes, copied to such memory. Dr.Jit, which compiles a program
    for each kind of memory that it is given, is always given the same."""
    copy = aligned(1, numbers.nbytes // 4).view(numbers.dtype)[0]
    copy[:] = numbers
    return copy

"""Few points far from all others, as scans have: which, and what may be near them.

Cells and float32 are made for a box. One that holds a point a thousand times as far off
as the others lie apart has these in few cells, and cannot tell them apart.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

# Clouds with fewer are searched in no time whatever they are like.
MANY = 1 << 12
# So many points say where most lie: all but one in `SHARE` at either end of each axis.
ASKED, SHARE = 1 << 10, 1 << 6
# So many times as far apart as most are the farthest where a box is not for all, and so
# many radii: a grid has finer cells than that.
FAR_OFF, WIDE = 8, 128

Box = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]


class Parts(NamedTuple):
    """Rows of the queries in a box and of the points that may be near them; and of the
    other queries and what may be near those."""

    inner: tuple[Int[np.ndarray, "I"], Int[np.ndarray, "J"]]
    outer: tuple[Int[np.ndarray, "K"], Int[np.ndarray, "L"]]


def set_apart(
    points: Float[np.ndarray, "N 3"],
    bounds: Box,
    queries: Shaped[np.ndarray, "M 3"],
    radius: float,
) -> Parts | None:
    """Both halves of a search, or None where one box serves all; `bounds` are those of
    the points.

    Every pair closer than the radius is in one half, and none in both: each query is in
    one only.
    """
    reach = 1.001 * radius
    box = box_of_most(points, bounds, radius)
    if box is None:
        box = _box_of_all(bounds, queries, reach)
    if box is None:
        return None
    low, high = box
    inside = _within(queries, low, high)
    near = np.flatnonzero(_within(points, low - reach, high + reach))
    outer = np.flatnonzero(~_within(points, low + reach, high - reach))
    if 2 * len(outer) > len(points) or (len(near) == len(points) and inside.all()):
        return None  # a half would be no smaller
    return Parts((np.flatnonzero(inside), near), (np.flatnonzero(~inside), outer))


def box_of_most(
    points: Float[np.ndarray, "N 3"], bounds: Box, radius: float
) -> Box | None:
    """A cube three times as wide as what all but a few points take up, around them, if
    others lie far from it; `bounds` are those of all."""
    extent = (bounds[1] - bounds[0]).max()
    if len(points) < MANY or extent < WIDE * radius:
        return None
    some = np.sort(points[:: len(points) // ASKED], axis=0)
    few = len(some) // SHARE
    low, high = some[few], some[-1 - few]
    width = (high - low).max()
    if extent <= FAR_OFF * width:
        return None
    middle = 0.5 * low + 0.5 * high
    return middle - 1.5 * width, middle + 1.5 * width


def bounds_of(points: Float[np.ndarray, "N 3"]) -> Box:
    """The lowest and the highest corner of a box around some points."""
    return points.min(axis=0), points.max(axis=0)


def count_outlying(points: Float[np.ndarray, "N 3"]) -> int:
    """How many points lie far from all others."""
    box = box_of_most(points, bounds_of(points), 0.0) if len(points) else None
    return 0 if box is None else int((~_within(points, *box)).sum())


def _box_of_all(
    bounds: Box, queries: Shaped[np.ndarray, "M 3"], reach: float
) -> Box | None:
    """What is within reach of all points, if queries lie far from it."""
    low, high = bounds
    far = FAR_OFF * max((high - low).max(), reach)
    if queries.min() >= low.min() - far and queries.max() <= high.max() + far:
        return None
    return low - 1.001 * reach, high + 1.001 * reach


def _within(
    points: Shaped[np.ndarray, "N 3"],
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, "N"]:
    """Which points lie in a box, its faces included."""
    return np.all((points >= low) & (points <= high), axis=1)

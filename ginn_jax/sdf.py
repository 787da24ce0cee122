"""Closed shapes from signed distances on a grid: smooth unions, cuts, relief, shells.

Distances are negative inside. The grid spans [-1, 1]^3; what would leave it is closed
at its border.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.ndimage import label
from skimage.measure import marching_cubes

Rng = np.random.Generator
Distance = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class Part(NamedTuple):
    """A primitive placed in the grid, united with (or cut from) the parts before it."""

    distance: Distance  # of local x, y, z
    reach: float  # the primitive lies within this distance of its centre
    centre: np.ndarray  # [3]
    rotation: np.ndarray = np.eye(3)  # [3 3], local to grid
    smooth: float = 0.0  # width of the fillet
    cut: bool = False


def field_of(
    parts: list[Part], size: int = 72, margin: float = 0.1
) -> Float[np.ndarray, "S S S"]:
    """Distance on a `size`^3 grid, right up to `margin` outside of each part."""
    axis = np.linspace(-1, 1, size, dtype=np.float32)
    field = np.ones((size, size, size), np.float32)
    for part in parts:
        reach = part.reach + part.smooth + margin
        low = np.searchsorted(axis, part.centre - reach)
        high = np.searchsorted(axis, part.centre + reach)
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        x, y, z = (
            (axis[s] - c).reshape([-1 if i == k else 1 for i in range(3)])
            for k, (s, c) in enumerate(zip(box, part.centre.astype("f4"), strict=True))
        )
        columns = part.rotation.T.astype(np.float32)
        distance = part.distance(*(r[0] * x + r[1] * y + r[2] * z for r in columns))
        sign = -1 if part.cut else 1
        field[box] = sign * _smooth_min(sign * field[box], distance, part.smooth)
    return field


def to_solid(field: Float[np.ndarray, "S S S"]) -> trimesh.Trimesh:
    """The zero level of a distance field: closed, facing outward, without slivers.

    Of several pieces the largest stays, and hollows that nothing reaches are filled.
    Where no grid point is inside there are no faces.
    """
    cell = 2 / (len(field) - 1)
    field = np.pad(field, 1, constant_values=cell)
    inside = ~_piece(~_largest_piece(field < 0), (0, 0, 0))
    if not inside.any():
        return trimesh.Trimesh()
    # Values near zero put three vertices at one grid corner: a face without area.
    clear = np.maximum(np.abs(field), 0.02 * cell) * np.where(inside, -1, 1)
    spacing = (cell, cell, cell)
    vertices, faces = marching_cubes(clear, 0, spacing=spacing)[:2]
    solid = trimesh.Trimesh(vertices, faces, process=False)
    if solid.volume <= 0:
        raise AssertionError("marching cubes came out inside out")
    return solid


def _largest_piece(inside: np.ndarray) -> np.ndarray:
    """The largest of the pieces that hang together along the axes, or nothing."""
    labels = _pieces(inside)
    sizes = np.bincount(labels.ravel(), minlength=2)
    return labels == 1 + sizes[1:].argmax()


def _piece(inside: np.ndarray, place: tuple[int, int, int]) -> np.ndarray:
    """The piece that the grid point `place` belongs to."""
    labels = _pieces(inside)
    return labels == labels[place]


def _pieces(inside: np.ndarray) -> np.ndarray:
    """The number of each grid point's piece, from 1 on; 0 outside."""
    labels = np.empty(inside.shape, np.int32)
    label(inside, output=labels)
    return labels


def _smooth_min(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    lowest = np.minimum(a, b)
    if width == 0:
        return lowest
    overlap = np.maximum(width - np.abs(a - b), 0) / width
    return lowest - overlap**2 * (width / 4)


def box(half: np.ndarray, rounding: float = 0.0) -> Distance:
    """A box of half sides `half` [3], its edges rounded inward."""

    def distance(x, y, z):
        sides = zip((x, y, z), half - rounding, strict=True)
        q = [np.abs(v) - h for v, h in sides]
        outer = sum(np.maximum(v, 0) ** 2 for v in q) ** 0.5
        return outer + np.minimum(np.maximum(np.maximum(*q[:2]), q[2]), 0) - rounding

    return distance


def ellipsoid(half: np.ndarray) -> Distance:
    """An ellipsoid of half axes `half` [3]; the distance is of first order."""

    def distance(x, y, z):
        a, b, c = half
        near = np.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2)
        slope = np.sqrt((x / a**2) ** 2 + (y / b**2) ** 2 + (z / c**2) ** 2)
        return near * (near - 1) / (slope + 1e-6)

    return distance


def cylinder(radius: float, half: float, taper: float = 0.0) -> Distance:
    """A cylinder along z, or a cone whose top is narrower by `taper` (0 to 1)."""

    def distance(x, y, z):
        wall = radius * (1 - taper * (z / half + 1) / 2)
        return np.maximum(np.sqrt(x**2 + y**2) - wall, np.abs(z) - half)

    return distance


def torus(ring: float, tube: float) -> Distance:
    """A torus about z of radii `ring` and `tube`."""
    return lambda x, y, z: np.hypot(np.hypot(x, y) - ring, z) - tube


def limb(start, end, radius: float, end_radius: float, smooth: float) -> Part:
    """A capsule from `start` to `end` [3] with a radius at each end."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    centre, half = (start + end) / 2, (end - start) / 2
    square = max(float(half @ half), 1e-9)

    def distance(x, y, z):
        t = np.clip((x * half[0] + y * half[1] + z * half[2]) / square, -1, 1)
        axis = [np.float32(h) * t for h in half]
        away = sum((v - a) ** 2 for v, a in zip((x, y, z), axis, strict=True)) ** 0.5
        return away - (radius + (end_radius - radius) * (t + 1) / 2)

    reach = square**0.5 + max(radius, end_radius)
    return Part(distance, reach, centre, smooth=smooth)


def random_part(rng: Rng, scale: float, centre, **settings) -> Part:
    """One of the primitives, of about half size `scale`, turned at random."""
    half = scale * rng.uniform(0.35, 1, 3)
    tube = scale * rng.uniform(0.12, 0.35)
    distance = [
        lambda: ellipsoid(half),
        lambda: box(half),
        lambda: box(half, 0.4 * half.min()),
        lambda: cylinder(half[0], half[2]),
        lambda: cylinder(half[0], half[2], 0.95),
        lambda: torus(scale - tube, tube),
    ][rng.integers(6)]()
    rotation = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    if rng.random() < 0.5:
        rotation = np.eye(3)[rng.permutation(3)]
    reach = float(np.linalg.norm(half)) + scale
    return Part(distance, reach, np.asarray(centre, float), rotation, **settings)

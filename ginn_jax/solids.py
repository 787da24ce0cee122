"""Closed triangle solids to build with: blocks, turned profiles, tubes, sheets."""

from collections.abc import Callable

import numpy as np
import trimesh
from jaxtyping import Float

Solid = trimesh.Trimesh
# Fractional parts of its multiples are all different and far apart.
GOLDEN = 0.6180339887498949


def join(solids: list[Solid]) -> Solid:
    """All solids in one mesh; where they overlap, both surfaces stay.

    Each grows about its middle by its own 1 to 2 parts in 10,000, so that solids that
    touch overlap: no ray can tell in which order it crosses faces that coincide.
    """
    solids = [
        _grown(solid, 1e-4 * (1 + i * GOLDEN % 1)) for i, solid in enumerate(solids)
    ]
    starts = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    faces = [solid.faces + start for solid, start in zip(solids, starts, strict=False)]
    vertices = np.concatenate([solid.vertices for solid in solids])
    return Solid(vertices, np.concatenate(faces), process=False)


def _grown(solid: Solid, share: float) -> Solid:
    middle = solid.bounds.mean(0)
    vertices = middle + (solid.vertices - middle) * (1 + share)
    return Solid(vertices, solid.faces, process=False)


def block(low, high) -> Solid:
    """A box between two corners [3]."""
    return trimesh.creation.box(bounds=np.sort([low, high], axis=0))


def turned(
    profile: Float[np.ndarray, "P 2"], sections: int = 24, flutes: float = 0.0
) -> Solid:
    """A profile of (radius, height) from axis to axis, bottom first, turned about +y.

    `flutes` is the depth of grooves along the side, one for every 6 sections.
    """
    solid = trimesh.creation.revolve(profile, sections=sections)
    x, y, z = solid.vertices.T
    groove = 1 - flutes * (1 + np.cos(sections / 6 * np.arctan2(y, x))) / 2
    solid.vertices = np.stack([x * groove, z, -y * groove], -1)
    return solid


def profile(radius, height) -> np.ndarray:
    """A (radius, height) line, closed to the axis at both ends."""
    return np.column_stack([np.r_[0, radius, 0], np.r_[height[0], height, height[-1]]])


def rod(start, end, radius: float, end_radius: float, sections: int = 8) -> Solid:
    """A straight rod between two points [3], tapered, with rounded ends."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(end - start))
    cap, top = 0.5 * radius, length + 0.5 * end_radius
    profile = [(0, -cap), (0.7 * radius, -0.7 * cap), (radius, 0)]
    profile += [(end_radius, length), (0.7 * end_radius, 0.3 * length + 0.7 * top)]
    solid = trimesh.creation.revolve([*profile, (0, top)], sections=sections)
    along = (end - start) / max(length, 1e-9)
    turn = np.array(trimesh.geometry.align_vectors([0, 0, 1], along))
    turn[:3, 3] = start
    return solid.apply_transform(turn)


def tube(path: Float[np.ndarray, "K 3"], radius: float, closed: bool) -> Solid:
    """A round tube along a curve; its ends meet if `closed`, else they are capped."""
    sides = 8
    ahead = np.gradient(path, axis=0)
    if closed:
        ahead = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    across = np.array([0.31, 0.9, 0.29]) - 0.9 * path / np.abs(path).max()
    first = np.cross(ahead, across)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(ahead, first)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)[:, None]
    ring = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
    vertices = (path[:, None] + radius * ring).reshape(-1, 3)
    faces = _tube_faces(len(path), sides, closed)
    if not closed:
        fan = [[0, i + 1, i] for i in range(1, sides - 1)]
        far = [[0, i, i + 1] for i in range(1, sides - 1)]
        last = len(vertices) - sides
        faces = np.concatenate([faces, fan, np.array(far) + last])
    return Solid(vertices, faces, process=False)


def sheet(
    height: Callable[[np.ndarray, np.ndarray], np.ndarray],
    thickness: float,
    size: int = 32,
) -> Solid:
    """The surface y = height(x, z) over [-1, 1]^2, `thickness` thick."""
    axis = np.linspace(-1, 1, size)
    x, z = (v.ravel() for v in np.meshgrid(axis, axis, indexing="ij"))
    top = np.stack([x, height(x, z), z], -1)
    index = np.arange(size * size).reshape(size, size)
    near, far = index[:-1], index[1:]
    quads = (near[:, :-1], near[:, 1:], far[:, 1:], far[:, :-1])
    a, b, c, d = (v.ravel() for v in quads)
    up = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    rim = np.concatenate(
        [index[0], index[1:, -1], index[-1, -2::-1], index[-2:0:-1, 0]]
    )
    follow, count = np.roll(rim, -1), size * size
    wall = [np.stack([follow, rim, rim + count], -1)]
    wall += [np.stack([follow, rim + count, follow + count], -1)]
    faces = np.concatenate([up, up[:, ::-1] + count, *wall])
    return Solid(np.concatenate([top, top - [0, thickness, 0]]), faces, process=False)


def _tube_faces(rings: int, sides: int, closed: bool) -> np.ndarray:
    index = np.arange(rings * sides).reshape(rings, sides)
    after = np.roll(index, -1, axis=0) if closed else index[1:]
    here = index if closed else index[:-1]
    a, b = here.ravel(), np.roll(here, -1, axis=1).ravel()
    c, d = np.roll(after, -1, axis=1).ravel(), after.ravel()
    return np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])

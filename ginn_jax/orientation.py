"""Which way closed surfaces face: inside-out parts of a mesh are turned outward.

A part is a set of faces connected by edges. Vertices at one position count as one, but
for parts that are closed as the file has them: bodies that touch stay apart. A part is
closed if every edge is run through equally often in both directions; only then is
its signed volume, and so its orientation, defined. Open parts are left as they are.
"""

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int


def turn_outward(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Int[np.ndarray, "F 3"], int]:
    """The faces with inside-out closed parts turned, and how many parts were turned.

    If the closed parts together have negative volume, all of them are turned. Then a
    part of negative volume is turned, unless it lies wholly inside the solid of other
    parts: that is the wall of a cavity, and right as it is.
    """
    _, point = np.unique(vertices, axis=0, return_inverse=True)
    welded = point.reshape(-1)[faces]
    parts = _parts(faces, welded)
    corners = vertices.astype(np.float64)[faces] - vertices.mean(axis=0, dtype=float)
    volume, thin = _volumes(corners, parts)
    volume = np.where(_closed(welded, parts), volume, 0)
    turn = (volume != 0) & (volume.sum() < -thin.sum())
    solid = np.sign(volume)
    volume = np.where(turn, -volume, volume)
    low, high = _boxes(corners, parts)
    for part in np.flatnonzero(volume < -thin):
        probes = corners[parts == part].mean(axis=1)
        probes = probes[:: -(-len(probes) // 4)]
        # What is open, or not around it, winds around nothing here.
        around = (low <= probes.max(axis=0)) & (high >= probes.min(axis=0))
        around = around.all(axis=1) & (solid != 0)
        around[part] = False
        others = around[parts]
        winding = _winding(probes, corners[others], solid[parts[others]])
        turn[part] ^= winding.min() < 0.5
    turn &= solid != 0
    flipped = np.where(turn[parts][:, None], faces[:, ::-1], faces)
    return flipped, int(turn.sum())


def _parts(
    faces: Int[np.ndarray, "F 3"], welded: Int[np.ndarray, "F 3"]
) -> Int[np.ndarray, "F"]:
    """The part of each face; of what is not closed as it is, by welded vertices."""
    parts = _connected_parts(faces)
    opened = ~_closed(faces, parts)[parts]
    if opened.any():
        parts[opened] = parts.max() + 1 + _connected_parts(welded[opened])
    return np.unique(parts, return_inverse=True)[1].reshape(-1)


def _boxes(
    corners: Float[np.ndarray, "F 3 3"], parts: Int[np.ndarray, "F"]
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Lowest and highest corner of each part."""
    low = np.full((parts.max() + 1, 3), np.inf)
    high = -low
    np.minimum.at(low, parts, corners.min(axis=1))
    np.maximum.at(high, parts, corners.max(axis=1))
    return low, high


def _connected_parts(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "F"]:
    shape = trimesh.Trimesh(np.zeros((faces.max() + 1, 3)), faces, process=False)
    pairs = trimesh.graph.face_adjacency(mesh=shape)
    return trimesh.graph.connected_component_labels(pairs, node_count=len(faces))


def _closed(
    faces: Int[np.ndarray, "F 3"], parts: Int[np.ndarray, "F"]
) -> Bool[np.ndarray, "P"]:
    start, end = faces, np.roll(faces, -1, axis=1)
    low, high = np.minimum(start, end), np.maximum(start, end)
    size = int(faces.max()) + 1
    known, number = np.unique(low.astype(np.int64) * size + high, return_inverse=True)
    key = parts[:, None].astype(np.int64) * len(known) + number.reshape(low.shape)
    keys, edge = np.unique(key, return_inverse=True)
    balance = np.bincount(edge.reshape(-1), np.sign(end - start).reshape(-1))
    open_edges = np.bincount(
        keys // len(known), balance != 0, minlength=parts.max() + 1
    )
    return open_edges == 0


def _volumes(
    corners: Float[np.ndarray, "F 3 3"], parts: Int[np.ndarray, "F"]
) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """Signed volume of each part, and what of it may be rounding (doubled sheets)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    tetrahedron = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    return np.bincount(parts, tetrahedron), 1e-6 * np.bincount(parts, area) ** 1.5


def _winding(
    probes: Float[np.ndarray, "Q 3"],
    corners: Float[np.ndarray, "F 3 3"],
    sign: Float[np.ndarray, "F"],
) -> Float[np.ndarray, "Q"]:
    """How often the surface, each face signed, winds around each probe.

    The sum of solid angles over 4 pi (van Oosterom and Strackee 1983).
    """
    a, b, c = np.moveaxis(corners[None] - probes[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
    triple = np.einsum("qfi,qfi->qf", a, np.cross(b, c))
    dot_ab, dot_bc, dot_ca = ((x * y).sum(-1) for x, y in ((a, b), (b, c), (c, a)))
    below = la * lb * lc + dot_ab * lc + dot_bc * la + dot_ca * lb
    return (2 * np.arctan2(triple, below) * sign).sum(axis=1) / (4 * np.pi)

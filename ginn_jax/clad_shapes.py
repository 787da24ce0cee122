"""Families of shapes clad in thin overlapping plates: shingles, boards, stones, scales.

Plates may be open at the back, as modellers leave out what they think nobody sees: the
surface below is then dark for no reason but the outside of a plate just above it.
"""

import numpy as np
import trimesh
from jaxtyping import Float

from ginn_jax.sdf import Rng
from ginn_jax.solids import Solid, block, join, rod

Vector = Float[np.ndarray, "3"]


def timber_house(rng: Rng) -> Solid:
    """Storeys that jut out, framed in beams, on stones, under a roof of shingles."""
    w, d = rng.uniform(0.3, 0.7, 2)
    level, solids = 0.0, []
    for _ in range(rng.integers(1, 4)):
        h = rng.uniform(0.2, 0.5)
        solids.append(block([-w, level, -d], [w, level + h, d]))
        solids += _clad_walls(rng, w, d, level, h)
        level, w, d = level + h, w * rng.uniform(1, 1.15), d * rng.uniform(1, 1.15)
    return join([*solids, *shingled_roof(rng, w, d, level)])


def well(rng: Rng) -> Solid:
    """A ring of stones, some under a roof of shingles on posts; or a round tower."""
    radius, rise = rng.uniform(0.3, 0.6), rng.uniform(0.05, 0.15)
    solids, count = [], int(rng.integers(6, 16))
    courses = rng.integers(2, 9)
    for row in range(courses):
        for angle in (np.arange(count) + 0.5 * (row % 2)) * 2 * np.pi / count:
            out = np.array([np.cos(angle), 0, np.sin(angle)])
            along = np.array([out[2], 0, -out[0]]) * 2 * np.pi * radius / count
            centre = radius * out + [0, row * rise, 0]
            size = rng.uniform(0.8, 1.0)
            solids.append(plate(centre, size * along, np.array([0, rise, 0]), 0.1, out))
    if rng.random() < 0.7:
        top = courses * rise + rng.uniform(0.3, 0.8)
        for x in (-radius, radius):
            solids.append(rod([x, 0, 0], [x, top + 0.2, 0], 0.03, 0.03))
        solids += shingled_roof(rng, radius, rng.uniform(0.3, 0.7), top)
    return join(solids)


def scaled(rng: Rng, host: Solid) -> Solid:
    """A solid under plates that stand off its surface: armour, straps, scales."""
    count, size = int(rng.integers(5, 120)), rng.uniform(0.03, 0.15)
    host = host.copy().apply_scale(1 / host.extents.max())
    chance = host.area_faces / host.area
    chosen = rng.choice(len(host.faces), count, p=chance / chance.sum())
    lift, opened, solids = rng.uniform(-0.2, 0.3), rng.random() < 0.5, [host]
    for centre, out in zip(
        host.triangles_center[chosen], host.face_normals[chosen], strict=True
    ):
        tangent = np.cross(out, rng.normal(size=3))
        tangent /= np.linalg.norm(tangent) + 1e-9
        along, up = tangent * size, np.cross(out, tangent) * size * rng.uniform(0.3, 2)
        thick = size * rng.uniform(0.05, 0.3)
        centre = centre + out * lift * size
        up = up + out * rng.normal(0, 0.2) * size
        solids.append(plate(centre, along, up, thick, out, opened))
    return join(solids)


def shingled_roof(rng: Rng, w: float, d: float, h: float) -> list[Solid]:
    """Two slopes of shingles on boards over [-w, w] x [-d, d], from height h."""
    ridge, eave = rng.uniform(0.2, 0.8), rng.uniform(0.02, 0.15)
    solids: list[Solid] = []
    for side in (-1.0, 1.0):
        corner = np.array([side * (w + eave), h, side * (d + eave)])
        along = np.array([0, 0, -side * 2 * (d + eave)])
        up = np.array([-side * (w + eave), ridge, 0])
        solids += cladding(rng, corner, along, up)
        if rng.random() < 0.7:
            middle = corner + (along + up) / 2
            solids.append(plate(middle, along, up, -0.03, _out(along, up)))
    if rng.random() < 0.5:
        x, z = rng.uniform(0.3, 0.6) * w, rng.uniform(-0.6, 0.6) * d
        solids.append(block([x, h, z], [x + 0.12, h + 1.2 * ridge, z + 0.12]))
    return solids


def cladding(rng: Rng, corner: Vector, along: Vector, up: Vector) -> list[Solid]:
    """Courses of overlapping plates over a parallelogram; its outside is along x up."""
    rows, columns = int(rng.integers(2, 9)), int(rng.integers(1, 9))
    overlap, tilt, gap = rng.uniform([0, 0, 0], [0.6, 0.25, 0.15])
    out, opened, missing = _out(along, up), rng.random() < 0.6, rng.uniform(0, 0.1)
    height = float(np.linalg.norm(up)) / rows
    thick, solids = height * rng.uniform(0.05, 0.3), []
    for row in range(rows):
        for column in range(columns):
            if rng.random() < missing:
                continue
            shift = 0.5 * (row % 2) / columns * (columns > 2)
            across = min((column + 0.5) / columns + shift, 1.0)
            centre = corner + across * along + (row + 0.5) / rows * up
            turn = rng.normal(0, 0.02) * along / columns
            tall = (1 + overlap) * up / rows - tilt * height * out + turn
            wide = along / columns * (1 - gap * rng.random())
            lift = (0.5 * tilt + 0.05 * rng.random()) * height
            solids.append(plate(centre + lift * out, wide, tall, thick, out, opened))
    return solids


def plate(
    centre: Vector,
    along: Vector,
    up: Vector,
    thickness: float,
    out: Vector,
    opened: bool = False,
) -> Solid:
    """A slab with two edges, from its centre outwards; no back face if `opened`."""
    slab = block([-0.5, -0.5, 0], [0.5, 0.5, 1])
    if opened:
        slab.update_faces(slab.face_normals[:, 2] > -0.5)
    frame = np.eye(4)
    frame[:3] = np.stack([along, up, thickness * out, centre], -1)
    corners = trimesh.transformations.transform_points(slab.vertices, frame)
    turned = np.linalg.det(frame[:3, :3]) < 0
    return Solid(corners, slab.faces[:, ::-1] if turned else slab.faces, process=False)


def _clad_walls(rng: Rng, w: float, d: float, low: float, h: float) -> list[Solid]:
    """Cladding or beams on the four walls of a storey."""
    solids: list[Solid] = []
    for turn in range(4):
        half, far = (w, d) if turn % 2 == 0 else (d, w)
        angle = turn * np.pi / 2
        across = np.array([np.cos(angle), 0, -np.sin(angle)])
        out = np.array([np.sin(angle), 0, np.cos(angle)])
        corner, up = far * out - half * across + [0, low, 0], np.array([0, h, 0])
        if rng.random() < 0.5:
            solids += cladding(rng, corner, 2 * half * across, up)
            continue
        opened = rng.random() < 0.5
        for _ in range(rng.integers(1, 7)):
            place = corner + rng.uniform(0.05, 0.95) * 2 * half * across + up / 2
            lean = rng.choice([0, 0, rng.uniform(-0.5, 0.5)]) * half * across
            beam = rng.uniform(0.02, 0.06) * across
            solids.append(plate(place, beam, up + lean, 0.03, out, opened))
    return solids


def _out(along: Vector, up: Vector) -> Vector:
    out = np.cross(along, up)
    return out / np.linalg.norm(out)

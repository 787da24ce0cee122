"""Families of closed shapes of turned, bent and branching solids.

Each takes a random generator and gives closed solids in one mesh of any size, +y up.
"""

from itertools import pairwise

import numpy as np
import trimesh

from ginn_jax.sdf import Rng
from ginn_jax.solids import Solid, join, profile, rod, sheet, tube, turned


def vase(rng: Rng) -> Solid:
    """A turned body: vase, goblet, bowl or column; hollow or solid, some fluted."""
    knots = rng.integers(3, 8)
    height = np.linspace(0, rng.uniform(0.3, 1.8), 40)
    radius = np.interp(
        height, np.linspace(0, height[-1], knots), rng.uniform(0.12, 0.5, knots)
    )
    if rng.random() < 0.7:
        radius = np.convolve(np.pad(radius, 4, "edge"), np.ones(9) / 9, "valid")
    if rng.random() < 0.3:
        radius *= 1 + 0.08 * np.sign(np.sin(height / height[-1] * rng.uniform(20, 60)))
    wall = rng.uniform(0.02, 0.06)
    if hollow := rng.random() < 0.6:
        keep = height > 2 * wall
        inner = np.maximum(radius[keep] - wall, 0.01)[::-1]
        radius, height = np.r_[radius, inner], np.r_[height, height[keep][::-1]]
    flutes = rng.uniform(0.05, 0.2) if rng.random() < 0.4 else 0.0
    body = turned(profile(radius, height), 6 * int(rng.integers(4, 13)), flutes)
    if hollow and rng.random() < 0.4:
        return join([body, _ring([radius[20], height[20], 0], 0.2, 0.03)])
    return body


def vessel(rng: Rng) -> Solid:
    """A wide hollow, round or cornered: cup, bowl, bucket, tub, crate; some filled."""
    wide, high = rng.uniform(0.25, 0.6), rng.uniform(0.3, 1.2)
    wall = rng.uniform(0.015, 0.08)
    height = np.linspace(0, high, 12)
    flare = rng.choice([0, 0, 0.3, 0.6]) * rng.uniform(-0.5, 1)
    belly = rng.choice([0, 0, 0.3]) * np.sin(np.pi * height / high)
    radius = wide * (1 + flare * (height / high - 0.5) + belly)
    keep = height > rng.uniform(1, 2) * wall
    inner = np.maximum(radius - wall, 0.05)[keep]
    line = profile(np.r_[radius, inner[::-1]], np.r_[height, height[keep][::-1]])
    solids = [turned(line, int(rng.choice([4, 4, 6, 24, 48, 72])))]
    if rng.random() < 0.4:
        size = rng.uniform(0.15, 0.4) * high
        solids.append(_ring([wide, high / 2, 0], size, rng.uniform(0.02, 0.06)))
    for _ in range(rng.choice([0, 0, 0, 1, 3])):
        size, away = rng.uniform(0.1, 0.4, 2) * wide
        around = rng.uniform(0, 2 * np.pi)
        place = [away * np.cos(around), size + wall, away * np.sin(around)]
        filling = trimesh.creation.icosphere(3, size)
        solids.append(filling.apply_translation(place))
    tipped = rng.choice([0, 0, 0.3, 2]) * rng.normal()
    tip = trimesh.transformations.rotation_matrix(tipped, [0, 0, 1])
    return join(solids).apply_transform(tip)


def plant(rng: Rng) -> Solid:
    """A trunk that forks again and again, bare or with leaves, perhaps in a pot."""
    solids: list[Solid] = []
    leaf = rng.choice([0, 1, 1])
    tips = [(np.zeros(3), rng.normal([0, 0.5, 0], [0.1, 0.1, 0.1]), 0.07)]
    spread, forks = rng.uniform(0.3, 0.9), rng.integers(2, 4)
    for _ in range(rng.integers(3, 5)):
        grown = []
        for root, way, radius in tips:
            solids.append(rod(root, root + way, radius, 0.7 * radius))
            for _ in range(forks):
                turn = rng.normal(0, spread, 3) + way / np.linalg.norm(way)
                turn *= (
                    np.linalg.norm(way) * rng.uniform(0.5, 0.9) / np.linalg.norm(turn)
                )
                grown.append((root + way, turn, max(0.65 * radius, 0.008)))
        tips = grown
    for root, way, radius in tips:
        solids.append(
            _leaf(rng, root, way) if leaf else rod(root, root + way, radius, 0.006)
        )
    if rng.random() < 0.4:
        solids.append(_pot(rng))
    return join(solids)


def bars(rng: Rng) -> Solid:
    """Springs, rings, knots, grilles and frames of thin tubes."""
    solids, t = [], np.linspace(0, 2 * np.pi, 240, endpoint=False)
    thin = rng.uniform(0.015, 0.06)
    for _ in range(rng.integers(1, 5)):
        p = rng.integers(2, 6)
        big = 1 + 0.4 * np.cos(p * t)
        knot = [big * np.cos(2 * t), 0.4 * np.sin(p * t), big * np.sin(2 * t)]
        spring = [np.cos(p * t), 0.15 * p * t - p / 3, np.sin(p * t)]
        ring = [np.cos(t), np.sin(t) * rng.uniform(0.4, 1), 0.1 * np.cos(p * t)]
        pick = rng.integers(3)
        path = np.stack([knot, spring, ring][pick], -1) * rng.uniform(0.2, 0.6)
        turn = trimesh.transformations.random_rotation_matrix(rng.random(3))
        turn[:3, 3] = rng.uniform(-0.3, 0.3, 3)
        knotted = tube(path, thin * rng.uniform(0.5, 1), closed=bool(pick != 1))
        solids.append(knotted.apply_transform(turn))
    corners = rng.uniform(-0.6, 0.6, (rng.integers(0, 8), 3))
    for start, end in pairwise(corners):
        solids.append(rod(start, end, thin, thin))
    for x in np.linspace(-0.5, 0.5, rng.choice([1, 9, 15]))[1:]:
        solids.append(rod([x, -0.5, 0], [x, 0.5, 0], 0.02, 0.02))
    return join(solids)


def wheel(rng: Rng) -> Solid:
    """A rim on thin spokes, some of which cross; a pair or a row of them on an axle."""
    hub, one = _spoked_rim(rng)
    copies, apart = int(rng.choice([1, 1, 2, 2, 5])), rng.uniform(0.3, 1.5)
    if copies == 1:
        return one
    solids = [rod([0, 0, 0], [0, 0, (copies - 1) * apart], 0.5 * hub, 0.5 * hub)]
    for i, angle in enumerate(rng.uniform(0, 2 * np.pi, copies)):
        turn = trimesh.transformations.rotation_matrix(angle, [0, 0, 1])
        turn[2, 3] = i * apart
        solids.append(one.copy().apply_transform(turn))
    return join(solids)


def cloth(rng: Rng) -> Solid:
    """Sheets that are bent, waved and creased, alone, stacked or crossing."""
    solids = []
    for _ in range(rng.integers(1, 6)):
        wave, phase = rng.normal(0, 4, (4, 2)), rng.uniform(0, 6, 4)
        bend, depth = rng.normal(0, 0.4, 2), rng.uniform(0.02, 0.12)
        sharp = rng.random() < 0.4

        def height(x, z, wave=wave, phase=phase, bend=bend, depth=depth, sharp=sharp):
            angle = np.stack([x, z], -1) @ wave.T + phase
            folds = np.abs(np.sin(angle)) if sharp else np.sin(angle)
            return bend[0] * x**2 + bend[1] * z**2 + depth * folds.sum(-1)

        solid = sheet(height, rng.uniform(0.02, 0.08), 48)
        solid.apply_scale(rng.uniform([0.2, 0.6, 0.2], 0.7))
        turn = trimesh.transformations.rotation_matrix(
            rng.normal(0, 0.8), trimesh.unitize(rng.normal(size=3))
        )
        turn[:3, 3] = rng.uniform(-0.3, 0.3, 3)
        solids.append(solid.apply_transform(turn))
    return join(solids)


def _ring(centre, radius: float, thickness: float) -> Solid:
    """A handle: a closed round tube about z."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    path = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1) * radius
    return tube(path + centre, thickness, closed=True)


def _spoked_rim(rng: Rng) -> tuple[float, Solid]:
    """The radius of the hub, and hub, spokes and rim about z; the rim's radius is 1."""
    count, thin = int(rng.integers(5, 40)), rng.uniform(0.004, 0.03)
    hub, wide = rng.uniform(0.04, 0.25), rng.uniform(0.02, 0.4)
    tyre, cross = rng.uniform(0.02, 0.15), rng.choice([0, 1, 3]) * 2 * np.pi / count
    angle = np.arange(count) * 2 * np.pi / count
    side = 0.5 * wide * (-1.0) ** np.arange(count)
    lean = cross * (-1.0) ** (np.arange(count) // 2)
    inner = np.stack([hub * np.cos(angle), hub * np.sin(angle), side], -1)
    outer = np.stack([np.cos(angle + lean), np.sin(angle + lean), 0 * side], -1)
    solids = [rod(a, b, thin, thin, 6) for a, b in zip(inner, outer, strict=True)]
    solids.append(_ring(np.zeros(3), 1.0, tyre))
    solids.append(rod([0, 0, -wide / 2], [0, 0, wide / 2], hub, hub, 12))
    return hub, join(solids)


def _leaf(rng: Rng, root: np.ndarray, way: np.ndarray) -> Solid:
    solid = trimesh.creation.icosphere(2, 1.0)
    size = rng.uniform(0.06, 0.16)
    solid.apply_scale([size, 0.1 * size + 0.008, 0.6 * size])
    turn = np.array(trimesh.geometry.align_vectors([1, 0, 0], trimesh.unitize(way)))
    turn[:3, 3] = root + way * (size / np.linalg.norm(way))
    return solid.apply_transform(turn)


def _pot(rng: Rng) -> Solid:
    wide, high = rng.uniform(0.15, 0.35), rng.uniform(0.15, 0.4)
    rim = wide * rng.uniform(1, 1.5)
    radius = np.array([wide, rim, 1.1 * rim, 1.1 * rim, 0.9 * rim, 0.9 * rim])
    height = np.array([-1, -0.25, -0.25, 0, 0, -0.15]) * high
    return turned(profile(radius, height), 24)

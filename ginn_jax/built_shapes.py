"""Families of shapes built of many closed solids: buildings, furniture, vehicles.

Each takes a random generator and gives closed solids in one mesh of any size, +y up;
the solids touch and interpenetrate, as those of modelled objects do.
"""

import numpy as np
import trimesh

from ginn_jax.curved_shapes import vase
from ginn_jax.sdf import Rng
from ginn_jax.solids import Solid, block, join, profile, rod, turned


def tower(rng: Rng) -> Solid:
    """Blocks and drums stacked with shifts, each storey with ledges."""
    level, solids = 0.0, []
    for _ in range(rng.integers(2, 9)):
        half, rise = rng.uniform(0.12, 0.5, 2), rng.uniform(0.04, 0.4)
        x, z = rng.normal(0, 0.08, 2)
        if rng.random() < 0.3:
            drum = turned(
                profile([half[0], half[0]], [0, rise]), 6 * int(rng.integers(1, 6))
            )
            solids.append(drum.apply_translation([x, level, z]))
        else:
            low, high = [x - half[0], level, z - half[1]], [x + half[0], 0, z + half[1]]
            solids.append(block(low, [high[0], level + rise, high[2]]))
            solids += _greebles(rng, solids[-1], int(rng.integers(0, 12)))
        level += rise
    return join(solids)


def stairs(rng: Rng) -> Solid:
    """A straight or winding stair, with posts and a rail, or a stepped pyramid."""
    count, rise, run = (
        rng.integers(4, 14),
        rng.uniform(0.06, 0.15),
        rng.uniform(0.1, 0.2),
    )
    width, wind = rng.uniform(0.2, 0.7), rng.choice([0, rng.uniform(0.1, 0.5)])
    floating, solids = rng.random() < 0.5, []
    for i in range(count):
        low = i * rise - (0.4 * rise if floating else i * rise + rise)
        steps = [block([0.05, low, 0], [0.05 + width, i * rise, 1.2 * run])]
        steps.append(
            rod([0.1, i * rise, run / 2], [0.1, i * rise + 0.3, run / 2], 0.015, 0.015)
        )
        turn = trimesh.transformations.rotation_matrix(i * wind, [0, 1, 0])
        turn[2, 3] = 0 if wind else i * run
        solids.append(join(steps).apply_transform(turn))
    if wind:
        solids.append(rod([0, -0.2, 0], [0, count * rise, 0], 0.1, 0.1, 16))
    return join(solids)


def house(rng: Rng) -> Solid:
    """Rooms with pierced walls on a slab, roofed or open, chimney and beams."""
    w, d, h, t = (
        *rng.uniform(0.4, 0.9, 2),
        rng.uniform(0.3, 0.8),
        rng.uniform(0.03, 0.07),
    )
    solids = [block([-w - t, -t, -d - t], [w + t, 0, d + t])]
    for side in (-1, 1):
        front = _pierced_wall(rng, w, h, t)
        solids.append(front.apply_translation([0, 0, side * d]))
        flank = _pierced_wall(rng, d - t, h, t)
        turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0])
        turn[0, 3] = side * (w - t)
        solids.append(flank.apply_transform(turn))
    for x in rng.uniform(-0.7, 0.7, rng.integers(0, 3)) * w:
        solids.append(block([x, 0, -d], [x + t, 0.9 * h, rng.uniform(-0.5, 0.9) * d]))
    if rng.random() < 0.6:
        solids += _roof(rng, w + 2 * t, d + 2 * t, h)
    solids += _greebles(rng, block([-w, 0, -d], [w, h, d]), int(rng.integers(0, 10)))
    return join(solids)


def shelf(rng: Rng) -> Solid:
    """A rack of boards and uprights, a back, and things standing on the boards."""
    w, h, d = rng.uniform(0.3, 0.9, 3) * [1, 1, 0.5]
    t, rows, columns = rng.uniform(0.01, 0.04), rng.integers(2, 6), rng.integers(1, 5)
    levels, posts = np.linspace(0, 2 * h, rows), np.linspace(-w, w, columns + 1)
    solids = [block([-w, y, -d], [w, y + t, d]) for y in levels]
    solids += [block([x - t, 0, -d], [x + t, 2 * h + t, d]) for x in posts]
    if rng.random() < 0.6:
        solids.append(block([-w, 0, -d - t], [w, 2 * h + t, -d]))
    gap = 2 * h / (rows - 1) - t
    for y in levels[:-1]:
        x = -w + 2 * t
        while x < w - 0.15:
            wide, high = rng.uniform(0.02, 0.12), rng.uniform(0.3, 0.9) * gap
            if rng.random() < 0.6:
                deep = d * rng.uniform(-0.6, 0.8)
                solids.append(
                    block([x, y + t, -0.9 * d], [x + wide, y + t + high, deep])
                )
            x += wide + rng.choice([0, 0.02, 0.2])
    return join(solids)


def table_and_chairs(rng: Rng) -> Solid:
    """A table, desk or bench with things on it, and some chairs around it."""
    w, d, h = rng.uniform(0.35, 0.9), rng.uniform(0.25, 0.6), rng.uniform(0.3, 0.6)
    solids = [_table(rng, w, d, h)] if rng.random() < 0.8 else []
    items = rng.integers(0, 5) if solids else 0
    for x, z in rng.uniform(-0.7, 0.7, (items, 2)) * [w, d]:
        item = vase(rng) if rng.random() < 0.5 else _crate(rng)
        item.apply_scale(rng.uniform(0.06, 0.2) / item.extents.max())
        solids.append(item.apply_translation([x, h - item.bounds[0, 1], z]))
    for _ in range(rng.integers(0 if solids else 1, 4)):
        chair = _chair(rng, h * rng.uniform(0.5, 0.8))
        turn = trimesh.transformations.rotation_matrix(rng.uniform(0, 6.3), [0, 1, 0])
        turn[[0, 2], 3] = rng.uniform(-1, 1, 2) * [w, d] * (len(solids) > 0)
        solids.append(chair.apply_transform(turn))
    return join(solids)


def vehicle(rng: Rng) -> Solid:
    """A hull with cab, wheels in arches, lamps, hatches, pipes and other fittings."""
    w, h, d = rng.uniform(0.2, 0.35), rng.uniform(0.12, 0.4), rng.uniform(0.5, 0.9)
    clear, radius = rng.uniform(0.05, 0.15), rng.uniform(0.08, 0.2)
    hull = block([-w, clear, -d], [w, clear + h, d])
    cab = block([-0.8 * w, clear + h, -0.4 * d], [0.8 * w, clear + 1.8 * h, 0.3 * d])
    top = cab.vertices[:, 1] > clear + h
    cab.vertices[top] *= [rng.uniform(0.6, 1), 1, rng.uniform(0.4, 1)]
    solids = [hull, cab, *_greebles(rng, hull, 18), *_greebles(rng, cab, 6)]
    for z in np.linspace(-0.75, 0.75, rng.integers(2, 6)) * d:
        for side in (-1, 1):
            edge = [0.5, 0.95, 1, 1, 0.95, 0.6, 0.5]
            place = [-0.9, -1, -0.8, 0.8, 1, 1, 0.6]
            wheel = turned(profile(radius * np.array(edge), 0.06 * np.array(place)), 24)
            turn = trimesh.transformations.rotation_matrix(-side * np.pi / 2, [0, 0, 1])
            turn[:3, 3] = [side * (w + 0.04), radius, z]
            solids.append(wheel.apply_transform(turn))
    return join(solids)


def _greebles(rng: Rng, host: Solid, count: int) -> list[Solid]:
    """Small blocks that stand out of the bounding box of `host`, some in rows."""
    low, high = host.bounds
    solids: list[Solid] = []
    while len(solids) < count:
        place, axis, end = rng.uniform(low, high), rng.integers(3), rng.integers(2)
        place[axis] = (low, high)[end][axis]
        half, step, out = rng.uniform(0.008, 0.06, 3), np.zeros(3), np.zeros(3)
        step[(axis + 1) % 3] = 2.5 * half.max()
        out[axis] = (2 * end - 1) * 0.8 * half[axis]
        for i in range(rng.choice([1, 1, 4])):
            foot = place + i * step
            if (foot <= high).all():
                solids.append(block(foot + out - half, foot + out + half))
    return solids


def _pierced_wall(rng: Rng, w: float, h: float, t: float) -> Solid:
    """A wall along x, 2w wide, h high, t either side, of piers around openings."""
    edges = np.linspace(-w, w, 2 * rng.integers(1, 5))
    solids = [block([a, 0, -t], [b, h, t]) for a, b in edges.reshape(-1, 2)]
    for a, b in edges[1:-1].reshape(-1, 2):
        low, high = np.sort(rng.uniform(0, h, 2)) * [rng.random() < 0.7, 1]
        solids.append(block([a, high, -0.9 * t], [b, h, 0.9 * t]))
        if low > 0:
            solids.append(block([a, 0, -0.9 * t], [b, low, 0.9 * t]))
    return join(solids)


def _roof(rng: Rng, w: float, d: float, h: float) -> list[Solid]:
    """A gable with overlapping courses of tiles, and a chimney."""
    ridge, t = rng.uniform(0.15, 0.6), 0.03
    gable = block([-w, h, -d], [w, h + ridge, d])
    gable.vertices[gable.vertices[:, 1] > h, 0] *= 0.02
    solids = [gable, block([w / 3, h, d / 4], [w / 2, h + 1.2 * ridge, d / 2])]
    for i in range(rng.integers(1, 8) if rng.random() < 0.6 else 0):
        x, y = w * (1 - i / 8), h + ridge * i / 8
        solids += [block([s * x, y, -d], [s * (x - w / 6), y + t, d]) for s in (-1, 1)]
    return solids


def _table(rng: Rng, w: float, d: float, h: float) -> Solid:
    """A board on four legs or a foot, with aprons and a stretcher or drawers."""
    t, leg = rng.uniform(0.02, 0.06), rng.uniform(0.015, 0.05)
    solids = [block([-w, h - t, -d], [w, h, d])]
    if rng.random() < 0.25:
        foot = turned(profile([d, 0.9 * d, leg, 2 * leg], [0, t, 2 * t, h]))
        return join([*solids, foot])
    for x in (-w + leg, w - leg):
        for z in (-d + leg, d - leg):
            solids.append(rod([x, leg, z], [0.95 * x, h - t, 0.95 * z], leg / 2, leg))
        solids.append(block([x - t / 2, h / 5, -d + leg], [x + t / 2, h / 4, d - leg]))
    for z in rng.uniform(-0.9, 0.9, rng.integers(0, 3)) * d:
        solids.append(block([-w + leg, h * 0.75, z], [w - leg, h - t, z + t]))
    return join(solids)


def _chair(rng: Rng, h: float) -> Solid:
    """A seat on four legs with a back of slats, some with arms or a cushion."""
    w, leg, back = (
        rng.uniform(0.14, 0.25),
        rng.uniform(0.012, 0.03),
        rng.uniform(0.2, 0.5),
    )
    solids = [block([-w, h - 2 * leg, -w], [w, h, w])]
    for x in (-w + leg, w - leg):
        solids.append(rod([x, 0, w - leg], [x, h - leg, w - leg], leg, leg))
        solids.append(rod([x, 0, -w + leg], [x, h + back, -w + leg], leg, leg))
        if rng.random() < 0.3:
            solids.append(block([x - leg, h + 0.14, -w], [x + leg, h + 0.17, w]))
    if rng.random() < 0.5:
        for y in np.linspace(h + 0.08, h + 0.95 * back, rng.integers(2, 6)):
            solids.append(block([-w, y - leg, -w], [w, y + leg, -w + leg]))
    else:
        solids.append(block([-w, h + 0.05, -w], [w, h + back, -w + 1.5 * leg]))
    return join(solids)


def _crate(rng: Rng) -> Solid:
    """An open box with things in it."""
    (w, d), h, t = rng.uniform(0.3, 0.8, 2), rng.uniform(0.2, 0.7), 0.04
    solids = [block([-w, 0, -d], [w, t, d])]
    for s in (-1, 1):
        solids.append(block([s * w, 0, -d], [s * (w - t), h, d]))
        solids.append(block([-w, 0, s * d], [w, h, s * (d - t)]))
    for x, z in rng.uniform(-0.7, 0.7, (rng.integers(0, 9), 2)) * [w, d]:
        ball = trimesh.creation.icosphere(2, rng.uniform(0.08, 0.2))
        solids.append(ball.apply_translation([x, 0.2, z]))
    return join(solids)

"""Families of shapes without a seam, grown from signed distances (`sdf`).

Each takes a random generator and gives a closed solid of any size, +y up.
"""

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree

from ginn_jax.sdf import (
    Part,
    Rng,
    box,
    cylinder,
    ellipsoid,
    field_of,
    limb,
    random_part,
    to_solid,
)


def blob(rng: Rng) -> trimesh.Trimesh:
    """Smooth unions and differences of random primitives."""
    smooth = rng.choice([0.0, 0.03, 0.12])
    parts = [random_part(rng, 0.55, rng.uniform(-0.2, 0.2, 3), smooth=smooth)]
    for _ in range(rng.integers(4, 14)):
        scale = rng.uniform(0.06, 0.4)
        cut = rng.random() < 0.4
        centre = rng.uniform(-0.5, 0.5, 3)
        parts.append(random_part(rng, scale, centre, smooth=smooth, cut=cut))
    return to_solid(_maybe_relief(rng, field_of(parts)))


def carving(rng: Rng) -> trimesh.Trimesh:
    """A block with rows of holes, slots and pockets cut into it, and knobs on it."""
    half = rng.uniform(0.35, 0.9, 3)
    body = box(half, rng.uniform(0, 0.1))
    if rng.random() < 0.3:
        body = cylinder(half[0], half[2])
    parts = [Part(body, 1.8, np.zeros(3))]
    for _ in range(rng.integers(4, 10)):
        scale = rng.uniform(0.06, 0.3)
        start, step = _on_box(rng, half), rng.normal(size=3)
        step *= rng.uniform(1.3, 2.5) * scale / np.linalg.norm(step)
        cut = rng.random() < 0.75
        motif = random_part(rng, scale, start, cut=cut, smooth=rng.choice([0, 0.02]))
        count = rng.integers(1, 7)
        parts += [motif._replace(centre=start + i * step) for i in range(count)]
    return to_solid(field_of(parts))


def statue(rng: Rng) -> trimesh.Trimesh:
    """Rounded masses on a pedestal, their surface in folds, locks and bumps."""
    waist, neck = np.array([0, -0.35, 0]), rng.normal([0, 0.25, 0], [0.1, 0.08, 0.05])
    head = neck + rng.normal([0, 0.28, 0.04], [0.06, 0.03, 0.04])
    foot = np.array([0, -0.75, 0])
    sizes = rng.uniform([0.15, 0.12], [0.35, 0.3], (2, 2)).T.tolist()
    parts = [
        limb(foot, waist, sizes[0][0], sizes[0][1], 0.12),
        limb(waist, neck, sizes[1][0], sizes[1][1], 0.12),
        limb(neck, head, 0.09, rng.uniform(0.12, 0.2), 0.06),
    ]
    for _ in range(rng.integers(2, 9)):
        root = waist + (head - waist) * rng.uniform(0, 1)
        tip = root + rng.normal(0, [0.25, 0.15, 0.2])
        parts.append(
            limb(root, tip, rng.uniform(0.05, 0.14), rng.uniform(0.05, 0.14), 0.04)
        )
    field = field_of(parts, 88)
    for _ in range(rng.integers(1, 3)):
        field = relief(rng, field)
    base = rng.uniform(0.06, 0.25)
    plinth = box(np.array([0.45, base, rng.uniform(0.3, 0.45)]), 0.01)
    pedestal = field_of([Part(plinth, 0.8, np.array([0, base - 0.95, 0]))], 88)
    return to_solid(np.minimum(field, pedestal))


def shell(rng: Rng) -> trimesh.Trimesh:
    """A hollow body with openings: bowls, helmets, boots, masks, cages."""
    half = rng.uniform(0.45, 0.85, 3)
    bodies = [ellipsoid(half), box(half, 0.5 * half.min()), cylinder(half[0], half[2])]
    parts = [Part(bodies[rng.integers(3)], 1.5, np.zeros(3), smooth=0.1)]
    for _ in range(rng.integers(0, 4)):
        centre = rng.uniform(-0.6, 0.6, 3)
        parts.append(random_part(rng, rng.uniform(0.15, 0.4), centre, smooth=0.1))
    field = field_of(parts, margin=0.2)
    hollow = -field - rng.uniform(0.06, 0.12)
    lid = np.linspace(-1, 1, len(field))[:, None] - rng.uniform(-0.1, 0.5)
    wall = np.maximum(np.maximum(field, hollow), lid)
    openings = []
    for _ in range(rng.integers(1, 9)):
        way = trimesh.unitize(rng.normal(size=3))
        openings.append(random_part(rng, rng.uniform(0.08, 0.3), 0.8 * half * way))
    return to_solid(_maybe_relief(rng, np.maximum(wall, -field_of(openings))))


def person(rng: Rng) -> trimesh.Trimesh:
    """A figure of tapered limbs in a random pose, some in a skirt or with a pack."""
    build, smooth = rng.uniform(0.7, 1.5), 0.05
    hip, neck = np.zeros(3), rng.normal([0, 0.45, 0.02], [0.04, 0.02, 0.08])
    head = neck + rng.normal([0, 0.17, 0.02], 0.02)
    width = 0.1 * build**0.5
    bones = [
        (hip, neck, 0.1 * build, 0.11 * build),
        (np.subtract(head, [0, 0.04, 0]), np.add(head, [0, 0.04, 0]), 0.08, 0.1),
        (neck, head, 0.05, 0.05),
    ]
    for side in (-1, 1):
        bones += _two_bones(
            rng, np.add(hip, [side * width, -0.02, 0]), [0, -0.4, 0.03], 0.07
        )
        shoulder = np.add(neck, [side * 1.8 * width, -0.05, 0])
        bones += [(neck, shoulder, 0.06, 0.055)]
        bones += _two_bones(rng, shoulder, rng.normal([0, -0.1, 0], 0.2), 0.05)
    parts = [limb(a, b, r, s, smooth) for a, b, r, s in bones]
    if rng.random() < 0.4:
        parts.append(Part(cylinder(0.34, 0.25, 0.6), 0.5, hip - [0, 0.2, 0], _UPRIGHT))
    if rng.random() < 0.3:
        pack = box(rng.uniform(0.06, 0.2, 3), 0.02)
        parts.append(Part(pack, 0.4, (hip + neck) / 2 - [0, -0.05, 0.2]))
    return to_solid(_maybe_relief(rng, field_of(parts, 108)))


def animal(rng: Rng) -> trimesh.Trimesh:
    """A trunk on two to eight legs with neck, head, tail, and sometimes horns."""
    length, girth = rng.uniform(0.3, 0.6), rng.uniform(0.1, 0.24)
    front, back = np.array([0, 0.1, length]), np.array([0, 0.1, -length])
    head = front + rng.normal([0, 0.2, 0.2], [0.05, 0.15, 0.08])
    snout = head + rng.uniform([0, -0.1, 0.05], [0, 0, 0.2])
    tail = back + rng.normal([0, 0, -0.25], 0.15)
    bones = [
        (front, back, girth, girth * rng.uniform(0.7, 1.3)),
        (front, head, girth * 0.8, girth * 0.5),
        (head, snout, girth * 0.6, girth * 0.35),
        (back, tail, rng.uniform(0.03, 0.1), 0.025),
    ]
    reach = rng.uniform(0.1, 0.3)
    for z in np.linspace(-length, length, rng.choice([1, 2, 2, 2, 2, 4])):
        for side in (-1, 1):
            root = np.array([side * girth * 0.6, 0.05, z * 0.9])
            bones += _two_bones(rng, root, [side * reach * 0.3, -reach, 0], girth * 0.4)
    for side in (-1, 1) if rng.random() < 0.6 else ():
        tip = head + rng.uniform([0.02, 0.05, -0.2], [0.25, 0.3, 0.1]) * [side, 1, 1]
        bones.append((np.add(head, [side * 0.04, 0.03, 0]), tip, 0.05, 0.025))
    smooth = rng.uniform(0.03, 0.12)
    parts = [limb(a, b, max(r, 0.025), max(s, 0.025), smooth) for a, b, r, s in bones]
    return to_solid(_maybe_relief(rng, field_of(parts, 108)))


def relief(rng: Rng, field: Float[np.ndarray, "S S S"]) -> Float[np.ndarray, "S S S"]:
    """The field with its surface moved by waves, folds, bumps or cracks of size .02-.1.

    Only values near the surface change; the rest need not be exact.
    """
    near = np.nonzero(np.abs(field) < 0.12)
    place = np.stack(near, -1).astype(np.float32) * (2 / (len(field) - 1)) - 1
    wavelength = rng.uniform(0.08, 0.3)
    height = wavelength * rng.uniform(0.05, 0.2)
    kind = rng.choice(["waves", "folds", "bumps", "cracks"])
    if kind in ("bumps", "cracks"):
        spread = rng.uniform(-1, 1, (int(min(2.5 / wavelength**3, 4000)), 3))
        distance = KDTree(spread).query(place, 2)[0] / wavelength
        bump = np.clip(1 - 2 * distance[:, 0], 0, None)
        crack = 1 - np.clip(3 * (distance[:, 1] - distance[:, 0]), 0, 1)
        shift = bump if kind == "bumps" else -0.6 * crack
    else:
        turns = 2 * np.pi / wavelength * rng.normal(size=(3, 3)) / 3**0.5
        wave = np.sin(place @ turns.astype(np.float32) + rng.uniform(0, 6, 3))
        shift = wave.sum(1) / 2 if kind == "waves" else 1 - 2 * np.abs(wave[:, 0])
    moved = field.copy()
    moved[near] -= height * np.minimum(shift, 1)
    return moved


def _maybe_relief(rng: Rng, field: np.ndarray) -> np.ndarray:
    return relief(rng, field) if rng.random() < 0.4 else field


def _on_box(rng: Rng, half: np.ndarray) -> np.ndarray:
    place, axis = rng.uniform(-half, half), rng.integers(3)
    place[axis] = half[axis] * rng.choice([-1, 1])
    return place


def _two_bones(rng: Rng, root, towards, radius: float) -> list[tuple]:
    """A bent limb of two bones and a foot or hand, thinner towards its end."""
    root, towards = np.asarray(root, float), np.asarray(towards, float)
    bend = 0.35 * np.linalg.norm(towards)
    knee = root + towards + rng.normal(0, bend, 3) * [0.5, 0.2, 1]
    end = knee + towards + rng.normal(0, bend, 3) * [0.5, 0.2, 1]
    foot = np.add(end, [0, 0, 0.08])
    thin = 0.5 * radius
    return [
        (root, knee, radius, 0.75 * radius),
        (knee, end, 0.75 * radius, thin),
        (end, foot, thin, thin),
    ]


_UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])

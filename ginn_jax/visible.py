"""Samples of a scene's surface where a camera can be: those that light can reach."""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Int

from ginn_jax.checks import LARGEST_INDEX, LARGEST_SEED, whole
from ginn_jax.errors import InputError
from ginn_jax.mesh import Mesh
from ginn_jax.reference import Scene, check_cast, count_blocked
from ginn_jax.samples import Samples, sample_surface

Rows = TypeVar("Rows")
# How far a ray goes to have left the scene, in diagonals of it, and at least.
DIAGONALS, LEAST_FAR = 2.0, 100.0
PROBE_RAYS = 32
# Rays that tell of most samples that light reaches them.
FEW = 4
# Samples are looked at in parts of what is wanted, until there are enough.
PARTS = 2
# All that is ever drawn for so many can be numbered: five times, each twice as many.
MOST_SAMPLES = LARGEST_INDEX // 40
OBJECT = 0  # the material of what stands on the ground


def visible_samples(
    scene: Scene, count: int, seed: int, both_sides: bool = True
) -> Samples:
    """Uniform samples of the surface that light can reach, on both its sides.

    Meshes of many parts hide surface inside other parts, where no camera can be; it
    would only take points away from what is seen. A sample is dropped if none of
    `PROBE_RAYS` rays from it leaves the scene. So the inside of what is closed is
    dropped, and a sheet without thickness has samples with normals to either side, as
    a camera sees it; unless `both_sides` is off. The ground has one side.

    Raises:
        InputError: a scene that is almost all sealed off.
    """

    def draw(drawn: int) -> tuple[Samples, Samples]:
        samples = sample_sides(scene.mesh, drawn, seed, both_sides)
        return samples, samples

    return draw_reached(draw, scene, count, seed)


def draw_reached(
    draw: Callable[[int], tuple[Rows, Samples]], scene: Scene, count: int, seed: int
) -> Rows:
    """The first `count` rows of what is drawn whose samples light reaches.

    `draw` is asked for more until there are enough.

    Raises:
        InputError: a scene that is almost all sealed off, a count below 0 or of more
            than can be numbered, or a negative seed.
    """
    count = whole("count", count, 0, MOST_SAMPLES)
    whole("seed", seed, 0, LARGEST_SEED)
    drawn = 5 * count // 2
    for _ in range(5):
        rows, samples = draw(drawn)
        seen = reached_by_light(scene, samples, count, seed)
        if len(seen) == count:
            return jax.tree.map(partial(np.take, indices=seen, axis=0), rows)
        drawn = 2 * drawn
    raise InputError("nearly all of the mesh's surface is sealed inside it: mend it")


def sample_sides(mesh: Mesh, count: int, seed: int, both_sides: bool) -> Samples:
    """At most `count` uniform samples; the normals of the object's to either side."""
    position, normal, material = sample_surface(mesh, count, seed=seed)
    behind, kept = draw_sides(material, both_sides, seed)
    normal = np.where(behind[:, None], -normal, normal)
    return Samples(position[kept], normal[kept], material[kept])


def draw_sides(
    material: Int[np.ndarray, "N"], both_sides: bool, seed: int
) -> tuple[Bool[np.ndarray, "N"], Bool[np.ndarray, "N"]]:
    """Which samples are of the back of their face, and which to keep of all.

    Half are of the back where both sides count, but what is under the ground is not.
    """
    drawn = np.random.default_rng((seed, 7)).random(len(material)) < 0.5
    behind = drawn & both_sides
    return behind, ~behind | (material == OBJECT)


def reached_by_light(
    scene: Scene, samples: Samples, count: int, seed: int
) -> Int[np.ndarray, "K"]:
    """The first `count` samples, or fewer where there are, from which at least one of
    `PROBE_RAYS` rays leaves the scene."""
    ends = samples.position, samples.normal
    far = out_of(scene)
    check_cast(scene, *ends, far, PROBE_RAYS, seed)
    found, size = np.zeros(0, np.int64), max(-(-count // PARTS), 1)
    for first in range(0, len(samples.position), size):
        rows = np.arange(first, min(first + size, len(samples.position)))
        found = np.append(found, rows[is_reached(scene, samples, rows, far, seed)])
        if len(found) >= count:
            break
    return found[:count]


def out_of(scene: Scene) -> float:
    """A length that leads out of the scene from anywhere in it."""
    corners = scene.mesh.vertices.astype(np.float64)
    return max(LEAST_FAR, DIAGONALS * float(np.linalg.norm(np.ptp(corners, axis=0))))


def is_reached(
    scene: Scene, samples: Samples, rows: Int[np.ndarray, "K"], far: float, seed: int
) -> Bool[np.ndarray, "K"]:
    """Whether light reaches these rows: all rays are cast where the first few fail.

    `far` is the length of the rays.
    """
    reached, doubtful = np.zeros(len(rows), bool), np.arange(len(rows))
    for cast in ((0, FEW), (FEW, PROBE_RAYS)):
        some = rows[doubtful]
        ends = samples.position[some], samples.normal[some], some.astype(np.uint32)
        blocked = count_blocked(scene, *ends, far, cast, seed)
        reached[doubtful] = blocked < cast[1] - cast[0]
        doubtful = np.flatnonzero(~reached)
    return reached

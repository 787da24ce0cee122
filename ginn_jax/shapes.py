"""An endless seeded source of shapes to train on, with the variety of real ones.

`FAMILIES` is the table of what there is; `random_shape` draws from it.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import trimesh

from ginn_jax import built_shapes as built
from ginn_jax import clad_shapes as clad
from ginn_jax import curved_shapes as curved
from ginn_jax import grown_shapes as grown
from ginn_jax.checks import whole
from ginn_jax.mesh import Mesh, fit_unit_box, make_mesh
from ginn_jax.solids import join

MOST_FACES = 60_000
# Raised where a seed comes to give another shape than it gave before.
SHAPES = 2


class Family(NamedTuple):
    """How to make one kind of shape, how often, whether it has to stand upright.

    Its parts are closed, unless it is `clad` in plates that may have no backs.
    """

    make: Callable[[np.random.Generator], trimesh.Trimesh]
    weight: float
    upright: bool
    clad: bool = False


def pile(rng: np.random.Generator) -> trimesh.Trimesh:
    """A few other shapes that stand on one ground, touch and interpenetrate."""
    solids: list[trimesh.Trimesh] = []
    for _ in range(rng.integers(2, 5)):
        solid = _turned(rng, FAMILIES[rng.choice(_PILED)])
        if sum(len(s.faces) for s in (*solids, solid)) > MOST_FACES:
            break
        solid.apply_scale(rng.uniform(0.4, 0.9) / solid.extents.max())
        move = -solid.bounds.mean(0)
        if solids:  # so that the bounding boxes overlap
            host = solids[rng.integers(len(solids))]
            reach = (host.extents + solid.extents) / 2
            move += host.bounds.mean(0) + rng.uniform(-0.8, 0.8, 3) * reach
        move[1] = -solid.bounds[0, 1]
        solids.append(solid.apply_translation(move))
    return join(solids)


def armour(rng: np.random.Generator) -> trimesh.Trimesh:
    """A shape of another family under plates."""
    return clad.scaled(rng, FAMILIES[rng.choice(_CLAD)].make(rng))


FAMILIES = {
    "blob": Family(grown.blob, 3, False),
    "carving": Family(grown.carving, 2, False),
    "statue": Family(grown.statue, 3, True),
    "shell": Family(grown.shell, 2, True),
    "person": Family(grown.person, 3, True),
    "animal": Family(grown.animal, 3, True),
    "tower": Family(built.tower, 1.5, True),
    "stairs": Family(built.stairs, 1, True),
    "house": Family(built.house, 1.5, True),
    "shelf": Family(built.shelf, 1, True),
    "table_and_chairs": Family(built.table_and_chairs, 2, True),
    "vase": Family(curved.vase, 1, True),
    "vessel": Family(curved.vessel, 2, True),
    "plant": Family(curved.plant, 1, True),
    "bars": Family(curved.bars, 1, False),
    "wheel": Family(curved.wheel, 1, False),
    "cloth": Family(curved.cloth, 1, False),
    "vehicle": Family(built.vehicle, 2, True),
    "pile": Family(pile, 3, True),
    "timber_house": Family(clad.timber_house, 2.5, True, clad=True),
    "well": Family(clad.well, 1, True, clad=True),
    "armour": Family(armour, 2, True, clad=True),
}
_CLAD = ["blob", "carving", "statue", "person", "animal", "vase", "vehicle"]
_PILED = ["blob", "carving", "shell", "vase", "tower", "cloth", "bars", "vehicle"]


def random_shape(seed: int, closed: bool = False) -> Mesh:
    """Shape number `seed` (>= 0): faces look outward, unit box, +y up.

    A `closed` one can hold a medium. It is the same shape wherever that is closed.
    """
    rng = np.random.default_rng(whole("seed", seed, 0, 2**63 - 1))
    name = draw_family(rng, closed)
    return shape_of(name, rng)


def draw_family(rng: np.random.Generator, closed: bool = False) -> str:
    """The name of a family, each drawn as often as its weight says."""
    weight = np.array([family.weight for family in FAMILIES.values()])
    while True:
        name = str(rng.choice(list(FAMILIES), p=weight / weight.sum()))
        if not (closed and FAMILIES[name].clad):
            return name


def shape_of(name: str, rng: np.random.Generator) -> Mesh:
    """A shape of the family `name`, in the unit box."""
    solid = _turned(rng, FAMILIES[name])
    solid.apply_scale(rng.uniform(0.8, 1.2, 3))
    return fit_unit_box(make_mesh(solid.vertices, solid.faces))


def _turned(rng: np.random.Generator, family: Family) -> trimesh.Trimesh:
    """A shape of the family, turned about +y, or any way if it need not stand."""
    solid = family.make(rng)
    while not 0 < len(solid.faces) <= MOST_FACES:  # all cut away, or too intricate
        solid = family.make(rng)
    angle = rng.uniform(0, 2 * np.pi)
    turn = trimesh.transformations.rotation_matrix(angle, [0, 1, 0])
    if not family.upright and rng.random() < 0.7:
        turn = trimesh.transformations.random_rotation_matrix(rng.random(3))
    return solid.apply_transform(turn)

"""A contact sheet of procedural shapes: `python -m experiments.shape_sheet`.

Ray-traces the ambient occlusion of each shape on its ground, and writes shapes.png.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from skimage.io import imsave

from ginn_jax import reference
from ginn_jax.camera import orbit_camera
from ginn_jax.commandline import start
from ginn_jax.errors import InputError
from ginn_jax.mesh import Mesh, add_ground
from ginn_jax.shapes import random_shape

FINER = 2  # a pixel is the average of this many squared
COLUMNS, RADIUS, RAYS = 6, 0.1, 32


@dataclass(frozen=True)
class Options:
    """Draw a contact sheet of procedural shapes, shaded by ambient occlusion."""

    out: Path = Path("runs/shape_sheet")
    """Folder for shapes.png."""
    seed: int = 0
    """Number of the first shape; the others follow it."""
    shapes: int = 24
    """How many shapes, six in a row."""
    size: int = 160
    """Pixels along each side of a shape's picture."""


def contact_sheet(seeds: Sequence[int], size: int) -> UInt8[np.ndarray, "H W"]:
    """Pictures of the shapes of these seeds, row by row; cells left over are white."""
    cells = [picture(random_shape(seed), size) for seed in seeds]
    cells += [np.ones((size, size))] * (-len(cells) % COLUMNS)
    rows = [np.hstack(cells[i : i + COLUMNS]) for i in range(0, len(cells), COLUMNS)]
    return np.round(255 * np.vstack(rows)).astype(np.uint8)


def picture(mesh: Mesh, size: int) -> Float[np.ndarray, "S S"]:
    """Openness of the mesh on its ground, dimmed where it turns from the camera."""
    scene = reference.build_scene(add_ground(mesh))
    camera = orbit_camera(distance=2.6, width=FINER * size, height=FINER * size)
    buffer = reference.render_gbuffer(scene, camera)
    points, normals = buffer.position[buffer.mask], buffer.normal[buffer.mask]
    open_part = reference.ambient_occlusion(
        scene, points, normals, RADIUS, rays=RAYS, seed=0
    )
    away = np.array(camera.origin) - points
    facing = (normals * away).sum(1) / np.linalg.norm(away, axis=1)
    image = np.ones(buffer.mask.shape)
    image[buffer.mask] = open_part.mean * (0.5 + 0.5 * facing)
    return image.reshape(size, FINER, size, FINER).mean((1, 3))


def main(options: Options) -> None:
    """Draw the sheet and write it to the folder `options.out`."""
    if options.shapes < 1 or options.size < 1 or options.seed < 0:
        raise InputError("--shapes and --size must be at least 1, --seed at least 0")
    seeds = range(options.seed, options.seed + options.shapes)
    options.out.mkdir(parents=True, exist_ok=True)
    imsave(options.out / "shapes.png", contact_sheet(seeds, options.size))


if __name__ == "__main__":
    start(Options, main, {})

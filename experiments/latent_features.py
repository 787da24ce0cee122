"""What f_3D says of every point: the latent code of one object, from two views.

    python -m experiments.latent_features --effect ao --out runs/latent_features

shows the first channels of the code and its three principal components as colours, as
in the paper's first figure. `--help` lists every option with its default.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from rich.console import Console
from scipy.spatial import KDTree

from ginn_jax import compare, inference
from ginn_jax.camera import orbit_camera
from ginn_jax.commandline import require, start
from ginn_jax.lighting import procedural_environment
from ginn_jax.lit_clouds import network_numbers
from ginn_jax.lit_scenes import light_mesh, lit_points
from ginn_jax.mesh import Mesh
from ginn_jax.objects import UNSEEN_SEED, object_or_shape
from ginn_jax.pretrained import load_network
from ginn_jax.reference import GBuffer, build_scene, render_gbuffer
from ginn_jax.scenes import Occlusion
from ginn_jax.visible import visible_samples

AZIMUTHS = (35.0, 155.0)


@dataclass(frozen=True)
class Options:
    """Draw the latent code of an object."""

    effect: Literal["ao", "gi", "sss"] = "ao"
    """Whose network."""
    out: Path = Path("runs/latent_features")
    """Folder for the figure."""
    checkpoint: str | None = None
    """The --out of a run, or a name as "ao_fine"; left out, the effect's network."""
    mesh: Path | None = None
    """A mesh file; left out, a procedural shape."""
    channels: int = 4
    """Channels of the code to show beside its principal components."""
    resolution: int = 384
    """Side of the images in pixels."""
    points: int | None = None
    """Samples of the object and its ground; left out, 64,000 for ambient occlusion,
    32,000 for light."""
    seed: int = 0
    """Seed of everything."""
    quick: bool = False
    """A small image: to try things."""


QUICK = {"resolution": 48, "points": 3000, "channels": 2}


def main(options: Options) -> Path:
    """Draw the figure; returns its path."""
    require(options, {"channels": 1, "resolution": 32, "points": 1000, "seed": 0})
    unseen = UNSEEN_SEED + options.seed
    mesh = object_or_shape(options.mesh, unseen, options.effect != "sss")
    position, code = latent_code(options, mesh)
    panels = np.concatenate([principal(code), ranked(code[:, : options.channels])], 1)
    scene, size = build_scene(mesh), options.resolution
    rows = [
        seen(
            render_gbuffer(scene, orbit_camera(azimuth, width=size, height=size)),
            position,
            panels,
        )
        for azimuth in AZIMUTHS
    ]
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "latent_features.png"
    draw(path, rows)
    Console().print(f"{path}")
    return path


def latent_code(
    options: Options, mesh: Mesh
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N K"]]:
    """Finest points and what f_3D says of them; of the first colour if there are."""
    config, limits, weights = load_network(options.effect, options.checkpoint)
    sheets = options.effect != "sss"
    settings = compare.effect_settings(options.effect, options.points, 2, 0.1)
    scene = build_scene(mesh)
    samples = visible_samples(scene, settings.points, options.seed, sheets)
    numbers: tuple[Any, ...] = ()
    if not isinstance(settings, Occlusion):
        light = procedural_environment(UNSEEN_SEED + options.seed)
        lit = light_mesh(mesh, light, settings, seed=options.seed)
        cloud = lit_points(lit, samples, settings.looks, seed=options.seed)
        numbers = network_numbers(cloud)
    ends = weights, samples.position, samples.normal
    key = jax.random.key(options.seed)
    encoded, _ = inference.encode_cloud(
        config.network, limits, *ends, *numbers, key=key
    )
    mask, code = np.asarray(encoded.points.mask), np.asarray(encoded.code.free)
    code = code if code.ndim == 2 else code[0]
    return np.asarray(encoded.points.position)[mask], code[mask]


def principal(code: Float[np.ndarray, "N K"]) -> Float[np.ndarray, "N 3"]:
    """The three principal components, as colours."""
    centred = code - code.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    return ranked(centred @ axes[:3].T)


def ranked(columns: Float[np.ndarray, "N K"]) -> Float[np.ndarray, "N K"]:
    """Each column by rank in [0, 1]: every value is told from the others."""
    order = columns.argsort(axis=0).argsort(axis=0)
    return order / max(len(columns) - 1, 1)


def seen(
    gbuffer: GBuffer,
    position: Float[np.ndarray, "N 3"],
    panels: Float[np.ndarray, "N K"],
) -> Float[np.ndarray, "H W K"]:
    """Panels at the pixels: those of the three nearest points, the near ones first."""
    mask = gbuffer.mask
    distance, index = KDTree(position).query(gbuffer.position[mask], 3)
    weight = 1 / np.maximum(distance, 1e-6) ** 2
    weight /= weight.sum(axis=1, keepdims=True)
    found = np.ones((*mask.shape, panels.shape[1]))
    found[mask] = np.einsum("pk,pkc->pc", weight, panels[index])
    return found


def draw(path: Path, rows: list[Float[np.ndarray, "H W K"]]) -> None:
    """A row a view: principal components as colours, then single channels."""
    columns = rows[0].shape[2] - 2
    size = (2.6 * columns, 2.7 * len(rows))
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for line, panels in zip(grid, rows, strict=True):
        line[0].imshow(panels[..., :3])
        for axes, channel in zip(line[1:], np.moveaxis(panels, -1, 0)[3:], strict=True):
            axes.imshow(channel, cmap="magma", vmin=0, vmax=1)
        for axes in line:
            axes.axis("off")
    names = ["principal components", *(f"channel {i}" for i in range(columns - 1))]
    for axes, name in zip(grid[0], names, strict=True):
        axes.set_title(name, fontsize=8)
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    start(Options, main, QUICK, __doc__)

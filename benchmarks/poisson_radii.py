"""Quality against time by the Poisson disk radius at test time (paper, TimingPD).

    python -m benchmarks.poisson_radii --effect gi

One set of weights, one object after the other, radii in turns.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from benchmarks.poisson_report import PAPER, draw, write_report
from benchmarks.timing import circumstances
from ginn_jax import compare, report
from ginn_jax.camera import orbit_camera
from ginn_jax.commandline import require, require_positive, require_some, start
from ginn_jax.compare_networks import Trained, at_disk_radius, load_trained
from ginn_jax.compare_pictures import errors_at_points, network_picture, points_given
from ginn_jax.compare_tracing import trace
from ginn_jax.evaluate import Row
from ginn_jax.objects import Source
from ginn_jax.scenes import Settings, made_cloud

TIMES = "seconds_3d", "seconds_2d", "seconds"


@dataclass(frozen=True)
class Options:
    """Time and error of a trained network at several Poisson disk radii."""

    effect: Literal["ao", "gi", "sss"] = "ao"
    """Ambient occlusion, global illumination or subsurface scattering."""
    out: Path = Path("runs/poisson_radii")
    """Folder for metrics.json, report.md and the figure."""
    checkpoint: str | None = None
    """The --out of a run, or a name as "ao_fine"; left out, the effect's network."""
    meshes: Path | None = None
    """A mesh file or a folder of meshes; left out, procedural shapes."""
    envmaps: Path | None = None
    """An environment map or a folder of them; left out, procedural skies."""
    objects: int = 2
    """How many scenes, evenly spread over the meshes; training saw none of them."""
    times: tuple[float, ...] = (0.75, 1.0, 1.25, 1.5)
    """Poisson disk radii, as times the network's own."""
    points: int | None = None
    """Samples of an object before the disk, of which a fifth measure; left out, 64,000
    for ambient occlusion, 32,000 for light. Few of them starve the small radii."""
    resolution: int = 512
    """Side of the image in pixels."""
    reference: int = 256
    """Rays or paths of the reference, per point and per pixel."""
    looks: int = 512
    """Directions of the direct light per sample and pixel."""
    radius: float = 0.1
    """Occlusion radius."""
    rounds: int = 3
    """How often all radii are timed in turns, each time as a median of three calls."""
    quick: bool = False
    """Two radii, a small image, few rays: to try things, not for numbers."""


QUICK = {"objects": 1, "times": (1.0, 1.25), "points": 4000, "resolution": 96}
QUICK |= {"reference": 32, "looks": 32, "rounds": 1}


def main(options: Options) -> dict[str, Any]:
    """Compare radii on every object; returns what metrics.json holds."""
    least = {"objects": 1, "points": 1000, "resolution": 32, "reference": 2}
    require(options, least | {"looks": 1, "rounds": 1})
    require_positive(options, "radius", "times")
    require_some(options, "times")
    begin = time.perf_counter()
    counts = options.points, options.reference
    settings = compare.effect_settings(options.effect, *counts, options.radius)
    settings = compare.with_looks(settings, options.looks)
    trained = load_trained(
        options.effect, settings, options.checkpoint, key=jax.random.key(0)
    )
    networks = at_radii(trained, options.times)
    where = options.meshes, options.envmaps
    sources = compare.unseen_sources(options.effect, options.objects, *where, seed=0)
    rows = []
    for source in sources:
        found, networks = compare_radii(options, settings, source, networks)
        rows += found
    metrics = {
        "rows": rows,
        "samples": settings.points,
        "levels": trained[0].levels,
        "query_radius": trained[0].query.radius,
        "paper": [[*where, *what] for where, what in PAPER.items()],
    } | circumstances(options, begin)
    text = write_report(metrics)
    report.write_results(options.out, metrics, text)
    draw(options.out / "poisson_radii.png", rows, options.effect)
    print(text)
    return metrics


def at_radii(trained: Trained, times: tuple[float, ...]) -> dict[str, Trained]:
    """The network at each of the Poisson disk radii."""
    radii = (round(factor * trained[0].levels[0], 6) for factor in times)
    return {f"{radius:g}": at_disk_radius(trained, radius) for radius in radii}


def compare_radii(
    options: Options, settings: Settings, source: Source, networks: dict[str, Trained]
) -> tuple[list[Row], dict[str, Trained]]:
    """One row for each radius of an object; the networks with the limits they took."""
    size, seed = options.resolution, source.seed
    camera = orbit_camera(width=size, height=size)
    stage = compare.set_stage(source, settings)
    shot = compare.take_shot(stage, camera, settings, seed=seed)
    truth = trace(shot, settings, options.reference, seed=seed)
    shot = compare.with_truth(shot, truth)
    cloud = made_cloud(source, settings, options.out / "clouds")
    given, _ = points_given(cloud)
    at_points, networks = errors_at_points(networks, [cloud], [source], settings)
    seconds: dict[str, list[Row]] = {name: [] for name in networks}
    for _ in range(options.rounds):
        for name, trained in networks.items():
            picture, networks[name] = network_picture(name, trained, given, shot)
            seconds[name].append(picture.row)
    pixels = int(shot.gbuffer.mask.sum())
    rows = []
    for name, turns in seconds.items():
        middle = {key: float(np.median([t[key] for t in turns])) for key in TIMES}
        row = {"object": source.name, "radius": float(name), "pixels": pixels}
        rows.append(turns[-1] | at_points[name] | middle | row)
    return rows, networks


if __name__ == "__main__":
    start(Options, main, QUICK)

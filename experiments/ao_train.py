"""Ambient occlusion from nothing to a trained network, images and tables.

    python -m experiments.ao_train --out runs/ao_train

makes procedural shapes, ray-traces their ambient occlusion, trains, and evaluates on
shapes that training never saw. `--help` lists every option with its default.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from rich.console import Console

from ginn_jax import evaluate, fit, objects, presets, report, scenes
from ginn_jax.architecture import Network
from ginn_jax.commandline import require_positive, start
from ginn_jax.disk_radius import limits_at, with_disk_radius
from ginn_jax.experiment import (
    Clock,
    RunOptions,
    check_run,
    closing,
    errors_by_set,
    learned,
    make,
    on_disk,
    train,
    training,
)
from ginn_jax.limits import Limits
from ginn_jax.mesh import find_meshes
from ginn_jax.occlusion_report import write_report
from ginn_jax.recipe import Training

VALIDATION_RAYS = 1024
DISK_RADII = (0.01, 0.0125, 0.015)
RAY_COUNTS = (1, 4, 16, 64, 256)


@dataclass(frozen=True)
class Options(RunOptions):
    """Train ambient occlusion on point clouds and evaluate it on unseen objects."""

    out: Path = Path("runs/ao_train")
    """Folder for data, checkpoints, metrics.json, report.md and figures."""
    shapes: int = 400
    """Procedural shapes to train on."""
    points: int = 32_000
    """Samples per object to train on."""
    test_points: int = 64_000
    """Samples per object to evaluate on: at fewer, f_2D misses some pixels."""
    rays: int = 64
    """Rays per training point."""
    radius: float = 0.1
    """Occlusion radius, in units of the object's longest side."""
    preset: Literal["default", "paper", "released", "only_2d", "only_3d"] = "default"
    """Layer table: ours, the paper's, the authors' release, or an ablation of ours."""
    resolution: int = 512
    """Side of the evaluation images in pixels."""


QUICK = {
    "shapes": 8,
    "test_shapes": 3,
    "steps": 30,
    "points": 6000,
    "test_points": 6000,
    "resolution": 96,
    "rays": 16,
}


def main(options: Options) -> dict[str, Any]:
    """Run the experiment; returns what metrics.json holds."""
    check_run(options, {"rays": 2, "test_points": 1000})
    require_positive(options, "radius")
    network = on_disk(options, presets.PRESETS[options.preset])
    console = Console()
    clock = Clock()
    settings = scenes.Occlusion(options.points, options.rays, options.radius)
    train_sources = training_sources(options)
    test_sources = held_back_sources(options)
    objects.check_unseen(train_sources, test_sources)
    begin = time.perf_counter()
    folder = options.out / "data"
    clouds = make(
        console, "training clouds", train_sources, settings, folder / "training"
    )
    exact = scenes.Occlusion(options.test_points, VALIDATION_RAYS, options.radius)
    unseen = make(console, "unseen clouds", test_sources, exact, folder / "unseen")
    clock.lap("data", begin)

    config = training(options, network, options.points, len(clouds))
    extra = learned(settings, train_sources)
    run = train(console, config, clouds, options, extra, clock)

    begin = time.perf_counter()
    metrics = evaluation(options, run, config, unseen, test_sources, clouds)
    clock.lap("evaluation", begin)
    metrics |= closing(options, run, config, clock)
    report.write_results(options.out, metrics, write_report(metrics))
    console.print(
        f"relative 3D MSE {metrics['relative_mse_3d']:.2%} on unseen shapes, "
        f"{metrics['seconds_total'] / 60:.1f} minutes: {options.out / 'report.md'}"
    )
    return metrics


def training_sources(options: Options) -> list[objects.Source]:
    """Procedural shapes and the user's meshes."""
    sources = objects.procedural_sources(
        options.shapes, options.seed * objects.SEEDS_APART
    )
    if options.meshes is not None:
        sources += objects.file_sources(find_meshes(options.meshes))
    return sources


def held_back_sources(options: Options) -> list[objects.Source]:
    """Procedural shapes of other seeds, and the user's test meshes."""
    sources = objects.procedural_sources(
        options.test_shapes, objects.UNSEEN_SEED + options.seed
    )
    if options.test_meshes is not None:
        sources += objects.file_sources(find_meshes(options.test_meshes))
    return sources


def evaluation(
    options: Options,
    run: fit.Fit,
    config: Training,
    unseen: Sequence[scenes.ShadedPoints],
    sources: list[objects.Source],
    clouds: Sequence[scenes.ShadedPoints],
) -> dict[str, Any]:
    """All errors of the trained network; draws the figures."""
    variables = jax.device_put(run.state.variables, jax.devices()[0])
    model = evaluate.Model(variables, jax.random.key(options.seed))
    names = [s.name for s in sources]
    rows, limits = evaluate.evaluate_clouds(
        config.network, run.limits, model, unseen, names, VALIDATION_RAYS
    )
    procedural = [r for r, s in zip(rows, sources, strict=True) if s.path is None]
    files = [r for r, s in zip(rows, sources, strict=True) if s.path is not None]
    sets = {"shapes": procedural} | ({"meshes": files} if files else {})
    floor = float(np.mean([np.mean(c.variance) for c in clouds]))
    report.draw_curve(options.out / "learning_curve.png", run.losses, floor)
    first, real = range(len(procedural)), range(len(procedural), len(sources))
    # Of each kind a few, not all at once: the clouds may stay on disk.
    some = [*first[:2], *real[:2]] if files else first[:3]
    shown = [(sources[i], unseen[i]) for i in some]
    images = image_evaluation(options, config, limits, model, shown)
    return errors_by_set(sets) | images


def image_evaluation(
    options: Options,
    config: Training,
    limits: Limits,
    model: evaluate.Model,
    shown: list[tuple[objects.Source, scenes.ShadedPoints]],
) -> dict[str, Any]:
    """Images of unseen objects, and error against run time on the same pixels."""
    views = [
        evaluate.reference_view(
            objects.load_object(source),
            options.radius,
            VALIDATION_RAYS,
            i,
            options.resolution,
        )
        for i, (source, _) in enumerate(shown)
    ]
    own, rows, pictures = config.network.levels[0], [], []
    for radius in disk_radii(config.network, options.quick):
        scales = {1.0, options.resolution_scale} if radius == own else {1.0}
        given = config.network, limits, model, views, shown, radius
        for scale in sorted(scales, reverse=True):
            found, images = network_rows(*given, scale)
            rows += found
            if (radius, scale) == (own, 1.0):
                pictures = images
    for i, view in enumerate(views):
        for rays in RAY_COUNTS:
            row = evaluate.ray_row(view, options.radius, rays, seed=1000 + i)
            rows.append(row | {"name": shown[i][0].name})
    means = evaluate.mean_rows(rows)
    groups = {
        "network (f_3D + f_2D)": [r for r in means if "disk_radius" in r],
        "ray tracing": [r for r in means if "rays" in r],
    }
    report.draw_views(options.out / "views.png", pictures)
    report.draw_error_against_time(options.out / "error_against_time.png", groups)
    mine = next(r for r in means if r["method"] == f"network, disk {own:g}")
    return {
        "mse_2d": mine["mse_2d"],
        "dssim_2d": mine["dssim_2d"],
        "foreground_pixels": [int(v.gbuffer.mask.sum()) for v in views],
        "error_against_time": means,
        "error_against_time_rows": rows,
    }


def disk_radii(network: Network, quick: bool) -> list[float]:
    """The network's own finest disk radius and, unless in a hurry, others it allows."""
    others = [r for r in DISK_RADII if r < network.query.radius and not quick]
    return sorted({network.levels[0], *others})


def network_rows(
    network: Network,
    limits: Limits,
    model: evaluate.Model,
    views: list[evaluate.View],
    shown: list[tuple[objects.Source, scenes.ShadedPoints]],
    radius: float,
    scale: float,
) -> tuple[list[evaluate.Row], list[Any]]:
    """Errors and times at one disk radius and resolution scale, and the images."""
    held, rows, images = limits_at(network, limits, radius), [], []
    network = with_disk_radius(network, radius)
    for (source, whole), view in zip(shown, views, strict=True):
        cloud = evaluate.split_cloud(whole)[0]
        given = network, held, model, cloud, view, scale
        row, image, held = evaluate.network_row(*given)
        rows.append(row | {"name": source.name})
        images.append((source.name, view.reference, image))
    return rows, images


if __name__ == "__main__":
    start(Options, main, QUICK, __doc__)

"""Ambient occlusion from nothing to a trained network, images and tables.

    python -m experiments.ao_train --out runs/ao_train

makes procedural shapes, ray-traces their ambient occlusion, trains, and evaluates on
shapes that training never saw. `--help` lists every option with its default.
"""

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from rich.console import Console

from ginn_jax import architecture, evaluate, fit, objects, report, scenes
from ginn_jax.commandline import require_positive, start
from ginn_jax.disk_radius import limits_at, with_disk_radius
from ginn_jax.experiment import (
    Clock,
    RunOptions,
    check_run,
    closing,
    make,
    train,
    training,
)
from ginn_jax.limits import Limits
from ginn_jax.mesh import find_meshes
from ginn_jax.train import Training

VALIDATION_RAYS = 1024
DISK_RADII = (0.01, 0.015, 0.02)
RAY_COUNTS = (1, 4, 16, 64, 256)


@dataclass(frozen=True)
class Options(RunOptions):
    """Train ambient occlusion on point clouds and evaluate it on unseen objects."""

    out: Path = Path("runs/ao_train")
    """Folder for data, checkpoints, metrics.json, report.md and figures."""
    shapes: int = 400
    """Procedural shapes to train on."""
    points: int = 32_000
    """Samples per object."""
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
    "resolution": 96,
    "rays": 16,
}


def main(options: Options) -> dict[str, Any]:
    """Run the experiment; returns what metrics.json holds."""
    check_run(options, {"rays": 2})
    require_positive(options, "radius")
    console = Console()
    clock = Clock()
    settings = scenes.Occlusion(options.points, options.rays, options.radius)
    train_sources = training_sources(options)
    test_sources = unseen_sources(options)
    begin = time.perf_counter()
    folder = options.out / "data"
    clouds = make(
        console, "training clouds", train_sources, settings, folder / "training"
    )
    exact = scenes.Occlusion(options.points, VALIDATION_RAYS, options.radius)
    unseen = make(console, "unseen clouds", test_sources, exact, folder / "unseen")
    clock.lap("data", begin)

    network = architecture.PRESETS[options.preset]
    config = training(options, network, options.points, len(clouds))
    extra = {"data": asdict(settings), "objects": [s.name for s in train_sources]}
    run = train(console, config, clouds, options.out, options.resume, extra)
    clock.parts |= run.seconds

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


def unseen_sources(options: Options) -> list[objects.Source]:
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
    unseen: list[scenes.ShadedPoints],
    sources: list[objects.Source],
    clouds: list[scenes.ShadedPoints],
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
    metrics = evaluate.pool_rows(procedural) | {"unseen_shapes": procedural}
    if files:
        metrics |= {"unseen_meshes_pooled": evaluate.pool_rows(files)}
        metrics |= {"unseen_meshes": files}
    floor = float(np.mean([np.mean(c.variance) for c in clouds]))
    report.draw_curve(options.out / "learning_curve.png", run.losses, floor)
    shown = list(zip(sources, unseen, strict=True))[:3]
    if files:
        shown = [
            *shown[:2],
            *list(zip(sources, unseen, strict=True))[len(procedural) :][:2],
        ]
    return metrics | image_evaluation(options, config, limits, model, shown)


def image_evaluation(
    options: Options,
    config: Training,
    limits: Limits,
    model: evaluate.Model,
    shown: list[tuple[objects.Source, scenes.ShadedPoints]],
) -> dict[str, Any]:
    """Images of unseen objects, and error against run time on the same pixels."""
    pictures, rows = [], []
    network = config.network
    own = network.levels[0]
    others = (
        [] if options.quick else [r for r in DISK_RADII if r < network.query.radius]
    )
    radii = sorted({own, *others})
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
    for radius in radii:
        held, variant = (
            limits_at(network, limits, radius),
            with_disk_radius(network, radius),
        )
        for (source, whole), view in zip(shown, views, strict=True):
            cloud = evaluate.split_cloud(whole)[0]
            row, image, held = evaluate.network_row(variant, held, model, cloud, view)
            rows.append(row | {"name": source.name})
            if radius == own:
                pictures.append((source.name, view.reference, image))
            if radius == own and options.resolution_scale < 1:
                row, _, held = evaluate.network_row(
                    variant, held, model, cloud, view, options.resolution_scale
                )
                rows.append(row | {"name": source.name})
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


def write_report(m: dict[str, Any]) -> str:
    """report.md: what was done, how good it is, how long it took."""
    columns = {"name": "object", "points": "points", "mse_3d": "3D MSE"}
    columns |= {"relative_mse_3d": "relative", "noise_floor_3d": "noise floor"}
    times = {"method": "method", "points": "points", "mse_2d": "2D MSE"}
    times |= {"dssim_2d": "DSSIM", "seconds_3d": "f_3D s", "seconds_2d": "f_2D s"}
    times |= {"seconds": "total s"}
    pooled = [{"set": "unseen procedural shapes", **m}]
    if "unseen_meshes_pooled" in m:
        pooled.append({"set": "unseen meshes", **m["unseen_meshes_pooled"]})
    heads = {"set": "set", "clouds": "clouds", "mse_3d": "3D MSE"}
    heads |= {"relative_mse_3d": "relative 3D MSE", "noise_floor_3d": "noise floor"}
    heads |= {"median_relative_mse_3d": "median relative", "equal_rays": "equal rays"}
    env, options = m["environment"], m["options"]
    seconds = {k[8:]: v for k, v in m.items() if k.startswith("seconds_")}
    return f"""# Ambient occlusion

Preset {options["preset"]}, levels {m["training"]["network"]["levels"]}, f_2D radius
{m["training"]["network"]["query"]["radius"]}, {m["steps"]} steps of
{options["batch"]} clouds, occlusion radius {options["radius"]}, seed {options["seed"]}.
{env["processor"]}, {env["cores"]} cores, {env["devices"]} JAX devices,
jax {env["packages"]["jax"]}, mitsuba {env["packages"]["mitsuba"]}.
Skipped steps (non-finite gradient): {m["skipped_steps"]}. Limits raised on the way:
{", ".join(m["limits_raised"]) or "none"}. Peak memory {m["peak_memory_gib"]:.2f} GiB.

## Error at points

MSE is against the expectation of the ray-traced target (its noise is subtracted);
relative is over the variance of the target, pooled over the clouds; equal rays is the
number of rays per point at which ray tracing has the same MSE.

{report.table_of(pooled, heads)}
## Error against run time

Means over {len(m["foreground_pixels"])} unseen objects at {options["resolution"]} x
{options["resolution"]} ({", ".join(map(str, m["foreground_pixels"]))} foreground
pixels), same pixels, same machine, same run; compilation and G-buffer apart. DSSIM
after the paper's tone mapping, over the foreground.

{report.table_of(m["error_against_time"], times)}
![error against run time](error_against_time.png)

![reference, network, difference](views.png)

## Training

![learning curve](learning_curve.png)

{report.markdown_table(list(seconds), [[f"{v:.1f} s" for v in seconds.values()]])}
## Every unseen object

{report.table_of(m["unseen_shapes"] + m.get("unseen_meshes", []), columns)}"""


if __name__ == "__main__":
    start(Options, main, QUICK, __doc__)

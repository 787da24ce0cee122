"""Every method on the same pixels: tables, lost cells, error against run time.

    python -m experiments.evaluate --effect gi --out runs/evaluate_gi

compares the trained networks, full, 2D only and 3D only, with screen space, path
tracing and (where mitsuba_oidn is installed) denoised path tracing, on scenes that no
network was trained on. `--help` lists every option with its default.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from rich.console import Console

from ginn_jax import compare, compare_figures, compare_report, report
from ginn_jax.camera import orbit_camera
from ginn_jax.commandline import (
    command_line,
    require,
    require_positive,
    require_some,
    start,
)
from ginn_jax.compare import Compared, Picture, Shot
from ginn_jax.compare_light import counted_rows, sampling_seconds
from ginn_jax.compare_networks import (
    NETWORKS,
    OURS,
    Trained,
    codes_kept,
    disk_variants,
    errors_at_points,
    load_networks,
    mean_picture,
    network_memory,
    network_picture,
    other_runs,
    points_given,
)
from ginn_jax.compare_screen import screen_pictures
from ginn_jax.compare_tracing import denoised_picture, traced_picture, with_reference
from ginn_jax.dataset import count_given
from ginn_jax.evaluate import Row, at_scale
from ginn_jax.experiment import make
from ginn_jax.objects import Source
from ginn_jax.scenes import Settings, cloud_origin
from ginn_jax.upsample import shading_step

TARGET_PATHS = 1024


@dataclass(frozen=True)
class Options:
    """Compare all methods of an effect on unseen scenes."""

    effect: Literal["ao", "gi", "sss"] = "gi"
    """Ambient occlusion, global illumination or subsurface scattering."""
    out: Path = Path("runs/evaluate")
    """Folder for references, metrics.json, report.md and figures."""
    checkpoint: Path | None = None
    """The --out of a training run; left out, the weights that come with the package."""
    only_2d: Path | None = None
    """The same of the 2D-only network."""
    only_3d: Path | None = None
    """The same of the 3D-only network."""
    beside: tuple[Path, ...] = ()
    """The --out of runs of other networks of the effect, as of another width: beside
    ours where error is compared with run time."""
    meshes: Path | None = None
    """A mesh file or a folder of unseen meshes; left out, procedural shapes."""
    envmaps: Path | None = None
    """An environment map or a folder of unseen ones; left out, procedural skies."""
    objects: int = 5
    """How many scenes, evenly spread over the meshes."""
    views: int = 5
    """Cameras around each."""
    resolution: int = 512
    """Side of the images in pixels."""
    reference: int = 256
    """Rays or paths per pixel of the reference."""
    counts: tuple[int, ...] = (1, 4, 16, 64)
    """Rays or paths per pixel of the traced rivals."""
    disks: tuple[float, ...] = (0.75, 1.5)
    """Poisson disk radii at which our network runs beside its own, as times that."""
    scales: tuple[float, ...] = (0.5, 0.333)
    """Shares of the resolution at which our network shades as well."""
    draws: int = 4
    """Draws of the Poisson disks over which our network's mean is taken beside it."""
    points: int | None = None
    """Samples per object, of which a fifth measure, the others are given; left out,
    64,000 for ambient occlusion, 32,000 for light."""
    looks: int = 512
    """Directions of the direct light per sample and pixel: what all are given."""
    fewer_looks: tuple[int, ...] = (32, 128)
    """So many directions instead, at which our network runs as well, what its light
    takes counted in its time."""
    radius: float = 0.1
    """Occlusion radius."""
    seed: int = 0
    """Seed of everything."""
    quick: bool = False
    """One small view of one scene: to try things, not for numbers."""


QUICK = {"objects": 1, "views": 1, "resolution": 64, "reference": 16, "points": 4000}
QUICK |= {"counts": (1, 4), "disks": (), "scales": (0.5,), "draws": 2}
QUICK |= {"fewer_looks": (32,)}


def main(options: Options) -> dict[str, Any]:
    """Run the comparison; returns what metrics.json holds."""
    least = {"objects": 1, "views": 1, "resolution": 32, "reference": 2, "seed": 0}
    least |= {"points": 1000, "looks": 1, "draws": 2, "counts": 1, "fewer_looks": 1}
    require(options, least)
    require_positive(options, "disks")
    require_some(options, "counts")
    for scale in options.scales:
        shading_step(scale)
    console = Console()
    targets = 64 if options.quick else TARGET_PATHS
    given = options.effect, options.points, targets, options.radius
    settings = compare.effect_settings(*given)
    where = options.meshes, options.envmaps
    sources = compare.unseen_sources(
        options.effect, options.objects, *where, seed=options.seed
    )
    runs = options.checkpoint, options.only_2d, options.only_3d
    key = jax.random.key(options.seed)
    networks = load_networks(options.effect, settings, runs, key=key)
    settings = compare.with_looks(settings, options.looks)
    clouds = make(console, "clouds", sources, settings, options.out / "clouds")
    at_points, networks = errors_at_points(networks, clouds, sources, settings)
    networks |= disk_variants(networks[OURS], options.disks)
    networks |= other_runs(options.effect, settings, options.beside, key=key)
    found = []
    for source, cloud in zip(sources, clouds, strict=True):
        console.print(f"{source.name}")
        scene, networks = compare_scene(options, settings, source, cloud, networks)
        found.append(scene)
    memory = {
        name: network_memory(networks[name], count_given(settings.points))
        for name in NETWORKS
    }
    at_points = {n: r | {"memory_mib": memory[n]} for n, r in at_points.items()}
    metrics = summary(options, at_points, found, [source.name for source in sources])
    shown = [(s.name, scene.shown) for s, scene in zip(sources, found, strict=True)]
    compare_figures.draw_methods(options.out / "ablation.png", shown[:4])
    lines = metrics["error_against_time"], metrics["light_counted"]
    compare_figures.draw_front(options.out / "error_against_time.png", *lines)
    text = compare_report.write_report(metrics)
    report.write_results(options.out, metrics, text)
    lost = len(metrics["lost_cells"])
    console.print(f"{lost} cells lost: {options.out / 'report.md'}")
    return metrics


def compare_scene(
    options: Options,
    settings: Settings,
    source: Source,
    cloud: Any,
    networks: dict[str, Trained],
) -> tuple[Compared, dict[str, Trained]]:
    """All methods on all views of a scene, and the networks with limits that do."""
    stage = compare.set_stage(source, settings)
    given, units = points_given(cloud)
    apart = sampling_seconds(stage, len(given.position), seed=source.seed)
    rows, front, shown, counted = [], [], {}, []
    size = options.resolution
    for view in range(options.views):
        azimuth = 35.0 + 360.0 * view / options.views
        camera = orbit_camera(azimuth, width=size, height=size)
        shot = compare.take_shot(stage, camera, settings, seed=source.seed)
        extra = {"reference": options.reference, "size": size, "azimuth": azimuth}
        path = options.out / "references" / f"{source.name}_{size}_{view}.npz"
        origin = cloud_origin(source, settings) | extra
        shot = with_reference(
            shot, settings, options.reference, path, origin, seed=source.seed
        )
        pictures = screen_pictures(shot, camera, settings, units)
        for name in NETWORKS:
            called = name, networks[name]
            picture, networks[name] = network_picture(*called, given, shot)
            pictures.append(picture)
        about = {"name": source.name, "view": view, "seconds_sampling": apart}
        about |= {"noise_dssim": compare.noise_dssim(shot, seed=view)}
        rows += [p.row | about for p in pictures]
        if view == 0:
            shown = compare.displayed(shot, pictures)
            looks = sorted({options.looks, *options.fewer_looks})
            ends = stage, given, shot, networks[OURS], looks, apart
            counted, networks[OURS] = counted_rows(*ends, seed=source.seed)
            front += [p.row for p in pictures]
            own = next(p for p in pictures if p.row["method"] == OURS)
            front += rivals(options, settings, shot, given, own, networks, units)
            rates = {OURS + at_scale(scale) for scale in (1.0, *options.scales)}
            front += [codes_kept(row) for row in front if row["method"] in rates]
    return Compared(rows, front, shown, counted), networks


def rivals(
    options: Options,
    settings: Settings,
    shot: Shot,
    given: Any,
    own: Picture,
    networks: dict[str, Trained],
    units: np.ndarray | None,
) -> list[Row]:
    """Our network at other rates and radii, and tracing, plain and denoised."""
    rows = []
    for scale in options.scales:
        called = OURS + at_scale(scale), networks[OURS]
        picture, networks[OURS] = network_picture(*called, given, shot, scale)
        rows.append(picture.row)
    for name in [name for name in networks if name not in NETWORKS]:
        picture, networks[name] = network_picture(name, networks[name], given, shot)
        rows.append(picture.row)
    ours = own, networks[OURS]
    rows.append(mean_picture(*ours, given, shot, options.draws, units).row)
    for count in options.counts:
        seed = 1_000_003 + options.seed
        noisy = traced_picture(shot, settings, count, units, seed=seed)
        rows.append(noisy.row)
        if denoised := denoised_picture(shot, noisy, units):
            rows.append(denoised.row)
    return rows


def summary(
    options: Options,
    at_points: dict[str, Row],
    found: list[Compared],
    names: list[str],
) -> dict[str, Any]:
    """What metrics.json holds."""
    tables = {
        "rows": [row for scene in found for row in scene.rows],
        "front_rows": [row for scene in found for row in scene.front],
        "counted_rows": [row for scene in found for row in scene.counted],
    }
    metrics = compare_report.summary(options.effect, at_points, *tables.values())
    metrics |= tables | {"objects": len(names), "names": names}
    metrics |= {"command": command_line("experiments.evaluate", options)}
    metrics |= {"options": asdict(options), "environment": report.environment()}
    return metrics | {"peak_memory_gib": report.peak_memory_gib()}


if __name__ == "__main__":
    start(Options, main, QUICK, __doc__)

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
    require_shares,
    require_some,
    start,
)
from ginn_jax.compare import Compared, Picture, Shot, Stage
from ginn_jax.compare_light import counted_rows, sampling_seconds
from ginn_jax.compare_networks import (
    OURS,
    Trained,
    disk_variants,
    load_networks,
    of_samples,
    others_beside,
    warn_of_seen,
)
from ginn_jax.compare_pictures import (
    codes_kept,
    errors_at_points,
    mean_picture,
    network_memory,
    network_pictures,
    points_given,
    variant_rows,
)
from ginn_jax.compare_screen import screen_pictures
from ginn_jax.compare_tracing import traced_rows, with_reference
from ginn_jax.estimates import check_stratified
from ginn_jax.evaluate import Row, at_scale
from ginn_jax.experiment import make
from ginn_jax.lit_clouds import Cloud
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
    checkpoint: str | None = None
    """The --out of a run, or a name as "ao_fine"; left out, the effect's network."""
    only_2d: str | None = None
    """The same of the 2D-only network."""
    only_3d: str | None = None
    """The same of the 3D-only network."""
    beside: tuple[str, ...] = ()
    """The --out of other runs, or names as "ao_fine": beside ours in run time."""
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
    shares: tuple[float, ...] = (0.5,)
    """Shares of its samples that our network is given as well."""
    draws: int = 4
    """Draws of the Poisson disks over which our network's mean is taken beside it."""
    points: int | None = None
    """Samples per object, of which a fifth measure, the others are given; left out,
    64,000 for ambient occlusion, 32,000 for light."""
    looks: int = 512
    """Directions of the direct light per sample and pixel: what all are given."""
    fewer_looks: tuple[int, ...] = (32, 128)
    """So many instead, where what samples and light take is counted as well."""
    radius: float = 0.1
    """Occlusion radius."""
    seed: int = 0
    """Seed of everything."""
    quick: bool = False
    """One small view of one scene: to try things, not for numbers."""


QUICK = {"objects": 1, "views": 1, "resolution": 64, "reference": 16, "points": 4000}
QUICK |= {"counts": (1, 4), "disks": (), "scales": (0.5,), "draws": 2}
QUICK |= {"shares": (), "fewer_looks": (32,)}


def main(options: Options) -> dict[str, Any]:
    """Run the comparison; returns what metrics.json holds."""
    least = {"objects": 1, "views": 1, "resolution": 32, "reference": 2, "seed": 0}
    least |= {"points": 1000, "looks": 1, "draws": 2, "counts": 1, "fewer_looks": 1}
    require(options, least)
    require_positive(options, "disks")
    require_shares(options, "shares")
    require_some(options, "counts")
    tuple(map(shading_step, options.scales))  # raises for what is no scale
    tuple(map(check_stratified, () if options.effect == "ao" else options.counts))
    console = Console()
    targets = 64 if options.quick else TARGET_PATHS
    given = options.effect, options.points, targets, options.radius
    settings = compare.effect_settings(*given)
    given = options.effect, options.objects, options.meshes, options.envmaps
    sources = compare.unseen_sources(*given, seed=options.seed)
    names = [source.name for source in sources]
    named = options.checkpoint, options.only_2d, options.only_3d
    warn_of_seen((*named, *options.beside), names)
    key = jax.random.key(options.seed)
    networks = load_networks(options.effect, settings, named, key=key)
    beside = others_beside(options.effect, settings, options.beside, key=key)
    disk_variants(networks[OURS], options.disks)  # raises for what is no radius here
    settings = compare.with_looks(settings, options.looks)
    clouds = make(console, "clouds", sources, settings, options.out / "clouds")
    at_points, networks = errors_at_points(networks, clouds, sources, settings)
    networks |= {OURS + of_samples(s): networks[OURS] for s in options.shares}
    networks |= disk_variants(networks[OURS], options.disks)
    networks |= beside
    found = []
    for source, cloud in zip(sources, clouds, strict=True):
        console.print(f"{source.name}")
        scene, networks = compare_scene(options, settings, source, cloud, networks)
        found.append(scene)
    for name, row in at_points.items():
        row["memory_mib"] = network_memory(networks[name], points_given(clouds[0])[0])
    metrics = summary(options, at_points, found, names)
    shown = [(n, scene.shown) for n, scene in zip(names, found, strict=True)]
    compare_figures.draw_methods(options.out / "ablation.png", shown[:4])
    lines = metrics["error_against_time"], metrics["light_counted"]
    compare_figures.draw_front(options.out / "error_against_time.png", *lines)
    report.write_results(options.out, metrics, compare_report.write_report(metrics))
    console.print(f"{len(metrics['lost_cells'])} cells lost: {options.out}/report.md")
    return metrics


def compare_scene(
    options: Options,
    settings: Settings,
    source: Source,
    cloud: Cloud,
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
        known = settings, options.reference, path, origin
        shot = with_reference(shot, *known, seed=source.seed)
        pictures = screen_pictures(shot, camera, settings, units)
        more, networks = network_pictures(networks, given, shot)
        pictures += more
        about = {"name": source.name, "view": view, "seconds_sampling": apart}
        noise, pixels = compare.noise_dssim(shot, seed=view), shot.gbuffer.mask.sum()
        about |= {"noise_dssim": noise, "pixels": int(pixels)}
        rows += [p.row | about for p in pictures]
        if view == 0:
            shown = compare.displayed(shot, pictures)
            ends = options, settings, stage, given, shot, pictures, networks, units
            front, counted, networks = run_times(*ends, seed=source.seed)
    return Compared(rows, front, shown, counted), networks


def run_times(
    options: Options,
    settings: Settings,
    stage: Stage,
    given: Cloud,
    shot: Shot,
    pictures: list[Picture],
    networks: dict[str, Trained],
    units: np.ndarray | None,
    *,
    seed: int,
) -> tuple[list[Row], list[Row], dict[str, Trained]]:
    """Error against run time of the pictures, of networks beside them and of tracing;
    ours with all counted; and the networks with limits that do."""
    own = next(p for p in pictures if p.row["method"] == OURS)
    rates, shares = (1.0, *options.scales), sorted({1.0, *options.shares})
    rows, networks = variant_rows(networks, given, shot, shares, rates, units)
    rows = [p.row for p in pictures] + rows
    kept = [row for row in rows if row["method"] in {OURS + at_scale(r) for r in rates}]
    mean = mean_picture(own, networks[OURS], given, shot, options.draws, units)
    rows += [mean.row, *map(codes_kept, kept)]
    noise = 1_000_003 + options.seed
    rows += traced_rows(shot, settings, options.counts, units, seed=noise)
    sharing = {share: networks[OURS + of_samples(share)] for share in shares}
    looks = sorted({options.looks, *options.fewer_looks})
    ends = stage, given, shot, sharing, rates, looks, units
    return rows, counted_rows(*ends, seed=seed), networks


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

"""An animated object: how much each method flickers, a strip of frames, a moving image.

    python -m experiments.animation --effect gi --out runs/animation

Flicker is the mean squared change from frame to frame that the reference does not have.
`--help` lists every option with its default.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from rich.console import Console

from ginn_jax import compare, report, sequences
from ginn_jax.animation_report import (
    draw_frames,
    flicker_rows,
    pooled,
    write_report,
)
from ginn_jax.camera import orbit_camera
from ginn_jax.commandline import command_line, require, require_positive, start
from ginn_jax.compare import Stage
from ginn_jax.compare_frames import Playing, shade_next, start_playing
from ginn_jax.compare_networks import (
    OURS,
    Trained,
    disk_variants,
    load_networks,
    others_beside,
)
from ginn_jax.compare_screen import screen_pictures
from ginn_jax.compare_tracing import trace
from ginn_jax.dataset import ShadedPoints
from ginn_jax.evaluate import fill
from ginn_jax.experiment import bar
from ginn_jax.lighting import Light, load_environment, procedural_environment
from ginn_jax.lit_clouds import mean_light
from ginn_jax.lit_scenes import light_mesh, lit_points
from ginn_jax.mesh import Mesh
from ginn_jax.objects import UNSEEN_SEED, tell_apart
from ginn_jax.scenes import Occlusion, Settings


@dataclass(frozen=True)
class Options:
    """Shade an animation with every method."""

    effect: Literal["ao", "gi", "sss"] = "gi"
    """Ambient occlusion, global illumination or subsurface scattering."""
    out: Path = Path("runs/animation")
    """Folder for metrics.json, report.md, the strip and the moving image."""
    checkpoint: str | None = None
    """The --out of a run, or a name as "ao_fine"; left out, the effect's network."""
    only_2d: str | None = None
    """The same of the 2D-only network."""
    only_3d: str | None = None
    """The same of the 3D-only network."""
    beside: tuple[str, ...] = ()
    """The --out of runs of other networks of the effect, or names as "ao_fine"."""
    animation: Path | None = None
    """An .npz of vertices [T V 3] and faces [F 3], or a folder of them; left out, a
    procedural one."""
    envmap: Path | None = None
    """An environment map; left out, a procedural sky."""
    frames: int = 12
    """How many frames, from the first on."""
    resolution: int = 256
    """Side of the images in pixels."""
    reference: int = 256
    """Rays or paths per pixel of the reference."""
    draws: int = 4
    """Draws of the Poisson disks over which our network's mean is taken beside it."""
    disks: tuple[float, ...] = (0.75,)
    """Poisson disk radii at which our network runs beside its own, as times that."""
    points: int | None = None
    """Samples of the object and its ground; left out, 64,000 for ambient occlusion,
    32,000 for light."""
    looks: int = 512
    """Directions of the direct light per sample and pixel."""
    radius: float = 0.1
    """Occlusion radius."""
    seed: int = 0
    """Seed of everything."""
    quick: bool = False
    """A few small frames: to try things, not for numbers."""


ANEW = f"{OURS}, frame by frame"
QUICK = {"frames": 3, "resolution": 48, "reference": 8, "points": 3000, "looks": 32}
QUICK |= {"draws": 2, "disks": ()}


def main(options: Options) -> dict[str, Any]:
    """Shade all frames; returns what metrics.json holds."""
    least = {"frames": 2, "resolution": 32, "reference": 2, "points": 1000, "looks": 1}
    require(options, least | {"seed": 0, "draws": 2})
    require_positive(options, "disks")
    console = Console()
    counts = options.points, options.reference
    settings = compare.effect_settings(options.effect, *counts, options.radius)
    scenes = choose_sequences(options, ground=options.effect != "sss")
    light, key = choose_light(options), jax.random.key(options.seed)
    named = options.checkpoint, options.only_2d, options.only_3d
    networks = load_networks(options.effect, settings, named, key=key)
    networks |= disk_variants(networks[OURS], options.disks)
    networks |= others_beside(options.effect, settings, options.beside, key=key)
    found = {}
    with bar(console) as progress:
        total = sum(map(len, scenes.values()))
        task = progress.add_task("frames", total=total, note="")
        for name, meshes in scenes.items():
            frames, networks = shade_sequence(
                options,
                settings,
                meshes,
                light,
                networks,
                partial(progress.advance, task),
            )
            found[name] = flicker_rows(frames)
            folder = options.out / name if len(scenes) > 1 else options.out
            draw_frames(folder, frames)
    metrics = {
        "flicker": pooled(list(found.values())),
        "sequences": found,
        "frames": {name: len(meshes) for name, meshes in scenes.items()},
        "samples": settings.points,
        "command": command_line("experiments.animation", options),
        "options": asdict(options),
        "environment": report.environment(),
    }
    report.write_results(options.out, metrics, write_report(metrics))
    for row in metrics["flicker"]:
        console.print(f"{row['method']}: flicker {row['flicker']:.3g}")
    return metrics


def choose_sequences(options: Options, ground: bool) -> dict[str, list[Mesh]]:
    """The frames of every sequence as meshes, each under a name of its own."""
    if options.animation:
        paths = sequences.find_animations(options.animation)
        loaded = map(sequences.load_animation, paths)
        found = dict(zip(tell_apart(paths), loaded, strict=True))
    else:
        seed = UNSEEN_SEED + options.seed
        found = {"procedural": sequences.procedural_animation(seed, options.frames)}
    return {
        name: sequences.frames_of(animation, options.frames, ground)
        for name, animation in found.items()
    }


def choose_light(options: Options) -> Light:
    """The light of an animation; ambient occlusion needs none."""
    if options.envmap is None:
        return procedural_environment(UNSEEN_SEED + options.seed)
    return load_environment(options.envmap)


def shade_sequence(
    options: Options,
    settings: Settings,
    meshes: list[Mesh],
    light: Light,
    trained: dict[str, Trained],
    advance: Callable[[], None],
) -> tuple[dict[str, np.ndarray], dict[str, Trained]]:
    """All frames of every method, as `shade_frame` has them, and the networks."""
    given = meshes[0], settings.points, options.effect != "sss"
    carried = sequences.carried_samples(*given, seed=options.seed)
    draws = {name: options.draws if name == OURS else 1 for name in trained}
    networks = {
        name: start_playing(network, draws[name], settings.points)
        for name, network in trained.items()
    }
    frames: dict[str, list[np.ndarray]] = {}
    for number, mesh in enumerate(meshes):
        # Noise of the reference is another in each frame, as `flicker` expects.
        seed = options.seed + number
        found, networks = shade_frame(
            options, settings, mesh, light, carried, networks, seed=seed
        )
        for name, image in found.items():
            frames.setdefault(name, []).append(image)
        advance()
    after = {name: playing.draws[0] for name, playing in networks.items()}
    return {name: np.stack(images) for name, images in frames.items()}, after


def shade_frame(
    options: Options,
    settings: Settings,
    mesh: Mesh,
    light: Light,
    carried: sequences.Carried,
    networks: dict[str, Playing],
    *,
    seed: int,
) -> tuple[dict[str, np.ndarray], dict[str, Playing]]:
    """All methods' images of a frame, the reference, its variance and the mask."""
    samples, size = sequences.samples_at(mesh, carried), options.resolution
    camera = orbit_camera(width=size, height=size)
    given, stage, units = stage_of(options, settings, mesh, light, samples)
    shot = compare.take_shot(stage, camera, settings, seed=options.seed)
    truth = trace(shot, settings, options.reference, seed=seed)
    values = {"reference": truth.mean, "variance": truth.variance}
    for picture in screen_pictures(
        compare.with_truth(shot, truth), camera, settings, units
    ):
        values[picture.row["method"]] = picture.values
    after = {}
    for name, playing in networks.items():
        (own, *others), after[name] = shade_next(playing, given, shot)
        values[name] = own
        if others:
            mean = f"{name}, mean of {options.draws}"
            values[mean] = np.mean([own, *others], axis=0)
    anew = start_playing(after[OURS].draws[0], 1, settings.points)
    (values[ANEW],), _ = shade_next(anew, given, shot)
    mask = shot.gbuffer.mask
    images = {n: fill(mask, np.asarray(v)) for n, v in values.items()}
    return images | {"mask": mask, "albedo": compare.albedo_of(shot)}, after


def stage_of(
    options: Options, settings: Settings, mesh: Mesh, light: Light, samples: Any
) -> tuple[Any, Stage, np.ndarray | None]:
    """What networks are given of a frame, the frame to be seen, the units of light."""
    if isinstance(settings, Occlusion):
        nothing = np.zeros(len(samples.position), np.float32)
        points = ShadedPoints(samples.position, samples.normal, nothing, nothing)
        return points, mesh, None
    lit = light_mesh(mesh, light, settings, seed=options.seed)
    cloud = lit_points(lit, samples, options.looks, seed=options.seed)
    return cloud, lit, mean_light(cloud)


if __name__ == "__main__":
    start(Options, main, QUICK, __doc__)

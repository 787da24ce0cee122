"""One object under lights that training never saw: environment maps and point lights.

    python -m experiments.environment_maps --effect gi --out runs/environment_maps

The object stands still, so its hierarchy, neighbours and kernel values are made once
and every further light is a relighting. `--help` lists every option with its default.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from ginn_jax import compare, lit_views, report
from ginn_jax.camera import orbit_camera
from ginn_jax.commandline import require, start
from ginn_jax.errors import InputError
from ginn_jax.experiment import bar
from ginn_jax.lighting import (
    Light,
    find_environments,
    load_environment,
    procedural_environment,
)
from ginn_jax.lit_clouds import mean_light
from ginn_jax.lit_scenes import Scattering, light_mesh, lit_points
from ginn_jax.metrics import foreground, tone_map
from ginn_jax.objects import (
    UNSEEN_SEED,
    object_or_shape,
    random_point_light,
    tell_apart,
)
from ginn_jax.pairing import spread
from ginn_jax.pretrained import load_network
from ginn_jax.reference import build_scene
from ginn_jax.relight import Relightable, prepare_relighting, relight
from ginn_jax.visible import visible_samples


@dataclass(frozen=True)
class Options:
    """Shade one object under many unseen lights."""

    effect: Literal["gi", "sss"] = "gi"
    """Global illumination or subsurface scattering."""
    out: Path = Path("runs/environment_maps")
    """Folder for metrics.json, report.md and the figure."""
    checkpoint: str | None = None
    """The --out of a run, or a name as "ao_fine"; left out, the effect's network."""
    mesh: Path | None = None
    """A mesh file; left out, a procedural shape."""
    envmaps: Path | None = None
    """An environment map or a folder of them; left out, procedural skies."""
    lights: int = 5
    """How many environment maps, evenly spread over the folder."""
    point_lights: int = 2
    """How many point lights."""
    resolution: int = 256
    """Side of the images in pixels."""
    reference: int = 256
    """Paths per pixel of the reference."""
    points: int | None = None
    """Samples of the object and its ground; left out, 32,000."""
    seed: int = 0
    """Seed of everything."""
    quick: bool = False
    """Two lights on a small image: to try things, not for numbers."""


QUICK = {"lights": 1, "point_lights": 1, "resolution": 48, "reference": 8}
QUICK |= {"points": 3000}


def main(options: Options) -> dict[str, Any]:
    """Shade the object under every light; returns what metrics.json holds."""
    least = {"lights": 0, "point_lights": 0, "resolution": 32, "reference": 2}
    require(options, least | {"points": 1000, "seed": 0})
    if options.lights + options.point_lights == 0:
        raise InputError("--lights and --point-lights are both 0: give one at least")
    console = Console()
    counts = options.points, options.reference, 0.0
    settings = compare.effect_settings(options.effect, *counts)
    assert not isinstance(settings, compare.Occlusion)
    unseen = UNSEEN_SEED + options.seed
    scatters = isinstance(settings, Scattering)
    mesh = object_or_shape(options.mesh, unseen, not scatters)
    scene = build_scene(mesh)
    samples = visible_samples(scene, settings.points, options.seed, not scatters)
    config, limits, weights = load_network(options.effect, options.checkpoint)
    camera = orbit_camera(width=options.resolution, height=options.resolution)
    ready: Relightable | None = None
    rows, pictures = [], []
    with bar(console) as progress:
        lights = choose_lights(options)
        task = progress.add_task("lights", total=len(lights), note="")
        for name, light in lights.items():
            lit = light_mesh(mesh, light, settings, seed=options.seed)
            cloud = lit_points(lit, samples, settings.looks, seed=options.seed)
            view = lit_views.lit_frame(lit, camera, settings, seed=options.seed)
            truth = lit_views.traced(view, options.reference, seed=options.seed)
            view = lit_views.with_truth(view, truth)
            if ready is None:
                key = jax.random.key(options.seed)
                given = config.network, limits, weights, cloud, view.pixels
                ready, limits = prepare_relighting(*given, key=key)
            values = relight(config.network, weights, ready, cloud, view.pixels)
            row = compare.errors(view, values, mean_light(cloud))
            rows.append({"light": name} | row)
            shown = (lit_views.displayed(view, v) for v in (truth.mean, values))
            pictures.append((name, *shown))
            progress.advance(task)
    metrics = {
        "lights": rows,
        "options": asdict(options),
        "environment": report.environment(),
    }
    report.write_results(options.out, metrics, write_report(metrics))
    draw(options.out / "lights.png", pictures)
    return metrics


def choose_lights(options: Options) -> dict[str, Light]:
    """The lights by name."""
    lights: dict[str, Light] = {}
    first = UNSEEN_SEED + options.seed
    if options.envmaps is None:
        for seed in range(first, first + options.lights):
            lights[f"sky {seed}"] = procedural_environment(seed)
    else:
        paths = find_environments(options.envmaps)
        named = list(zip(tell_apart(paths), paths, strict=True))
        for name, path in spread(named, options.lights):
            lights[name] = load_environment(path)
    for seed in range(options.point_lights):
        lights[f"point light {seed}"] = random_point_light(first + seed)
    return lights


def draw(path: Path, pictures: list[tuple[str, np.ndarray, np.ndarray]]) -> None:
    """A column a light: the reference above, the network below."""
    count = len(pictures)
    figure = Figure(figsize=(2.2 * count, 4.7), layout="constrained")
    grid = figure.subplots(2, count, squeeze=False)
    for column, (name, right, mine) in zip(grid.T, pictures, strict=True):
        for axes, image in zip(column, (right, mine), strict=True):
            axes.imshow(tone_map(image, right, foreground(right)))
            axes.axis("off")
        column[0].set_title(name, fontsize=7)
    figure.savefig(path, dpi=120)


def write_report(m: dict[str, Any]) -> str:
    """report.md: the error under every light."""
    options, env = m["options"], m["environment"]
    columns = {"light": "light", "relative_mse_2d": "relative 2D MSE"}
    columns |= {"mse_2d": "2D MSE", "dssim_2d": "2D DSSIM"}
    return f"""# Lights never seen in training, {options["effect"]}

{options["resolution"]} x {options["resolution"]}, reference of {options["reference"]}
paths a pixel. {env["processor"]}, {env["cores"]} cores. MSE is of the transported
light, in units of the squared mean light, noise of the reference subtracted; relative
over the variance of the reference.

{report.table_of(m["lights"], columns)}
![reference above, network below](lights.png)
"""


if __name__ == "__main__":
    start(Options, main, QUICK, __doc__)

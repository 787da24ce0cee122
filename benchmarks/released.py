"""The networks that the authors released, beside ours on the same unseen scenes.

    git clone https://github.com/viscom-ulm/GINN
    python -m benchmarks.released --weights GINN/trained_networks --effect gi

Their data were never released, and their networks are not homogeneous: they are asked
at several exposures, that of scattering also with several units of extinction, and the
best of these counts. "Level mended" multiplies what a network says of a scene by the
factor that errs least, which only the truth can tell.
"""

import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float

from benchmarks.released_network import Released, Seen, first_limits, released_at
from benchmarks.released_weights import load_released
from benchmarks.timing import circumstances, describe
from ginn_jax import compare, compare_figures, evaluate, lit_views, report
from ginn_jax.commandline import command_line, require, require_positive, start
from ginn_jax.compare_networks import OURS, Trained, load_trained
from ginn_jax.compare_pictures import network_picture, points_given
from ginn_jax.dataset import count_given
from ginn_jax.evaluate import Row
from ginn_jax.evaluate_light import unit_errors, values_at
from ginn_jax.lit_clouds import LitCloud, mean_light, split_points
from ginn_jax.lit_scenes import Illumination, Scattering
from ginn_jax.objects import Source
from ginn_jax.pairing import spread
from ginn_jax.scenes import made_cloud

THEIRS = "the authors'"
Settings = Illumination | Scattering
Values = Float[np.ndarray, "N 3"]


@dataclass(frozen=True)
class Options:
    """Errors of the authors' released network and of ours on the same scenes."""

    weights: Path = Path("GINN/trained_networks")
    """The folder of their checkpoints."""
    effect: Literal["gi", "sss"] = "gi"
    """Global illumination or subsurface scattering."""
    out: Path = Path("runs/released")
    """Folder for clouds, metrics.json, report.md and pictures."""
    meshes: Path | None = None
    """A mesh file or a folder of meshes; left out, procedural shapes."""
    envmaps: Path | None = None
    """An environment map or a folder of them; left out, procedural skies."""
    objects: int = 12
    """How many scenes, evenly spread over the meshes."""
    pictures: int = 4
    """How many of them to compare in an image as well."""
    points: int = 32_000
    """Samples of an object, four fifths for the networks."""
    reference: int = 256
    """Paths of the reference at a point."""
    image_reference: int = 1024
    """Paths of the reference in a pixel."""
    looks: int = 512
    """Directions of the direct light per sample and pixel."""
    resolution: int = 256
    """Side of the images in pixels."""
    exposures: tuple[float, ...] = (0.75, 1.5, 3.0, 6.0)
    """Mean irradiances to show their network."""
    densities: tuple[float, ...] = (1.0, 0.3, 0.1, 0.03, 0.01)
    """Units of extinction to show their network of scattering."""
    quick: bool = False
    """One small scene: to try things, not for numbers."""


QUICK = {"objects": 1, "pictures": 1, "points": 2000, "reference": 4}
QUICK |= {"image_reference": 4, "looks": 16, "resolution": 32, "exposures": (1.5,)}
QUICK |= {"densities": (0.1,)}


def main(options: Options) -> dict[str, Any]:
    """Compare at points and in images; returns what metrics.json holds."""
    least = {"objects": 1, "pictures": 0, "points": 1000, "reference": 2}
    require(options, least | {"image_reference": 2, "looks": 1, "resolution": 16})
    require_positive(options, "exposures")
    require_positive(options, "densities")
    begin = time.perf_counter()
    effect, key = options.effect, jax.random.key(0)
    weights = load_released(effect, options.weights)
    settings = compare.effect_settings(effect, options.points, options.reference, 0.1)
    settings = compare.with_looks(settings, options.looks)
    assert isinstance(settings, Settings)
    ours = load_trained(effect, settings, None, key=key)
    where = options.meshes, options.envmaps
    sources = compare.unseen_sources(effect, options.objects, *where, seed=0)
    clouds: list[Any] = [
        made_cloud(s, settings, options.out / "clouds") for s in sources
    ]
    seens = all_seen(options)
    print("capacities", flush=True)
    limits = first_limits([points_given(c)[0] for c in clouds], key=key)
    theirs = Released(effect, weights, seens, limits, key)
    each = errors_at_points(theirs, ours, sources, clouds, settings)
    pooled = {name: summary(name, rows) for name, rows in each.items()}
    best = min(seens, key=lambda seen: pooled[named(seen)]["relative_mse_3d"])
    theirs = theirs._replace(seens=(best,))
    shown = spread(list(zip(sources, clouds, strict=True)), options.pictures)
    made = [picture_of(options, theirs, ours, settings, scene) for scene in shown]
    images = [row for rows, _ in made for row in rows]
    if made:
        pictures = [picture for _, picture in made]
        compare_figures.draw_methods(options.out / "pictures.png", pictures)
    metrics = {"points": list(pooled.values()), "best": best._asdict()}
    metrics |= {"images": evaluate.mean_rows(images), "each": each}
    metrics |= {"each_image": images} | circumstances(options, begin)
    text = write_report(options, best, metrics)
    report.write_results(options.out, metrics, text)
    print(text)
    return metrics


def all_seen(options: Options) -> tuple[Seen, ...]:
    """All that their network is shown light and matter as."""
    densities = options.densities if options.effect == "sss" else (1.0,)
    return tuple(Seen(*both) for both in product(options.exposures, densities))


def named(seen: Seen) -> str:
    """What the table calls their network when it is shown this."""
    density = f", extinction times {seen.density:g}" if seen.density != 1 else ""
    return f"{THEIRS}, mean irradiance {seen.exposure:g}{density}"


def errors_at_points(
    theirs: Released,
    ours: Trained,
    sources: list[Source],
    clouds: list[LitCloud],
    settings: Settings,
) -> dict[str, list[Row]]:
    """3D errors of our network, and of theirs for all that it is shown."""
    (network, limits, model), names = ours, list(map(named, theirs.seens))
    rows: dict[str, list[Row]] = {name: [] for name in (OURS, *names)}
    for source, cloud in zip(sources, clouds, strict=True):
        print(source.name)
        given, asked = split_points(cloud, count_given(settings.points))
        found, theirs = released_at(theirs, given, asked)
        mine, _, limits = values_at(network, limits, model, given, asked)
        values = dict(zip(names, found, strict=True))
        values[OURS] = np.broadcast_to(mine, asked.target.shape)
        for name, found in values.items():
            errors = point_errors(mean_light(given), asked, found)
            errors["ray_variance"] = errors["noise_floor_3d"] * settings.paths
            rows[name].append({"name": source.name} | errors)
    return rows


def point_errors(units: Float[np.ndarray, "3"], asked: LitCloud, values: Values) -> Row:
    """Errors of values, as they are and times the factor that errs least."""
    scale = np.where(units > 0, units, np.inf).astype(np.float64)
    mine, right = values / scale, asked.target / scale
    level = float(np.sum(mine * right) / max(np.sum(mine * mine), 1e-30))
    mended = unit_errors(units, asked, (level * values).astype(np.float32))
    together = float(np.corrcoef(mine.ravel(), right.ravel())[0, 1])
    more = {"level": level, "correlation": together, "mse_3d_level": mended["mse_3d"]}
    return unit_errors(units, asked, values) | more


def summary(name: str, rows: list[Row]) -> Row:
    """A row of the table."""
    lit = [row for row in rows if np.isfinite(row["mse_3d"])]
    pooled: Row = {"method": name} | evaluate.pool_rows(rows)
    mended, together = (
        float(np.mean([row[part] for row in lit]))
        for part in ("mse_3d_level", "correlation")
    )
    level = {"relative_mse_3d_level": mended / pooled["variance_3d"]}
    return pooled | level | {"correlation": together}


def picture_of(
    options: Options,
    theirs: Released,
    ours: Trained,
    settings: Settings,
    scene: tuple[Source, LitCloud],
) -> tuple[list[Row], tuple[str, dict[str, np.ndarray]]]:
    """2D errors of both in an image of a scene, and what it shows of their light."""
    (source, cloud), size = scene, options.resolution
    view = lit_views.lit_view(source, settings, options.image_reference, size)
    given, units = points_given(cloud)
    picture, _ = network_picture(OURS, ours, given, view)
    values = released_at(theirs, given, view.pixels)[0][0]
    rows = [picture.row, {"method": THEIRS} | compare.errors(view, values, units)]
    shown = {"reference": view.pixels.target, OURS: picture.values, THEIRS: values}
    shown = {n: evaluate.fill(view.gbuffer.mask, v) for n, v in shown.items()}
    return [row | {"scene": source.name} for row in rows], (source.name, shown)


def write_report(options: Options, best: Seen, metrics: Row) -> str:
    """The tables and how they were measured."""
    heads = {"method": "network", "relative_mse_3d": "relative 3D MSE"}
    heads |= {"median_relative_mse_3d": "median"}
    heads |= {"relative_mse_3d_level": "relative 3D MSE, level mended"}
    heads |= {"correlation": "correlation, mean"}
    flat = {"method": "network", "mse_2d": "2D MSE"}
    flat |= {"relative_mse_2d": "relative 2D MSE", "dssim_2d": "2D DSSIM"}
    return f"""# The authors' released network and ours, effect {options.effect}

{describe()}

`{command_line("benchmarks.released", options)}`

{metrics["points"][0]["clouds"]} scenes that neither network was trained on. Both are
given the same samples, theirs of every colour irradiance in units of which its mean is
as the table says, and asked at the same others. Errors are in units of the squared
mean light that ours takes, noise of the reference ({options.reference} paths) is
subtracted; relative: over the variance of the target, pooled over scenes and colours.

{report.table_of(metrics["points"], heads)}
Images of {options.resolution} x {options.resolution} of
{options.pictures} of the scenes (reference: {options.image_reference} paths), theirs at
{named(best).removeprefix(THEIRS + ", ")}:

{report.table_of(metrics["images"], flat)}
![transported light alone, reference, ours and theirs](pictures.png)
"""


if __name__ == "__main__":
    start(Options, main, QUICK, __doc__)

"""Error at points against how many samples a cloud has.

    python -m benchmarks.sample_counts --effect ao

A network is given the first of the same samples, ever fewer, and asked at others.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Int

from benchmarks.timing import circumstances, describe
from ginn_jax import compare, evaluate, report
from ginn_jax.commandline import (
    command_line,
    require,
    require_positive,
    require_shares,
    require_some,
    start,
)
from ginn_jax.compare_networks import Trained, load_trained
from ginn_jax.compare_pictures import rows_at_points
from ginn_jax.dataset import count_asked, count_given
from ginn_jax.lit_clouds import Cloud, points_of
from ginn_jax.metrics import pooled_interval
from ginn_jax.scenes import Occlusion, Settings, made_cloud


@dataclass(frozen=True)
class Options:
    """Errors of a trained network on sparser and denser clouds."""

    effect: Literal["ao", "gi", "sss"] = "ao"
    """Ambient occlusion, global illumination or subsurface scattering."""
    out: Path = Path("runs/sample_counts")
    """Folder for clouds, metrics.json and report.md."""
    checkpoint: str | None = None
    """The --out of a run, or a name as "ao_fine"; left out, the effect's network."""
    meshes: Path | None = None
    """A mesh file or a folder of meshes; left out, procedural shapes."""
    envmaps: Path | None = None
    """An environment map or a folder of them; left out, procedural skies."""
    objects: int = 8
    """How many scenes, evenly spread over the meshes; training saw none of them."""
    shares: tuple[float, ...] = (1.0, 0.5, 0.25, 0.125)
    """Shares of four fifths of the samples; a fifth measures."""
    points: int | None = None
    """Samples of an object; left out, 64,000 for occlusion, 32,000 for light."""
    reference: int = 256
    """Rays or paths of the reference."""
    looks: int = 512
    """Directions of the direct light per sample."""
    radius: float = 0.1
    """Occlusion radius."""
    quick: bool = False
    """One scene, two shares, few rays: to try things, not for numbers."""


QUICK = {"objects": 1, "shares": (1.0, 0.5), "points": 4000, "reference": 32}
QUICK |= {"looks": 32}
# Scenes that the report names.
WORST = 8


def main(options: Options) -> dict[str, Any]:
    """Measure every share; returns what metrics.json holds."""
    least = {"objects": 1, "points": 1000, "reference": 2, "looks": 1}
    require(options, least)
    require_positive(options, "radius")
    require_shares(options, "shares")
    require_some(options, "shares")
    begin = time.perf_counter()
    counts = options.points, options.reference
    settings = compare.effect_settings(options.effect, *counts, options.radius)
    settings = compare.with_looks(settings, options.looks)
    trained = load_trained(
        options.effect, settings, options.checkpoint, key=jax.random.key(0)
    )
    where = options.meshes, options.envmaps
    sources = compare.unseen_sources(options.effect, options.objects, *where, seed=0)
    clouds = [made_cloud(s, settings, options.out / "clouds") for s in sources]
    rows, each = [], []
    for share in options.shares:
        fewer = [thinned(cloud, share) for cloud in clouds]
        count = len(fewer[0].position)
        given = trained, fewer, sources, with_points(settings, count)
        found, _ = rows_at_points(*given)
        samples = {"samples": count_given(count)}
        rows.append(samples | evaluate.pool_rows(found) | interval(found))
        each += [samples | row for row in found]
    metrics = {"rows": rows, "each": each} | circumstances(options, begin)
    text = write_report(options, trained, metrics)
    report.write_results(options.out, metrics, text)
    print(text)
    return metrics


def with_points(settings: Settings, count: int) -> Settings:
    """The settings of clouds of so many samples."""
    if isinstance(settings, Occlusion):
        return replace(settings, points=count)
    return replace(settings, points=count, targets=count_asked(count))


def thinned(cloud: Cloud, share: float) -> Cloud:
    """A share of the samples that a network is given, and of those it is asked at."""
    return points_of(cloud, rows_of(len(cloud.position), share))


def rows_of(count: int, share: float) -> Int[np.ndarray, "_"]:
    """The first of four fifths of the rows, and of the last fifth."""
    given = count_given(count)
    total = int(count * share)
    first = count_given(total)
    return np.r_[:first, given : given + total - first]


def interval(found: list[evaluate.Row]) -> evaluate.Row:
    """What the pooled relative error might be of other scenes of the same kind."""
    lit = [row for row in found if np.isfinite(row["mse_3d"])]
    parts = ([row[part] for row in lit] for part in ("mse_3d", "variance_3d"))
    low, high = pooled_interval(*parts)
    return {"low": low, "high": high}


def worst(each: list[evaluate.Row]) -> list[evaluate.Row]:
    """The scenes that most of the pooled error is of, where all samples are given."""
    most = max(row["samples"] for row in each)
    rows = [row for row in each if row["samples"] == most]
    total = sum(row["mse_3d"] for row in rows)
    rows = [row | {"share": row["mse_3d"] / total} for row in rows]
    return sorted(rows, key=lambda row: -row["mse_3d"])[:WORST]


def write_report(options: Options, trained: Trained, metrics: evaluate.Row) -> str:
    """The table and how it was measured."""
    heads = {"samples": "samples given", "relative_mse_3d": "relative 3D MSE"}
    heads |= {"low": "from", "high": "to", "median_relative_mse_3d": "median"}
    heads |= {"noise_floor_3d": "noise floor"}
    heads |= {"equal_rays": "equal rays or paths"}
    scene = {"name": "scene", "relative_mse_3d": "relative 3D MSE", "mse_3d": "3D MSE"}
    scene |= {"share": "share of the error of all scenes"}
    return f"""# Error against the number of samples, effect {options.effect}

{describe()}

`{command_line("benchmarks.sample_counts", options)}`

{metrics["rows"][0]["clouds"]} scenes, Poisson disk radii {trained[0].levels}. The
network is given the first of the same samples, and asked at the first of the same other
points; noise of the reference ({options.reference} rays or paths) is subtracted.
Relative: over the variance of the target, pooled over the scenes; in 95 % of draws of
as many scenes from these it is "from" ... "to".

{report.table_of(metrics["rows"], heads)}
Most of the error with all samples is of

{report.table_of(worst(metrics["each"]), scene)}"""


if __name__ == "__main__":
    start(Options, main, QUICK, __doc__)

"""How fast ground truth of global illumination is made, against a bare Mitsuba loop.

    python -m benchmarks.generation

Paths per second of our estimator and of whole clouds (shape, sky, samples, direct and
indirect light, scaled to the same paths), beside Mitsuba's `path` integrator started
from the same points, all in turns on the same scenes.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import circumstances, describe, measure
from ginn_jax import lit_scenes, objects, report
from ginn_jax.commandline import require, start
from ginn_jax.estimates import PATHS_PER_LAUNCH
from ginn_jax.irradiance import LitScene, indirect_irradiance
from ginn_jax.pairing import pair_up
from ginn_jax.reference import OFFSET, build_scene, columns
from ginn_jax.renderer import use_mitsuba
from ginn_jax.visible import visible_samples


@dataclass(frozen=True)
class Options:
    """Time the making of ground truth."""

    out: Path = Path("runs/generation")
    """Folder for metrics.json and report.md."""
    scenes: int = 3
    """Procedural objects, each under its own light."""
    points: int = 20_000
    """Samples per object."""
    paths: int = 64
    """Paths per sample."""
    repeats: int = 3
    """Timed calls of each."""
    quick: bool = False
    """Few points and paths: to try things, not for numbers."""


QUICK = {"scenes": 1, "points": 1000, "paths": 4, "repeats": 1}


def bare_loop(
    scene: LitScene, points: np.ndarray, normals: np.ndarray, paths: int
) -> np.ndarray:
    """What a user would write: chunks of cosine rays through Mitsuba's `path`."""
    mi, variant = use_mitsuba()
    import drjit as dr

    size, parts = max(1, PATHS_PER_LAUNCH // paths), []
    start = points + OFFSET * np.abs(scene.mesh.vertices).max() * normals
    with mi.variant_context(variant):
        integrator = mi.load_dict({"type": "path", "hide_emitters": True})
        for first in range(0, len(points), size):
            count = len(points[first : first + size])
            place = mi.Point3f(columns(start[first : first + size]))
            normal = mi.Normal3f(columns(normals[first : first + size]))
            row = dr.arange(mi.UInt32, count * paths) // paths
            sampler = mi.load_dict({"type": "independent"})
            sampler.seed(first, count * paths)
            local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
            frame = mi.Frame3f(dr.gather(mi.Normal3f, normal, row))
            ray = mi.Ray3f(dr.gather(mi.Point3f, place, row), frame.to_world(local))
            radiance, _, _ = integrator.sample(scene.handle, sampler, ray)
            dr.eval(radiance)
            total = [dr.block_reduce(dr.ReduceOp.Add, c, paths) for c in radiance]
            parts.append(np.pi * np.stack([c.numpy() for c in total], 1) / paths)
    return np.concatenate(parts)


def compare(options: Options, source: objects.Source) -> dict[str, Any]:
    """Paths per second on one scene."""
    settings = lit_scenes.Illumination(options.points, options.paths)
    lit = lit_scenes.light_up(source, settings)
    scene = build_scene(lit.scene.mesh)
    cloud = visible_samples(scene, options.points, source.seed)
    ends = cloud.position, cloud.normal
    calls = {
        "bare": lambda: bare_loop(lit.scene, *ends, options.paths),
        "ours": lambda: indirect_irradiance(
            lit.scene, *ends, paths=options.paths, seed=0
        ),
        "cloud": lambda: lit_scenes.lit_cloud(source, settings),
    }
    mine, other = calls["ours"]().mean.mean(), calls["bare"]().mean()
    times = measure(calls, options.repeats)
    count = 1e-6 * options.points * options.paths
    return {
        "scene": source.name,
        **{name: count / t.median for name, t in times.items()},
        "ours_over_bare": times["bare"].median / times["ours"].median,
        "cloud_over_bare": times["bare"].median / times["cloud"].median,
        "mean_difference": float(abs(mine / other - 1)),
        "timings": {name: t.record() for name, t in times.items()},
    }


def main(options: Options) -> dict[str, Any]:
    """Time all scenes; returns what metrics.json holds."""
    require(options, {"scenes": 1, "points": 100, "paths": 2, "repeats": 1})
    begin = time.perf_counter()
    count = options.scenes
    shapes = objects.procedural_sources(count, objects.BENCHMARK_SEED)
    lights = objects.procedural_lights(count, objects.BENCHMARK_SEED)
    rows = [compare(options, s) for s in pair_up(shapes, lights, 1)]
    metrics = {"rows": rows} | circumstances(options, begin)
    heads = {"scene": "scene", "bare": "Mitsuba M paths/s", "ours": "ours M paths/s"}
    heads |= {"ours_over_bare": "ratio", "cloud": "whole cloud M paths/s"}
    heads |= {"cloud_over_bare": "ratio", "mean_difference": "difference of means"}
    text = f"""# Making ground truth of global illumination

{describe()}

{options.points} points, {options.paths} paths each; medians of {options.repeats} calls
in turns. A whole cloud is the shape, its light, visible samples, direct and indirect
light.

{report.table_of(rows, heads)}"""
    report.write_results(options.out, metrics, text)
    return metrics


if __name__ == "__main__":
    start(Options, main, QUICK, __doc__)

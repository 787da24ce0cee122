"""How time and memory grow with points and with pixels.

    python -m benchmarks.scaling

f_3D with all its geometry over clouds of 1k to 1M points whose Poisson disk shrinks
with them (so that levels, edges and points grow alike), and f_2D over 64k to 4M pixels
of one scene. Slopes are of the logarithms, fitted over all sizes: 1 is linear.
"""

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from benchmarks.in_blocks import block_memory, blocks_call
from benchmarks.timing import Timing, circumstances, describe, measure
from ginn_jax import image, inference, objects, reference, report
from ginn_jax.architecture import Network
from ginn_jax.camera import orbit_camera
from ginn_jax.commandline import require, require_some, start
from ginn_jax.presets import compact_network
from ginn_jax.recipe import Training
from ginn_jax.samples import sample_surface
from ginn_jax.searches import uniform_limits
from ginn_jax.train import init_state
from ginn_jax.visible import visible_samples

# Of the cloud under the frames.
FRAME_POINTS = 16_000


@dataclass(frozen=True)
class Options:
    """Fit how the time of f_3D grows with points and that of f_2D with pixels."""

    out: Path = Path("runs/scaling")
    """Folder for metrics.json, report.md and the figure."""
    points: tuple[int, ...] = (1000, 8000, 64_000, 256_000, 1_000_000)
    """Points of the clouds."""
    resolutions: tuple[int, ...] = (288, 576, 1152, 2304)
    """Sides of the frames; about six tenths of the pixels are foreground."""
    repeats: int = 3
    """Timed calls of each size."""
    quick: bool = False
    """Two small sizes of each: to try things, not for numbers."""


QUICK = {"points": (1000, 4000), "resolutions": (64, 128), "repeats": 1}


def network_for(points: int) -> Network:
    """The default table with radii for a cloud of so many points, .02 at 16,000."""
    scale = (16_000 / points) ** 0.5
    levels = tuple(scale * level for level in (0.02, 0.05, 0.1))
    return compact_network(levels=levels, query_radius=2.5 * levels[0])


def weights_of(network: Network) -> Any:
    """Untrained weights: times do not depend on them."""
    return jax.device_put(
        init_state(Training(network, steps=1)).variables, jax.devices()[0]
    )


def over_points(options: Options, scene: reference.Scene) -> list[dict[str, Any]]:
    """f_3D with its geometry, for clouds of each size."""
    rows = []
    for count in options.points:
        network = network_for(count)
        variables = weights_of(network)
        cloud = sample_surface(scene.mesh, count, seed=0)
        # Too small for anything, so that JAX has it measured: loose levels cost time.
        limits = uniform_limits(network, 64)
        arguments = variables, cloud.position, cloud.normal
        key = jax.random.key(0)
        encoded, limits = inference.encode_cloud(network, limits, *arguments, key=key)
        call = partial(inference.encode_cloud, network, limits, *arguments, key=key)
        timing = measure({"f_3D": call}, options.repeats)["f_3D"]
        mask = encoded.points.mask
        sizes = {"size": count, "kept": int(np.sum(mask)), "rows": len(mask)}
        rows.append(sizes | {"timing": timing})
    return rows


def over_pixels(options: Options, scene: reference.Scene) -> list[dict[str, Any]]:
    """f_2D, for frames of each size; in blocks its scratch memory is a block's."""
    network = network_for(FRAME_POINTS)
    variables = weights_of(network)
    cloud = visible_samples(scene, FRAME_POINTS, seed=0)
    limits = uniform_limits(network, 64)
    encoded, limits = inference.encode_cloud(
        network,
        limits,
        variables,
        cloud.position,
        cloud.normal,
        key=jax.random.key(0),
    )
    rows = []
    for side in options.resolutions:
        g = reference.render_gbuffer(scene, orbit_camera(35.0, width=side, height=side))
        pixels = g.position, g.normal, g.mask
        given = network, limits, variables, encoded
        call = partial(image.shade_image, *given, *pixels)
        timing = measure({"f_2D": call}, options.repeats)["f_2D"]
        _, limits = blocks_call(*given, g)
        scratch = block_memory(network, limits, variables, encoded)
        rows.append({"size": int(g.mask.sum()), "side": side, "timing": timing})
        rows[-1]["scratch_mib"] = scratch / 2**20
    return rows


def slope(rows: list[dict[str, Any]]) -> float:
    """Exponent of the time in the size, by least squares of the logarithms."""
    sizes = np.log([row["size"] for row in rows])
    return float(np.polyfit(sizes, np.log([r["timing"].median for r in rows]), 1)[0])


def main(options: Options) -> dict[str, Any]:
    """Time all sizes and fit; returns what metrics.json holds."""
    require(options, {"repeats": 1, "points": 100, "resolutions": 32})
    # A slope is fitted to them.
    require_some(options, "points", "resolutions", least=2)
    begin = time.perf_counter()
    scene = reference.build_scene(
        objects.load_object(objects.procedural_sources(1, objects.BENCHMARK_SEED)[0])
    )
    tables = {
        "points": over_points(options, scene),
        "pixels": over_pixels(options, scene),
    }
    slopes = {name: slope(rows) for name, rows in tables.items()}
    peak = report.peak_memory_gib()
    text = write_report(options, tables, slopes, peak)
    records = {
        name: [r | {"timing": r["timing"].record()} for r in rows]
        for name, rows in tables.items()
    }
    metrics = {"tables": records, "slopes": slopes, "peak_memory_gib": peak}
    metrics |= circumstances(options, begin)
    report.write_results(options.out, metrics, text)
    draw(options.out / "scaling.png", tables)
    print(text)
    return metrics


def write_report(
    options: Options,
    tables: dict[str, list[dict[str, Any]]],
    slopes: dict[str, float],
    peak: float,
) -> str:
    """report.md: both tables and their slopes."""

    def microseconds(row: dict[str, Any], timing: Timing) -> float:
        return 1e6 * timing.median / row["size"]

    points = [
        [
            r["size"],
            r["kept"],
            r["rows"],
            str(r["timing"]),
            microseconds(r, r["timing"]),
        ]
        for r in tables["points"]
    ]
    pixels = [
        [
            f"{r['side']}²",
            r["size"],
            str(r["timing"]),
            microseconds(r, r["timing"]),
            r["scratch_mib"],
        ]
        for r in tables["pixels"]
    ]
    heads = ["points", "after Poisson disk", "in rows", "f_3D", "µs a point"]
    flat = ["frame", "pixels", "f_2D", "µs a pixel", "scratch in blocks, MiB"]
    return f"""# Scaling

Median of {options.repeats} calls ± half the interquartile range; compilation apart.
Time grows as points^{slopes["points"]:.2f} and pixels^{slopes["pixels"]:.2f}. Peak
memory of the whole run {peak:.2f} GiB.

{describe()}

{report.markdown_table(heads, points)}
{report.markdown_table(flat, pixels)}
![scaling](scaling.png)
"""


def draw(path: Path, tables: dict[str, list[dict[str, Any]]]) -> None:
    """Time over size, both axes logarithmic."""
    figure = Figure(figsize=(9, 4), layout="constrained")
    for axes, (name, rows) in zip(figure.subplots(1, 2), tables.items(), strict=True):
        sizes = np.array([row["size"] for row in rows])
        times = np.array([1e3 * row["timing"].median for row in rows])
        axes.loglog(sizes, times, "o-", label="measured")
        axes.loglog(
            sizes, times[-1] * sizes / sizes[-1], ":", color="gray", label="linear"
        )
        axes.set(xlabel=name, ylabel="ms")
        axes.legend()
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    start(Options, main, QUICK)

"""Time of f_2D for one frame: in lanes, in blocks, straightforward, and ray tracing.

    python -m benchmarks.f2d

The 3D-to-2D step of the network, search, convolution and output, for the foreground
pixels of a frame, from the G-buffer to values on the host. Weights are untrained: times
and agreement do not depend on them. Results are compared before anything is timed.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.in_blocks import block_memory, blocks_call
from benchmarks.straightforward import shade_plainly
from benchmarks.timing import Timing, describe, measure, write_cases
from ginn_jax import image, inference, objects, reference, report
from ginn_jax.architecture import Network
from ginn_jax.camera import orbit_camera
from ginn_jax.commandline import require, require_positive, require_some, start
from ginn_jax.errors import InputError
from ginn_jax.evaluate import at_scale
from ginn_jax.mesh import find_meshes
from ginn_jax.network import Variables
from ginn_jax.presets import compact_network
from ginn_jax.receptive_field import Oriented
from ginn_jax.recipe import Training
from ginn_jax.reference import GBuffer, Scene
from ginn_jax.searches import uniform_limits
from ginn_jax.shading import Encoded
from ginn_jax.train import init_state
from ginn_jax.visible import visible_samples

# The paper's AO, whole network, 1024 x 1024, NVIDIA GTX 1080.
PAPER_MS = 43.3


@dataclass(frozen=True)
class Options:
    """Time the 3D-to-2D step against its straightforward form and against rays."""

    out: Path = Path("runs/f2d")
    """Folder for metrics.json and report.md."""
    mesh: Path | None = None
    """A mesh file; without it a procedural shape."""
    resolution: int = 1024
    """Side of the frame in pixels."""
    points: int = 20_000
    """Samples of the object before the disk."""
    disks: tuple[float, ...] = (0.01, 0.01, 0.02, 0.02)
    """Poisson disk radii of the finest level, one for each f_2D radius."""
    radii: tuple[float, ...] = (0.02, 0.025, 0.035, 0.05)
    """f_2D radii."""
    hidden: int = 16
    """Width of the kernel perceptron."""
    rays: tuple[int, ...] = (1, 4, 10, 16)
    """Rays per pixel of the ray-traced frames."""
    scales: tuple[float, ...] = (0.5, 0.333)
    """Resolution scales to time beside full rate."""
    repeats: int = 9
    """Timed calls of each variant."""
    quick: bool = False
    """A small frame: to try things, not for numbers."""


QUICK = {"resolution": 128, "disks": (0.02,), "radii": (0.05,), "rays": (1,)}
QUICK |= {"scales": (0.5,), "repeats": 2}


def make_frame(options: Options) -> tuple[Scene, GBuffer]:
    """An object on its ground plane, and what a camera sees of it."""
    source = objects.procedural_sources(1, objects.BENCHMARK_SEED)[0]
    if options.mesh is not None:
        source = objects.file_sources(find_meshes(options.mesh))[0]
    scene = reference.build_scene(objects.load_object(source))
    size = options.resolution
    return scene, reference.render_gbuffer(
        scene, orbit_camera(35.0, width=size, height=size)
    )


def plain_call(
    network: Network,
    variables: Variables,
    encoded: Encoded,
    queries: Oriented,
) -> Callable[[], Any]:
    """The straightforward form with capacities that just suffice."""
    shade = jax.jit(shade_plainly, static_argnums=(0, 1, 2))
    candidates = edges = 1 << 16
    while True:
        _, tested, found = shade(
            network, candidates, edges, variables, encoded, queries
        )
        if int(tested) <= candidates and int(found) <= edges:
            break
        candidates = max(candidates, int(1.02 * int(tested)))
        edges = max(edges, int(1.02 * int(found)))
    return partial(shade, network, candidates, edges, variables, encoded, queries)


def compare(
    options: Options, disk: float, radius: float, scene: Scene, gbuffer: GBuffer
) -> dict[str, Any]:
    """Agreement and times of one network on the frame."""
    network = compact_network(
        levels=(disk, 0.05, 0.1), query_radius=radius, hidden=options.hidden
    )
    state = init_state(Training(network, steps=1))
    variables = jax.device_put(state.variables, jax.devices()[0])
    cloud = visible_samples(scene, options.points, seed=0)
    key = jax.random.key(0)
    # They have to be raised, so they end up close to the need.
    limits = uniform_limits(network, 1 << 12)
    encoded, limits = inference.encode_cloud(
        network, limits, variables, cloud.position, cloud.normal, key=key
    )
    pixels = gbuffer.position, gbuffer.normal, gbuffer.mask
    ends = variables, encoded, *pixels

    def ours(scale: float = 1.0) -> Any:
        return image.shade_image(network, limits, *ends, resolution_scale=scale)[0]

    in_blocks, fitting = blocks_call(network, limits, variables, encoded, gbuffer)
    mask = gbuffer.mask
    place, normal = (jnp.asarray(a[mask]) for a in pixels[:2])
    queries = Oriented(place, normal, jnp.ones(len(place), bool))
    alone = jax.device_put(jax.device_get(encoded), jax.devices()[0])
    plain = plain_call(network, variables, alone, queries)
    expected = image.as_openness(np.asarray(plain()[0]))
    rows, values = in_blocks()
    by_rows = image.as_openness(values), ours().ravel()[rows]
    pairs = by_rows, (ours()[mask], expected)
    difference = max(float(np.abs(a - b).max()) for a, b in pairs)
    if not difference <= 1e-4:
        raise AssertionError(f"results differ by {difference}")
    calls: dict[str, Callable[[], Any]] = {"ours": ours, "straightforward": plain}
    calls["in blocks"] = in_blocks
    calls |= {"ours" + at_scale(s): partial(ours, s) for s in options.scales}
    for rays in options.rays:
        calls[f"{rays} rays"] = partial(
            reference.ambient_occlusion,
            *(scene, gbuffer.position[mask], gbuffer.normal[mask], 0.1),
            rays=rays,
            seed=0,
        )
    timings = measure(calls, options.repeats)
    return {
        "disk": disk,
        "radius": radius,
        "points": int(np.sum(encoded.points.mask)),
        "pixels": int(mask.sum()),
        "edges": int(plain()[2]),
        "difference": difference,
        "block_bytes": block_memory(network, fitting, variables, encoded),
        "timings": timings,
    }


def main(options: Options) -> dict[str, Any]:
    """Compare every network on one frame; returns what metrics.json holds."""
    least = {"resolution": 32, "points": 500, "repeats": 1, "hidden": 1, "rays": 1}
    require(options, least)
    require_positive(options, "disks", "radii")
    require_some(options, "disks")
    if len(options.disks) != len(options.radii):
        raise InputError(
            f"--disks are {len(options.disks)}, --radii {len(options.radii)}: give as "
            "many"
        )
    begin = time.perf_counter()
    scene, gbuffer = make_frame(options)
    pairs = zip(options.disks, options.radii, strict=True)
    cases = [compare(options, disk, r, scene, gbuffer) for disk, r in pairs]
    return write_cases(options, cases, write_report(options, cases), begin)


def write_report(options: Options, cases: list[dict[str, Any]]) -> str:
    """report.md: a row for each network, then the rays."""
    names = list(cases[0]["timings"])
    heads = ["disk", "f_2D radius", "points", "pixels", "edges a pixel", *names]
    rows = [
        [c["disk"], c["radius"], c["points"], c["pixels"], c["edges"] / c["pixels"]]
        + [str(c["timings"][name]) for name in names]
        for c in cases
    ]
    ratios = [_ratios(c["timings"], c) for c in cases]
    return f"""# f_2D of one frame

{options.resolution} x {options.resolution}, latent 16, kernel perceptron
{options.hidden} wide; median of {options.repeats} calls ± half the interquartile range;
G-buffer, f_3D and compilation apart. On a CPU ours runs in lanes; "in blocks" is what a
GPU runs. All agree to {max(c["difference"] for c in cases):.1e}. Ray tracing: ambient
occlusion of the same pixels. The paper's whole network: {PAPER_MS} ms (1024 x 1024,
NVIDIA GTX 1080).

{describe()}

{report.markdown_table(heads, rows)}
{report.markdown_table(list(ratios[0]), [list(r.values()) for r in ratios])}"""


def _ratios(timings: dict[str, Timing], case: dict[str, Any]) -> dict[str, Any]:
    """What the times mean: ratios, milliseconds per megapixel, memory."""
    ours, plain = timings["ours"].median, timings["straightforward"].median
    row: dict[str, Any] = {"disk": case["disk"], "f_2D radius": case["radius"]}
    row |= {"ms per megapixel": 1e9 * ours / case["pixels"]}
    row |= {"straightforward / ours": plain / ours}
    for name, timing in timings.items():
        if name.endswith("rays"):
            row[f"ours / {name}"] = ours / timing.median
    return row | {"block scratch MiB": case["block_bytes"] / 2**20}


if __name__ == "__main__":
    start(Options, main, QUICK)

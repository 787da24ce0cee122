"""Quality against time by the Poisson disk radius at test time (paper, TimingPD).

    python -m benchmarks.poisson_radii --run runs/ao_train

One set of weights, one object after the other, radii in turns. Capacities are measured
for each radius, so that no radius pays for another's.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.poisson_report import PAPER, draw, write_report
from benchmarks.timing import circumstances, measure
from ginn_jax import lit_scenes, objects, presets, report, scenes
from ginn_jax.architecture import Network
from ginn_jax.checkpoint import RECORD, damaged, load_weights, read_record
from ginn_jax.commandline import require, start
from ginn_jax.dataset import ShadedPoints
from ginn_jax.disk_radius import with_disk_radius
from ginn_jax.errors import InputError
from ginn_jax.evaluate import View, image_errors, reference_view
from ginn_jax.geometry import build_geometry, build_query_field
from ginn_jax.image import as_openness, shade_image
from ginn_jax.inference import BLOCK, encode_cloud, shade_points
from ginn_jax.limits import Demands, Limits, measure_limits
from ginn_jax.mesh import find_meshes
from ginn_jax.metrics import true_mse
from ginn_jax.neighbors import bucket, pad_rows
from ginn_jax.network import Variables
from ginn_jax.receptive_field import Oriented, in_coherent_order
from ginn_jax.reference import build_scene
from ginn_jax.samples import Samples
from ginn_jax.searches import limit_names
from ginn_jax.train import Training, init_state

UNSEEN_SEED = 20_000_000
ASKED = 4096
SLACK = 1.1


@dataclass(frozen=True)
class Options:
    """Time and error of a trained network at several Poisson disk radii."""

    out: Path = Path("runs/poisson_radii")
    """Folder for metrics.json, report.md and the figure."""
    run: Path | None = None
    """Folder of a finished ao_train with the weights; without one they are untrained:
    times hold, errors do not."""
    meshes: Path | None = None
    """A mesh file or a folder of meshes; without it procedural shapes."""
    shapes: int = 2
    """Procedural shapes, of seeds that training does not use."""
    radii: tuple[float, ...] = (0.0075, 0.01, 0.0125, 0.015)
    """Poisson disk radii, in units of the object's longest side."""
    points: int = 64_000
    """Samples of an object before the disk; few of them starve the small radii."""
    resolution: int = 512
    """Side of the image in pixels."""
    rays: int = 1024
    """Rays of the reference, per point and per pixel."""
    occlusion: float | None = None
    """Occlusion radius; without it that of the run, or 0.1."""
    repeats: int = 7
    """Timed calls of each radius."""
    quick: bool = False
    """Two radii, a small image, few rays: to try things, not for numbers."""


QUICK = {"radii": (0.01, 0.015), "points": 4000, "resolution": 96, "rays": 32}
QUICK |= {"repeats": 2}


class Model(NamedTuple):
    """A network and its weights, and the occlusion radius that it learned."""

    network: Network
    variables: Variables
    occlusion: float


class Subject(NamedTuple):
    """An object: what the network is given, and references at points and at pixels."""

    name: str
    given: Samples
    asked: ShadedPoints
    view: View


def load_model(folder: Path | None) -> Model:
    """The weights of a finished run, or untrained ones of the default network."""
    if folder is None:
        network = presets.DEFAULT
        config = Training(network, steps=1, batch_size=1, points=64, queries=64)
        state = init_state(config)
        return Model(network, state.variables, scenes.Occlusion.radius)
    config, _, variables = load_weights(folder)
    record = read_record(folder / RECORD, "no run: name the --out of ao_train")
    with damaged(folder / RECORD, "name the --out of ao_train"):
        radius = float(record["data"]["radius"])
    return Model(config.network, variables, radius)


def make_subject(source: objects.Source, options: Options, radius: float) -> Subject:
    """Sample and ray-trace an object; the points asked are others than those given."""
    mesh = objects.load_object(source)
    given = lit_scenes.visible_samples(build_scene(mesh), options.points, source.seed)
    settings = scenes.Occlusion(ASKED, options.rays, radius)
    asked = scenes.occlusion_cloud(mesh, settings, source.seed + 1)
    view = reference_view(mesh, radius, options.rays, source.seed, options.resolution)
    return Subject(source.name, given, asked, view)


@partial(jax.jit, static_argnums=(0, 1))
def _demands(
    network: Network, limits: Limits, cloud: Oriented, blocks: Oriented
) -> Demands:
    """What f_3D and every block of f_2D need."""
    cloud, order = in_coherent_order(cloud)
    key = jax.random.key(0)
    geometry, demands = build_geometry(network, limits, cloud, order, key=key)
    ends = geometry.levels[0], geometry.grid, geometry.area

    def needs_of(block: Oriented) -> Demands:
        queries, _ = in_coherent_order(block)
        return build_query_field(network, limits, *ends, queries)[1]

    needs = jax.lax.map(needs_of, blocks)
    return demands | jax.tree.map(lambda need: jnp.max(need), needs)


def tight_limits(network: Network, subject: Subject) -> Limits:
    """Capacities with little to spare for this cloud and these pixels."""
    given, asked, gbuffer = subject.given, subject.asked, subject.view.gbuffer
    cloud = _padded(given.position, given.normal, bucket(len(given.position)))
    position = np.concatenate([gbuffer.position[gbuffer.mask], asked.position])
    normal = np.concatenate([gbuffer.normal[gbuffer.mask], asked.normal])
    flat = _padded(position, normal, -(-len(position) // BLOCK) * BLOCK)
    blocks = jax.tree.map(lambda a: a.reshape(-1, BLOCK, *a.shape[1:]), flat)
    names = limit_names(network)
    powers = {"points": 15, "words": 14}
    rows = [1 << powers.get(name.split(".")[1], 20) for name in names]
    generous = Limits(tuple(zip(names, rows, strict=True)))

    def probe(limits: Limits, _: int) -> Demands:
        return _demands(network, limits, cloud, blocks)

    return measure_limits(generous, probe, 1, SLACK)


def _padded(position: np.ndarray, normal: np.ndarray, rows: int) -> Oriented:
    points, mask = pad_rows(position, rows)
    return Oriented(*map(jnp.asarray, (points, pad_rows(normal, rows)[0], mask)))


def evaluate(model: Model, subject: Subject, radius: float) -> tuple[dict, dict]:
    """Errors at one radius, and the two calls to be timed."""
    network = with_disk_radius(model.network, radius)
    limits = tight_limits(network, subject)
    given, asked, gbuffer = subject.given, subject.asked, subject.view.gbuffer
    arrays = given.position, given.normal

    def encode() -> Any:
        return encode_cloud(
            network, limits, model.variables, *arrays, key=jax.random.key(0)
        )

    encoded, used = encode()
    pixels = gbuffer.position, gbuffer.normal, gbuffer.mask
    shaded = partial(shade_image, network, limits, model.variables, encoded, *pixels)
    image, used_2d = shaded()
    assert used == used_2d == limits, "a capacity that was measured did not suffice"
    ends = np.asarray(asked.position), np.asarray(asked.normal)
    values, _ = shade_points(network, limits, model.variables, encoded, *ends)
    noise = float(np.mean(asked.variance))
    row = {"object": subject.name, "radius": radius}
    row |= {"points": int(np.sum(encoded.points.mask)), "pixels": int(pixels[2].sum())}
    row |= {"mse_3d": true_mse(as_openness(values), asked.target, asked.variance)}
    row |= image_errors(subject.view, image)
    row |= {"noise_floor_3d": noise, "limits": dict(limits.sizes)}
    return row, {"f_3D": encode, "f_2D": shaded}


def compare(model: Model, subject: Subject, options: Options) -> list[dict[str, Any]]:
    """One row for each radius of an object, timed in turns."""
    rows, calls = [], dict[tuple[str, float], Callable[[], Any]]()
    for radius in options.radii:
        begin = time.perf_counter()
        row, parts = evaluate(model, subject, radius)
        row["seconds_compile"] = time.perf_counter() - begin
        rows.append(row)
        calls |= {(part, radius): call for part, call in parts.items()}
    names = {f"{part} {radius}": call for (part, radius), call in calls.items()}
    timings = measure(names, options.repeats)
    for row in rows:
        for part in ("f_3D", "f_2D"):
            timing = timings[f"{part} {row['radius']}"]
            row |= {f"ms_{part}": 1e3 * timing.median, part: timing.record()}
    return rows


def main(options: Options) -> dict[str, Any]:
    """Compare radii on every object; returns what metrics.json holds."""
    require(options, {"shapes": 1, "points": 1000, "resolution": 32, "rays": 2})
    require(options, {"repeats": 1})
    if not options.radii:
        raise InputError("--radii is empty: give at least one")
    begin = time.perf_counter()
    model = load_model(options.run)
    variables = jax.device_put(model.variables, jax.devices()[0])
    occlusion = options.occlusion or model.occlusion
    model = model._replace(variables=variables, occlusion=occlusion)
    for radius in options.radii:
        with_disk_radius(model.network, radius)  # for its checks
    sources = objects.procedural_sources(options.shapes, UNSEEN_SEED)
    if options.meshes is not None:
        sources = objects.file_sources(find_meshes(options.meshes))
    subjects = (make_subject(s, options, model.occlusion) for s in sources)
    rows = [row for subject in subjects for row in compare(model, subject, options)]
    metrics = {
        "rows": rows,
        "trained": options.run is not None,
        "occlusion_radius": model.occlusion,
        "network": asdict(model.network),
        "asked": ASKED,
        "paper": [[*where, *what] for where, what in PAPER.items()],
        "seconds_compile": sum(row["seconds_compile"] for row in rows),
    } | circumstances(options, begin)
    text = write_report(metrics)
    report.write_results(options.out, metrics, text)
    draw(options.out / "poisson_radii.png", rows, metrics["trained"])
    print(text)
    return metrics


if __name__ == "__main__":
    start(Options, main, QUICK)

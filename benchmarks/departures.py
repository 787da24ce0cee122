"""What each departure from the paper brings: networks of occlusion that lack one.

    python -m benchmarks.departures

All train for as many steps on the same clouds and are asked about the same unseen
objects: ours, ours from other random weights (how far chance goes), the paper's table
of layers, trained as ours and by the paper's optimiser, ours without any departure,
which is the paper's convolution in our table of layers, and without one at a time.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
from rich.console import Console

from benchmarks.timing import circumstances, describe
from ginn_jax import evaluate, experiment, objects, report, scenes
from ginn_jax.architecture import Network
from ginn_jax.commandline import require, start
from ginn_jax.dataset import ShadedPoints
from ginn_jax.lane_encoding import encodes_in_lanes
from ginn_jax.limits import Limits
from ginn_jax.mesh import find_meshes
from ginn_jax.presets import DEFAULT, PAPER
from ginn_jax.run_record import RECORD

EXACT_RAYS = 1024


@dataclass(frozen=True)
class Options:
    """Train networks that lack a departure and compare their errors and times."""

    out: Path = Path("runs/departures")
    """Folder for clouds, runs, metrics.json and report.md."""
    steps: int = 800
    """Steps of training of each."""
    shapes: int = 200
    """Procedural shapes to train on."""
    test_shapes: int = 12
    """Unseen shapes to evaluate on."""
    test_meshes: Path | None = None
    """A mesh file or a folder of meshes to evaluate on as well."""
    points: int = 32_000
    """Samples per object."""
    rays: int = 64
    """Rays per training point."""
    resolution: int = 512
    """Side of the image that is timed, in pixels."""
    seed: int = 0
    """Seed of everything."""
    resume: bool = False
    """Go on where a killed run with the same options was."""
    quick: bool = False
    """One step on little data: to try things, not for numbers."""


QUICK = {"steps": 1, "shapes": 2, "test_shapes": 1, "points": 2000, "rays": 2}
QUICK |= {"resolution": 48}

# What the paper has in the place of each departure.
WITHOUT: dict[str, dict[str, Any]] = {
    "normals in kernels": {"oriented": False},
    "sides": {"sided": False},
    "fading borders": {"taper": 0.0},
    "layer norms": {"norm": "batch"},
    # By far the slowest, for it alone makes a density for each of many pairs.
    "weights by area": {"density": "kde"},
}
PAPER_TRAINING = {"schedule": "paper", "learning_rate": 0.005}


class Unseen(NamedTuple):
    """Objects of one kind that no network trained on, and their clouds."""

    sources: Sequence[objects.Source]
    clouds: Sequence[ShadedPoints]


class Data(NamedTuple):
    """What all learn from, as runs record it, its clouds, and unseen objects."""

    learned: dict[str, Any]
    clouds: Sequence[ShadedPoints]
    tests: dict[str, Unseen]


class Variant(NamedTuple):
    """A network, and how it is trained unlike the others."""

    network: Network
    training: dict[str, Any]


def variants(network: Network, seed: int) -> dict[str, Variant]:
    """Ours, the same for other weights, the paper's, and ours without one departure or
    all."""
    convolution = {
        key: value for changes in WITHOUT.values() for key, value in changes.items()
    }
    return {
        "ours": Variant(network, {}),
        "ours, other weights": Variant(network, {"seed": seed + 1}),
        "the paper's table": Variant(PAPER, {}),
        "the paper's table and optimiser": Variant(PAPER, PAPER_TRAINING),
        "without any": Variant(replace(network, **convolution), {}),
        **{
            f"without {n}": Variant(replace(network, **c), {})
            for n, c in WITHOUT.items()
        },
    }


def run_of(
    options: Options, name: str, changes: dict[str, Any]
) -> experiment.RunOptions:
    """What trains one variant, in a folder of its own."""
    folder = options.out / name.replace(" ", "_").replace(",", "").replace("'", "")
    begun = options.resume and (folder / RECORD).exists()
    run = experiment.RunOptions(
        folder, steps=options.steps, seed=options.seed, resume=begun
    )
    return replace(run, **changes)


def compare(
    console: Console,
    options: Options,
    run: experiment.RunOptions,
    network: Network,
    data: Data,
) -> dict[str, Any]:
    """Errors and times of one network after its training."""
    _, clouds, tests = data
    config = experiment.training(run, network, options.points, len(clouds))
    given = config, clouds, run, data.learned, experiment.Clock()
    done = experiment.train(console, *given)
    variables = jax.device_put(done.state.variables, jax.devices()[0])
    model = evaluate.Model(variables, jax.random.key(options.seed))
    row: dict[str, Any] = {"skipped": int(done.state.skipped)}
    limits = done.limits
    for name, unseen in tests.items():
        called = [source.name for source in unseen.sources]
        given = network, limits, model, unseen.clouds, called, EXACT_RAYS
        rows, limits = evaluate.evaluate_clouds(*given)
        row[f"relative, {name}"] = evaluate.pool_rows(rows)["relative_mse_3d"]
    return row | image_times(options, network, limits, model, tests["shapes"])


def image_times(
    options: Options,
    network: Network,
    limits: Limits,
    model: evaluate.Model,
    unseen: Unseen,
) -> dict[str, Any]:
    """Milliseconds of an image of the first unseen object, and what they are of."""
    mesh = objects.load_object(unseen.sources[0])
    view = evaluate.reference_view(mesh, 0.1, 4, options.seed, options.resolution)
    cloud = evaluate.split_cloud(unseen.clouds[0])[0]
    found = evaluate.network_row(network, limits, model, cloud, view)[0]
    times = {f"{part}_ms": 1e3 * found[f"seconds_{part}"] for part in ("3d", "2d")}
    return times | {"by": "lanes" if encodes_in_lanes(network) else "JAX"}


def make_clouds(console: Console, options: Options) -> Data:
    """Clouds to train on and unseen ones."""
    settings = scenes.Occlusion(options.points, options.rays)
    exact = scenes.Occlusion(options.points, EXACT_RAYS)
    seen = objects.procedural_sources(options.shapes, options.seed)
    kinds = {
        "shapes": objects.procedural_sources(options.test_shapes, objects.UNSEEN_SEED)
    }
    if options.test_meshes is not None:
        kinds["meshes"] = objects.file_sources(find_meshes(options.test_meshes))
    folder = options.out / "data"
    clouds = experiment.make(console, "training", seen, settings, folder / "training")
    tests = {
        name: Unseen(some, experiment.make(console, name, some, exact, folder / name))
        for name, some in kinds.items()
    }
    return Data(experiment.learned(settings, seen), clouds, tests)


def main(options: Options) -> dict[str, Any]:
    """Train and evaluate every variant; returns what metrics.json holds."""
    least = {"steps": 1, "shapes": 1, "test_shapes": 1, "points": 1000, "rays": 2}
    require(options, least | {"resolution": 32, "seed": 0})
    console, begin = Console(), time.perf_counter()
    data = make_clouds(console, options)
    rows, metrics = list[dict[str, Any]](), dict[str, Any]()
    for name, (network, changes) in variants(DEFAULT, options.seed).items():
        console.print(name)
        run = run_of(options, name, changes)
        found = compare(console, options, run, network, data)
        rows.append({"network": name} | found)
        # After each, so that what was measured is not lost with what was not.
        metrics = {"rows": rows} | circumstances(options, begin)
        report.write_results(options.out, metrics, write_report(options, rows))
    print(write_report(options, rows))
    return metrics


def write_report(options: Options, rows: list[dict[str, Any]]) -> str:
    """report.md: a row for each network."""
    errors = [name for name in rows[0] if name.startswith("relative, ")]
    heads = {"network": "network"}
    heads |= {name: f"relative 3D MSE, {name[10:]}" for name in errors}
    heads |= {"3d_ms": "f_3D, ms", "2d_ms": "f_2D, ms", "by": "by"}
    changes = "; ".join(
        f"{name}: {', '.join(f'{k} = {v}' for k, v in change.items())}"
        for name, change in WITHOUT.items()
    )
    return f"""# Departures from the paper, ambient occlusion

{options.steps} steps each on {options.shapes} shapes of {options.points} points at
{options.rays} rays, batches of two; one run each, so that differences as small as that
between the two rows of ours may be chance. Errors are those of unseen objects, noise
subtracted; times those of an image of {options.resolution} x {options.resolution}, in
lanes where a network runs there, or by JAX, which takes longer. The paper's optimiser
is Adam at .005, times .7 every 10 epochs; the others have Muon and Adam at .01,
decaying to zero. Without what: {changes}.

{describe()}

{report.table_of(rows, heads)}"""


if __name__ == "__main__":
    start(Options, main, QUICK)

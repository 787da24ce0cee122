"""Networks trained for equal time on the same scenes: of three widths, or linear.

    python -m benchmarks.networks --effect gi

Of every preset a few steps are timed, then it trains anew with as many as fit the time,
under its own schedule; capacities and compilation apart. Errors are of unseen shapes
under unseen skies and of unseen shapes under point lights.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from rich.console import Console

from benchmarks.timing import circumstances, describe
from ginn_jax import evaluate_light, experiment, fit, lit_views, report
from ginn_jax.architecture import Network
from ginn_jax.commandline import require_positive, require_some, start
from ginn_jax.dataset import count_given
from ginn_jax.evaluate import Model, pool_rows
from ginn_jax.limits import Limits
from ginn_jax.lit_clouds import LitCloud, split_points
from ginn_jax.lit_experiment import LitSettings, with_exact_targets
from ginn_jax.lit_options import LitOptions, Preset, choose_sources
from ginn_jax.lit_scenes import Illumination, Scattering
from ginn_jax.objects import Source
from ginn_jax.presets import ILLUMINATION, SCATTERING
from ginn_jax.process import forget_programs
from ginn_jax.recipe import Training
from ginn_jax.room import training_room
from ginn_jax.train import init_state

# Steps from which the time of one is taken.
PROBE = 30


@dataclass(frozen=True)
class Options:
    """Train networks for equal time and compare their errors and times."""

    out: Path = Path("runs/networks")
    """Folder for clouds, runs, metrics.json and report.md."""
    effect: Literal["gi", "sss"] = "gi"
    """Global illumination or subsurface scattering."""
    presets: tuple[Preset, ...] = ("homogeneous", "linear", "narrow", "wide")
    """The networks."""
    seconds: float = 240.0
    """Seconds of training for each."""
    shapes: int = 200
    """Scenes to train on."""
    test_shapes: int = 12
    """Unseen shapes; four of them again under point lights."""
    points: int = 20_000
    """Samples per scene."""
    paths: int = 16
    """Paths per training point."""
    resolution: int = 256
    """Side of the image that is timed, in pixels."""
    seed: int = 0
    """Seed of everything."""
    quick: bool = False
    """One step on little data: to try things, not for numbers."""


QUICK = {"seconds": 1e-3, "shapes": 2, "test_shapes": 1, "points": 2000, "paths": 2}
QUICK |= {"resolution": 48}

Scenes = dict[str, tuple[Sequence[Source], Sequence[LitCloud]]]


class Data(NamedTuple):
    """What all learn from, as runs record it, its clouds, and unseen scenes."""

    learned: dict[str, Any]
    clouds: Sequence[LitCloud]
    tests: Scenes


def main(options: Options) -> dict[str, Any]:
    """Train and evaluate every preset; returns what metrics.json holds."""
    require_positive(options, "seconds")
    require_some(options, "presets")
    console, begin = Console(), time.perf_counter()
    names = "out", "shapes", "test_shapes", "points", "paths", "resolution", "seed"
    run = LitOptions(**{name: getattr(options, name) for name in names})
    experiment.check_run(run, {"paths": 2})
    lit = Illumination if options.effect == "gi" else Scattering
    settings = lit(points=options.points, paths=options.paths)
    exact = with_exact_targets(settings, options.quick)
    seen, unseen = choose_sources(run)
    folder = options.out / "data"
    clouds = experiment.make(console, "training", seen, settings, folder / "training")
    tests: Scenes = {
        name: (some, experiment.make(console, name, some, exact, folder / name))
        for name, some in unseen.items()
    }
    table = ILLUMINATION if options.effect == "gi" else SCATTERING
    data, rows = Data(experiment.learned(settings, seen), clouds, tests), []
    for preset in options.presets:
        console.print(preset)
        own = replace(run, out=options.out / preset)
        found = compare(console, options, own, table[preset], data, exact)
        rows.append({"preset": preset} | found)
    metrics = {"rows": rows} | circumstances(options, begin)
    text = write_report(options, rows)
    report.write_results(options.out, metrics, text)
    print(text)
    return metrics


def compare(
    console: Console,
    options: Options,
    run: LitOptions,
    network: Network,
    data: Data,
    settings: LitSettings,
) -> dict[str, Any]:
    """Steps, errors and times of one network after its time of training."""
    _, clouds, tests = data
    config = experiment.training(run, network, run.points, len(clouds))
    steps = max(round(options.seconds / step_seconds(config, clouds)), 1)
    forget_programs()
    config, run = replace(config, steps=steps), replace(run, steps=steps)
    ends = config, clouds, run, data.learned, experiment.Clock()
    done = experiment.train(console, *ends)
    variables = jax.device_put(done.state.variables, jax.devices()[0])
    model = Model(variables, jax.random.key(run.seed))
    made = {"steps": steps, "seconds": done.seconds["train"]}
    given = network, done.limits, model, tests, settings
    return made | errors_and_times(*given, run.resolution)


def errors_and_times(
    network: Network,
    limits: Limits,
    model: Model,
    tests: Scenes,
    settings: LitSettings,
    size: int,
) -> dict[str, Any]:
    """Errors of every set of unseen scenes; times of an image of the first."""
    found: dict[str, Any] = {}
    for name, (sources, some) in tests.items():
        called = [source.name for source in sources]
        given = network, limits, model, some, called, settings
        rows, limits = evaluate_light.evaluate_lit_clouds(*given)
        found[f"relative, {name}"] = pool_rows(rows)["relative_mse_3d"]
    sources, some = next(iter(tests.values()))
    view = lit_views.lit_view(sources[0], settings, 2, size)
    cloud = split_points(some[0], count_given(len(some[0].position)))[0]
    row = evaluate_light.lit_network_row(network, limits, model, cloud, view)[0]
    parts = "seconds_3d", "seconds_2d"
    return found | {f"image {part}": row[part] for part in parts}


def step_seconds(config: Training, clouds: Sequence[LitCloud]) -> float:
    """Seconds of a step, of compiled ones that needed no more room."""
    room, state = training_room(config, clouds), init_state(config)
    compiled, seconds = set[Limits](), list[float]()
    while len(seconds) < PROBE:
        begin = time.perf_counter()
        state, _, used, room = fit.step_with_room(config, room, clouds, state)
        if used in compiled:
            seconds.append(time.perf_counter() - begin)
        elif used is not None:
            compiled.add(used)
    return float(np.mean(seconds))


def write_report(options: Options, rows: list[dict[str, Any]]) -> str:
    """report.md: a row for each network."""
    heads = {"preset": "network", "steps": "steps", "seconds": "training s"}
    errors = [name for name in rows[0] if name.startswith("relative, ")]
    heads |= {name: f"relative 3D MSE, {name[10:]}" for name in errors}
    heads |= {"image seconds_3d": "f_3D s", "image seconds_2d": "f_2D s"}
    effect = {"gi": "global illumination", "sss": "subsurface scattering"}
    return f"""# Networks at equal time of training, {effect[options.effect]}

{options.shapes} scenes of {options.points} points at {options.paths} paths, batches of
two, each network's own cosine schedule; capacities and compilation apart. Errors are
those of {options.test_shapes} unseen shapes under unseen skies and of up to four under
point lights, noise subtracted. f_3D and f_2D are timed on one of them, at
{options.resolution} x {options.resolution} in RGB.

{describe()}

{report.table_of(rows, heads)}"""


if __name__ == "__main__":
    start(Options, main, QUICK)

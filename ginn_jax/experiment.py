"""What every experiment does around its effect: data, training, records."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from ginn_jax import fit, report, scenes
from ginn_jax.architecture import Network
from ginn_jax.checks import positive
from ginn_jax.commandline import require, require_positive
from ginn_jax.dataset import count_asked, count_given
from ginn_jax.disk_radius import with_disk_radius
from ginn_jax.errors import InputError
from ginn_jax.evaluate import Row, pool_rows
from ginn_jax.lit_clouds import Cloud
from ginn_jax.objects import SEEDS_APART, UNSEEN_SEED, Source
from ginn_jax.pretrained import load_any, run_folder, starting_weights
from ginn_jax.process import available_cores, forget_programs
from ginn_jax.recipe import Training
from ginn_jax.upsample import shading_step


@dataclass(frozen=True)
class RunOptions:
    """What every training experiment can be told, whatever its effect."""

    out: Path = Path("runs/train")
    """Folder for data, checkpoints, metrics.json, report.md and figures."""
    shapes: int = 300
    """Procedural shapes to train on."""
    meshes: Path | None = None
    """A mesh file or a folder of meshes to train on as well."""
    test_shapes: int = 12
    """Procedural shapes to evaluate on; training never sees them."""
    test_meshes: Path | None = None
    """A mesh file or a folder of unseen meshes to evaluate on as well."""
    points: int = 20_000
    """Samples per object."""
    sparsest: float = 1.0
    """Each step gives the network a share of its samples between this and all."""
    disk: float = 1.0
    """Poisson disk radius of the finest level, as times the preset's."""
    schedule: Literal["cosine", "paper"] = "cosine"
    """Muon with warm-up and cosine decay, or the paper's Adam, x0.7 every 10 epochs."""
    steps: int = 3000
    """Training steps."""
    batch: int = 2
    """Clouds per step (the paper: 8)."""
    learning_rate: float = 0.01
    """The learning rate at its highest (the paper: .005)."""
    resolution: int = 256
    """Side of the evaluation images in pixels."""
    resolution_scale: float = 0.5
    """Shade the evaluation images at 1/2, 1/3... of their resolution too; 1: do not."""
    seed: int = 0
    """Seed of everything."""
    start: str | None = None
    """Weights to train on: the folder of a run, or a name as "ao" or "gi_only_2d"."""
    resume: bool = False
    """Go on where a killed run with the same options was."""
    quick: bool = False
    """A run of about a minute on little data: to try things, not for numbers."""


def check_run(options: RunOptions, least: dict[str, int]) -> None:
    """Raise `InputError` for options that cannot be meant; `least` has more bounds."""
    bounds = {"shapes": 0, "test_shapes": 1, "points": 1000, "steps": 1, "batch": 1}
    require(options, bounds | {"resolution": 32, "seed": 0} | least)
    shading_step(options.resolution_scale)
    require_positive(options, "learning_rate", "disk")
    positive("--sparsest", options.sparsest, 1.0)
    if options.start is not None:
        run = run_folder(options.start)
        if run is not None and run.resolve() == options.out.resolve():
            raise InputError(
                f"--start {run} is the --out, where a new run removes what it finds: "
                "give another --out"
            )
        load_any(options.start)  # a name that is wrong is said before data are made
    if max(options.shapes, 30) + options.seed * SEEDS_APART > UNSEEN_SEED:
        raise InputError(
            f"--seed {options.seed} with {options.shapes} shapes would train on those "
            f"held back: give a seed below {UNSEEN_SEED // SEEDS_APART}"
        )


def on_disk(options: RunOptions, network: Network) -> Network:
    """The network on the finest Poisson disk that the options ask for.

    Raises `InputError` for one that the network cannot do with.
    """
    return with_disk_radius(network, options.disk * network.levels[0])


@dataclass
class Clock:
    """Wall seconds of the parts of a run, with those before it was resumed."""

    parts: dict[str, float] = field(default_factory=dict)

    def lap(self, name: str, since: float) -> None:
        """Add the time since `since` to a part."""
        self.parts[name] = self.parts.get(name, 0.0) + time.perf_counter() - since


def make(
    console: Console,
    what: str,
    sources: Sequence[Source],
    settings: scenes.Settings,
    folder: Path,
) -> Sequence[Any]:
    """Make, or find, the clouds of all sources.

    Raises:
        InputError: no sources.
    """
    if not sources:
        raise InputError(f"no {what}: ask for at least one shape")
    workers = min(available_cores(), 8)
    with bar(console) as progress:
        task = progress.add_task(what, total=len(sources), note="")
        for _ in scenes.make_clouds(sources, settings, folder, workers):
            progress.advance(task)
    return scenes.read_clouds(sources, settings, folder)


def bar(console: Console) -> Progress:
    """A progress bar with time left."""
    columns = (MofNCompleteColumn(), TimeRemainingColumn())
    text = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[note]}"),
    )
    return Progress(*text, *columns, console=console, disable=not console.is_terminal)


def learned(settings: Any, sources: Sequence[Source]) -> dict[str, Any]:
    """What a run records of what it learns from: how its clouds are made, of what."""
    return {"data": asdict(settings), "objects": [source.name for source in sources]}


def train(
    console: Console,
    config: Training,
    clouds: Sequence[Cloud],
    options: RunOptions,
    extra: dict[str, Any],
    clock: Clock,
) -> fit.Fit:
    """`fit.fit` with a progress bar, or a line every 100 steps where none can be.

    Raises:
        InputError: as `fit.fit`; weights to start from that are of another network.
    """
    weights, told = None, list[tuple[int, float]]()
    if options.start is not None:
        weights = starting_weights(options.start, config)
    extra = extra | {"start": options.start}
    with bar(console) as progress:
        task = progress.add_task("training", total=config.steps, note="compiling")

        def tell(step: int, loss: float, note: str) -> None:
            told.append((step, time.perf_counter()))
            text = note or f"loss {loss:.5f}{pace(told)}"
            progress.update(task, completed=step, note=text)
            if not console.is_terminal and (note or step % 100 == 0):
                console.print(f"step {step} of {config.steps}: {text}")

        given = config, clouds, options.out, fit.Intervals(), tell, options.resume
        run = fit.fit(*given, extra, weights, clock.parts)
    clock.parts = run.seconds
    forget_programs()
    return run


def pace(told: Sequence[tuple[int, float]]) -> str:
    """Steps a second since the first of these (step, second) was told: without what was
    compiled before, or trained before a run was resumed."""
    (first, begin), (last, end) = told[0], told[-1]
    return f", {(last - first) / (end - begin):.1f} steps/s" if last > first else ""


def training(
    options: RunOptions, network: Network, points: int, clouds: int
) -> Training:
    """The training configuration that the options ask for."""
    return Training(
        network,
        steps=options.steps,
        batch_size=options.batch,
        points=count_given(points),
        queries=count_asked(points),
        sparsest=options.sparsest,
        learning_rate=options.learning_rate,
        schedule=options.schedule,
        epoch_steps=max(clouds // options.batch, 1),
        seed=options.seed,
    )


def errors_by_set(sets: dict[str, list[Row]]) -> dict[str, Any]:
    """What metrics.json says of the errors at the points of unseen clouds.

    Pooled and of each, by the name of the set; those of the first set are the run's.
    """
    pooled = {f"unseen {name}": pool_rows(rows) for name, rows in sets.items()}
    each = {f"unseen {name}, each": rows for name, rows in sets.items()}
    return next(iter(pooled.values())) | pooled | each


def closing(
    options: RunOptions, run: fit.Fit, config: Training, clock: Clock
) -> dict[str, Any]:
    """What metrics.json says of every run, whatever its effect."""
    seconds = {f"seconds_{name}": spent for name, spent in clock.parts.items()}
    return seconds | {
        "seconds_total": sum(clock.parts.values()),
        "peak_memory_gib": report.peak_memory_gib(),
        "steps": int(run.state.step),
        "skipped_steps": int(run.state.skipped),
        "limits": dict(run.limits.sizes),
        "limits_raised": run.raised,
        "options": asdict(options),
        "training": asdict(config),
        "environment": report.environment(),
    }

"""Where the train step's time goes, from the Poisson disk to the update.

    python -m benchmarks.train_step

The step's own code is compiled up to each stage, asked only for that stage's results,
so that XLA drops what comes later; a share is the difference between two stages.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec
from jaxtyping import Array, Key
from matplotlib.figure import Figure

from benchmarks.timing import Timing, circumstances, measure
from ginn_jax import fit, objects, presets, report, scenes
from ginn_jax.commandline import require, start
from ginn_jax.dataset import ShadedPoints
from ginn_jax.errors import InputError
from ginn_jax.limits import Limits
from ginn_jax.network import Variables
from ginn_jax.objective import batch_loss, split_variables
from ginn_jax.process import ALONE, available_cores
from ginn_jax.recipe import Training
from ginn_jax.room import training_room
from ginn_jax.train import (
    TrainState,
    batch_mesh,
    init_state,
    make_example,
    place,
    train_step,
)

# Each stage and what it adds to the one before.
STAGES = {
    "levels": "Poisson disk (and augmentation)",
    "edges": "voxels and search",
    "geometry": "densities, kernel inputs",
    "forward": "forward",
    "gradient": "gradient",
    "step": "update",
}


@dataclass(frozen=True)
class Options:
    """Print the shares of the train step."""

    out: Path = Path("runs/train_step")
    """Folder for clouds, metrics.json, report.md and the figure."""
    preset: Literal["default", "paper", "released"] = "default"
    """Layer table: ours, the paper's, or the authors' release."""
    shapes: int = 4
    """Procedural shapes to train on."""
    batch: int = Training.batch_size
    """Clouds per step."""
    points: int = Training.points
    """Points of a cloud that a step takes."""
    queries: int = Training.queries
    """Points of a cloud that carry the loss."""
    repeats: int = 15
    """Timed calls of each stage."""
    quick: bool = False
    """One share of small clouds, few repeats: to try things, not for numbers."""


QUICK = {"shapes": 2, "points": 2000, "queries": 256, "repeats": 3}


def stage_results(
    config: Training,
    limits: Limits,
    stage: str,
    variables: Variables,
    key: Key[Array, ""],
    batch: ShadedPoints,
) -> Any:
    """What the step has up to a stage, for one device's share of the batch."""
    key = jax.random.fold_in(key, jax.lax.axis_index("batch"))
    example, demands = make_example(config, limits, batch, key=key)
    if stage == "levels":
        return example.geometry.levels, example.geometry.finest
    if stage == "edges":
        fields = [*example.geometry.fields.values(), example.field]
        return [(field.sender, field.receiver) for field in fields]
    example = jax.lax.optimization_barrier(example)
    if stage == "geometry":
        return example, demands
    loss = batch_loss
    if stage == "gradient":
        loss = jax.value_and_grad(batch_loss, has_aux=True)
    return loss(*split_variables(variables), config.network, example), demands


def stage_call(
    config: Training,
    limits: Limits,
    stage: str,
    fresh: TrainState,
    batch: ShadedPoints,
) -> Callable[[], Any]:
    """A compiled stage, or the whole step, on the devices that share the batch."""
    if stage == "step":
        # A copy, for the step takes it over, placed as the step returns it.
        state = [place(config, jax.tree.map(jnp.copy, fresh))]

        def advance() -> Any:
            after, told = train_step(config, limits, state.pop(), batch)
            state.append(after)
            return after, told

        return advance
    everywhere, shared = PartitionSpec(), PartitionSpec("batch")

    def share(*arrays: Any) -> Any:
        results = stage_results(config, limits, stage, *arrays)
        return jax.tree.map(lambda a: a[None], results)

    split = jax.shard_map(
        share,
        mesh=batch_mesh(config.batch_size),
        in_specs=(everywhere, everywhere, shared),
        out_specs=shared,
        check_vma=False,
    )
    key = jax.random.key(config.seed)
    call = jax.jit(split, compiler_options=ALONE)
    return partial(call, fresh.variables, key, batch)


def differences(timings: Iterable[Timing]) -> list[float]:
    """Median seconds that each stage adds to the one before."""
    return np.diff([0.0, *(t.median for t in timings)]).tolist()


def profile(
    config: Training, limits: Limits, batch: ShadedPoints, repeats: int
) -> dict[str, Any]:
    """Seconds that each stage adds, and the share of geometry in the whole step."""
    fresh = init_state(config)
    calls = {s: stage_call(config, limits, s, fresh, batch) for s in STAGES}
    timings = measure(calls, repeats)
    if not bool(calls["step"]()[1].fits):
        raise InputError("a limit was too small: measure them on more --shapes")
    return {
        "devices": batch_mesh(config.batch_size).size,
        "batch": config.batch_size,
        "seconds": timings["step"].median,
        "added": dict(zip(STAGES, differences(timings.values()), strict=True)),
        "geometry_share": timings["geometry"].median / timings["step"].median,
        "timings": {stage: t.record() for stage, t in timings.items()},
    }


def make_batch(options: Options, config: Training) -> tuple[ShadedPoints, Limits]:
    """Procedural clouds, as training has them, and the limits most steps would take."""
    settings = scenes.Occlusion(points=options.points * 5 // 4, rays=16)
    sources = objects.procedural_sources(options.shapes, 0)
    folder, workers = options.out / "data", min(available_cores(), options.shapes)
    list(scenes.make_clouds(sources, settings, folder, workers))
    clouds = scenes.read_clouds(sources, settings, folder)
    return fit.step_batch(config, clouds, 0), training_room(config, clouds).usual


def main(options: Options) -> dict[str, Any]:
    """Profile one cloud and the whole step; returns what metrics.json holds."""
    require(options, {"shapes": 1, "batch": 1, "points": 500, "queries": 1})
    require(options, {"repeats": 1})
    begin = time.perf_counter()
    sizes = options.batch, options.points, options.queries
    config = Training(presets.PRESETS[options.preset], 1000, *sizes)
    batch, limits = make_batch(options, config)
    small = jax.tree.map(lambda a: a[:1], batch)
    single = replace(config, batch_size=1)
    columns = {"one cloud": profile(single, limits, small, options.repeats)}
    if config.batch_size > 1 and not options.quick:
        columns["whole step"] = profile(config, limits, batch, options.repeats)
    metrics = {
        "columns": columns,
        "geometry_share": max(c["geometry_share"] for c in columns.values()),
        "limits": dict(limits.sizes),
        "training": asdict(config),
    } | circumstances(options, begin)
    text = write_report(metrics)
    report.write_results(options.out, metrics, text)
    draw(options.out / "train_step.png", columns)
    print(text)
    return metrics


def write_report(metrics: dict[str, Any]) -> str:
    """report.md: the shares, and whether geometry keeps to its third."""
    columns, options = metrics["columns"], metrics["options"]
    rows = [
        [STAGES[stage], *(_cell(c["added"][stage], c) for c in columns.values())]
        for stage in STAGES
    ]
    geometry = [_cell(c["geometry_share"] * c["seconds"], c) for c in columns.values()]
    rows.insert(3, ["**geometry in all**", *geometry])
    rows.append(["**step**", *(_cell(c["seconds"], c) for c in columns.values())])
    heads = [f"{n} ({c['batch']} on {c['devices']})" for n, c in columns.items()]
    verdict = "at most" if metrics["geometry_share"] <= 1 / 3 else "MORE THAN"
    return f"""# Shares of the train step

Preset {options["preset"]}, {options["points"]} points and {options["queries"]} queries
of each cloud; median of {options["repeats"]} calls; in brackets clouds on devices.

{metrics["machine"]}

{report.markdown_table(["stage", *heads], rows)}
Poisson disk, search, densities and kernel inputs together take {verdict} a third of
the step: {metrics["geometry_share"]:.0%}.

![shares](train_step.png)
"""


def _cell(seconds: float, column: dict[str, Any]) -> str:
    return f"{1e3 * seconds:.1f} ms, {seconds / column['seconds']:.0%}"


def draw(path: Path, columns: dict[str, Any]) -> None:
    """Stacked bars of what each stage adds."""
    figure = Figure(figsize=(8, 1.5 + len(columns)), layout="constrained")
    axes = figure.add_subplot()
    left = np.zeros(len(columns))
    for stage, title in STAGES.items():
        wide = np.array([1e3 * c["added"][stage] for c in columns.values()])
        axes.barh(list(columns), wide, left=left, label=title)
        left += wide
    axes.set(xlabel="ms")
    axes.legend(fontsize=8, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1))
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    start(Options, main, QUICK)

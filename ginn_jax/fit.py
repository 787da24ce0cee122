"""The training loop of a run: clouds in, weights out, resumable at any step."""

import io
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import orbax.checkpoint as ocp

from ginn_jax.checkpoint import (
    UNSPENT,
    finish,
    load_run,
    open_manager,
    restore_state,
    save_run,
    save_state,
)
from ginn_jax.dataset import ShadedPoints, batch_order, stack_clouds
from ginn_jax.errors import InputError
from ginn_jax.files import writing
from ginn_jax.limits import SLACK, Limits, exceeded, measure_limits, widened
from ginn_jax.lit_clouds import Cloud, channel_of
from ginn_jax.network import Variables
from ginn_jax.process import forget_programs
from ginn_jax.searches import uniform_limits
from ginn_jax.train import (
    Training,
    TrainState,
    batch_mesh,
    init_state,
    probe_step,
    share_key,
    train_step,
)

PROBES = 300


@dataclass(frozen=True)
class Schedule:
    """How often a run reports and saves, in steps."""

    report: int = 10
    save: int = 250


class Fit(NamedTuple):
    """A finished run: state, capacities, loss of every step, seconds by purpose.

    Losses and seconds are of the whole run, however often it was resumed.
    """

    state: TrainState
    limits: Limits
    losses: np.ndarray
    seconds: dict[str, float]
    raised: dict[str, int]


Progress = Callable[[int, float, str], None]


def fit(
    config: Training,
    clouds: Sequence[Cloud],
    folder: Path,
    schedule: Schedule,
    progress: Progress,
    resume: bool = False,
    extra: dict[str, Any] | None = None,
    weights: Variables | None = None,
) -> Fit:
    """Train to `config.steps` from `weights` or random ones, saving under `folder`.

    Where a batch needs more than a limit the limit is raised and the step repeated, on
    the state it started from. `progress(step, loss, note)` hears of every report.

    Raises:
        InputError: too few points per cloud, or nothing to resume.
    """
    _check(config, clouds)
    folder.mkdir(parents=True, exist_ok=True)
    begin, extra = time.perf_counter(), extra or {}
    if resume:
        limits, seconds = load_run(folder, config, extra)
    else:
        limits, seconds = training_limits(config, clouds), dict(UNSPENT)
        save_run(folder, config, limits, extra, seconds)
    manager = open_manager(folder, fresh=not resume)
    state, history = latest(manager, folder, init_state(config, weights), resume)
    seconds["compile"] += time.perf_counter() - begin
    compiled_for, raised = None, dict[str, int]()
    while (step := int(state.step)) < config.steps:
        begin = time.perf_counter()
        state, loss, wider = step_with_room(config, limits, clouds, state)
        purpose = "train" if compiled_for == wider else "compile"
        seconds[purpose] += time.perf_counter() - begin
        if wider != limits:
            more = {n: size for n, size in wider.sizes if size > limits.of(n)}
            progress(step, loss, f"raised {', '.join(more)}")
            limits, raised = wider, raised | more
            forget_programs()
            continue
        compiled_for = limits
        history.append(loss)
        if (step + 1) % schedule.report == 0:
            progress(step + 1, recent_loss(history, schedule.report), "")
        if (step + 1) % schedule.save == 0 or step + 1 == config.steps:
            save_losses(folder, history)
            save_run(folder, config, limits, extra, seconds)
            save_state(manager, state)
    finish(manager)
    return Fit(state, limits, np.array(history, np.float32), seconds, raised)


def latest(
    manager: ocp.CheckpointManager, folder: Path, state: TrainState, resume: bool
) -> tuple[TrainState, list[float]]:
    """The newest state of a run that goes on, else `state`; the losses up to there."""
    if resume and (found := restore_state(manager, state)) is not None:
        return found, load_losses(folder, int(found.step)).tolist()
    return state, []


def step_with_room(
    config: Training, limits: Limits, clouds: Sequence[Cloud], state: TrainState
) -> tuple[TrainState, float, Limits]:
    """A step, its loss and the same limits; or the same state and limits to repeat it.

    The state given is used up either way.
    """
    step = int(state.step)
    batch = step_batch(config, clouds, step)
    state, report = train_step(config, limits, state, batch)
    if short := exceeded(limits, jax.device_get(report.demands)):
        limits = widened(limits, batch_limits(config, batch, step), short)
    return state, float(report.loss), limits


def recent_loss(history: Sequence[float], steps: int) -> float:
    """Mean loss of the last steps, without those that were skipped; NaN if all were."""
    recent = np.asarray(history[-steps:])
    kept = recent[np.isfinite(recent)]
    return float(kept.mean()) if len(kept) else float("nan")


def training_limits(config: Training, clouds: Sequence[Cloud]) -> Limits:
    """Capacities that hold random shares of a batch, with slack."""
    share = config.batch_size // batch_mesh(config.batch_size).size
    rng = np.random.default_rng(config.seed)
    probes = min(len(clouds), PROBES)
    rows = rng.integers(0, len(clouds), (probes, share))
    rows[:, 0] = rng.permutation(len(clouds))[:probes]

    def probe(limits: Limits, i: int) -> dict[str, Any]:
        batch = stack_clouds([channel_of(clouds[int(j)], 0) for j in rows[i]])
        return jax.device_get(probe_step(config, limits, batch, key=jax.random.key(i)))

    generous = uniform_limits(config.network, 16 * share * config.points)
    return measure_limits(generous, probe, probes, SLACK)


def batch_limits(config: Training, batch: ShadedPoints, step: int) -> Limits:
    """Capacities that hold the batch of a step, with slack."""
    devices = batch_mesh(config.batch_size).size
    size = config.batch_size // devices

    def probe(limits: Limits, i: int) -> dict[str, Any]:
        share = jax.tree.map(lambda a: a[i * size : (i + 1) * size], batch)
        key = share_key(config, step, i)
        return jax.device_get(probe_step(config, limits, share, key=key))

    ample = uniform_limits(config.network, 16 * size * config.points)
    return measure_limits(ample, probe, devices, SLACK)


def save_losses(folder: Path, history: Sequence[float]) -> None:
    """Keep the loss of every step beside the checkpoints."""
    # In memory first: NumPy does not hear of a disk that is full.
    np.save(whole := io.BytesIO(), np.asarray(history, np.float32))
    with writing(folder / "losses.npy") as partial:
        partial.write_bytes(whole.getvalue())


def load_losses(folder: Path, steps: int) -> np.ndarray:
    """The losses of the first `steps` steps; NaN where the file lacks them."""
    try:
        found = np.load(folder / "losses.npy", allow_pickle=False)[:steps]
        found = found.astype(np.float32).reshape(-1)
    except Exception:  # NumPy raises what it likes
        found = np.zeros(0, np.float32)
    missing = np.full(steps - len(found), np.nan, np.float32)
    return np.concatenate([found, missing])


def step_batch(config: Training, clouds: Sequence[Cloud], step: int) -> ShadedPoints:
    """The clouds of a step, each in a random one of its colours."""
    order = batch_order(len(clouds), config.batch_size, step, seed=config.seed)
    rng = np.random.default_rng((config.seed, step))
    channels = rng.integers(0, 3, len(order)).tolist()
    return stack_clouds(
        [channel_of(clouds[i], c) for i, c in zip(order, channels, strict=True)]
    )


def _check(config: Training, clouds: Sequence[Cloud]) -> None:
    if not clouds:
        raise InputError("no training clouds: ask for at least one shape")
    fewest = min(len(c.position) for c in clouds)
    if fewest < config.points:
        raise InputError(
            f"a training cloud has {fewest} points, a step takes {config.points}: "
            "sample more, or train on fewer"
        )

"""The training loop of a run: clouds in, weights out, resumable at any step."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import orbax.checkpoint as ocp

from ginn_jax.checkpoint import (
    finishing,
    open_manager,
    restore_state,
    save_state,
)
from ginn_jax.dataset import ShadedPoints, batch_order, stack_clouds
from ginn_jax.errors import InputError
from ginn_jax.files import write_whole
from ginn_jax.limits import Limits, exceeded
from ginn_jax.lit_clouds import Cloud, channel_of
from ginn_jax.network import Variables
from ginn_jax.process import forget_programs
from ginn_jax.recipe import Training
from ginn_jax.room import Room, training_room, with_more
from ginn_jax.run_record import UNSPENT, load_run, save_run
from ginn_jax.train import (
    StepReport,
    TrainState,
    init_state,
    on_devices,
    state_shapes,
    train_step,
)


@dataclass(frozen=True)
class Intervals:
    """How often a run reports and saves, in steps."""

    report: int = 10
    save: int = 250


class Fit(NamedTuple):
    """A finished run: state, capacities, loss of every step, seconds by purpose.

    Losses, seconds and what was raised are of the whole run, however often resumed.
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
    intervals: Intervals,
    progress: Progress,
    resume: bool = False,
    extra: dict[str, Any] | None = None,
    weights: Variables | None = None,
    spent: Mapping[str, float] | None = None,
) -> Fit:
    """Train to `config.steps` from `weights` or random ones, saving under `folder`.

    Where a batch needs more than there is room for, more is made and the step repeated,
    on the state it started from. `progress(step, loss, note)` hears of every report.
    `spent` are seconds that went into the clouds, which the run's record keeps.

    Raises:
        InputError: clouds of too few points or of unequal size, or nothing to resume.
    """
    _check(config, clouds)
    folder.mkdir(parents=True, exist_ok=True)
    begin, extra = time.perf_counter(), extra or {}
    if resume:
        room, seconds, raised = load_run(folder, config, extra)
    else:
        room, seconds, raised = training_room(config, clouds), dict(UNSPENT), {}
    for purpose, more in (spent or {}).items():
        seconds[purpose] = seconds.get(purpose, 0.0) + more
    # No record may stand beside another run's checkpoints, wherever this is killed.
    manager = open_manager(folder, fresh=not resume)
    with finishing(manager):
        if not resume:
            save_run(folder, config, room, extra, seconds)
        found = latest(manager, config, folder) if resume else None
        state, history = found or (init_state(config, weights), [])
        seconds["compile"] += time.perf_counter() - begin
        compiled = set[Limits]()
        while (step := int(state.step)) < config.steps:
            begin = time.perf_counter()
            state, loss, used, wider = step_with_room(config, room, clouds, state)
            purpose = "train" if used in compiled else "compile"
            seconds[purpose] += time.perf_counter() - begin
            if used is None:
                most = wider.most.sizes
                more = {n: size for n, size in most if size > room.most.of(n)}
                progress(step, loss, f"raised {', '.join(more)}")
                room, raised = wider, raised | more
                compiled.clear()
                forget_programs()
                continue
            compiled.add(used)
            history.append(loss)
            if (step + 1) % intervals.report == 0:
                progress(step + 1, recent_loss(history, intervals.report), "")
            if (step + 1) % intervals.save == 0 or step + 1 == config.steps:
                save_losses(folder, history)
                save_run(folder, config, room, extra, seconds, raised)
                save_state(manager, state)
    return Fit(state, room.usual, np.array(history, np.float32), seconds, raised)


def latest(
    manager: ocp.CheckpointManager, config: Training, folder: Path
) -> tuple[TrainState, list[float]] | None:
    """The newest state of a run and its losses up to there; None before the first."""
    state = restore_state(manager, state_shapes(config, on_devices(config)))
    if state is None:
        return None
    return state, load_losses(folder, int(state.step)).tolist()


def step_with_room(
    config: Training, room: Room, clouds: Sequence[Cloud], state: TrainState
) -> tuple[TrainState, float, Limits | None, Room]:
    """A step, its loss, the limits it took; or None of those and room to repeat it in.

    The state given is used up either way.
    """
    step, short = int(state.step), {}
    batch = step_batch(config, clouds, step)
    for limits in room.each():
        state, report = train_step(config, limits, state, batch)
        if not (short := exceeded(limits, jax.device_get(report.demands))):
            _check_asked(step, report)
            return state, float(report.loss), limits, room
    return state, math.nan, None, with_more(room, config, batch, step, short)


def recent_loss(history: Sequence[float], steps: int) -> float:
    """Mean loss of the last steps, without those that were skipped; NaN if all were."""
    recent = np.asarray(history[-steps:])
    kept = recent[np.isfinite(recent)]
    return float(kept.mean()) if len(kept) else float("nan")


def save_losses(folder: Path, history: Sequence[float]) -> None:
    """Keep the loss of every step beside the checkpoints."""
    losses = np.asarray(history, np.float32)
    write_whole(folder / "losses.npy", lambda file: np.save(file, losses))


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


def _check_asked(step: int, report: StepReport) -> None:
    if not int(report.asked):
        raise InputError(
            f"step {step} has no points left to ask for: all are in level 0; sample "
            "more, raise the finest level, or set sparsest below 1"
        )


def _check(config: Training, clouds: Sequence[Cloud]) -> None:
    if not clouds:
        raise InputError("no training clouds: ask for at least one shape")
    sizes = {len(c.position) for c in clouds}
    fewest = min(sizes)
    if len(sizes) > 1:
        raise InputError(
            f"training clouds have from {fewest} to {max(sizes)} points: cut them to "
            "the same number"
        )
    if fewest < config.points:
        raise InputError(
            f"a training cloud has {fewest} points, a step takes {config.points}: "
            "sample more, or train on fewer"
        )

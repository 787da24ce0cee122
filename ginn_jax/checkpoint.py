"""The state of a training run on disk, by orbax: saved, resumed, read by others."""

import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp
from jax.sharding import SingleDeviceSharding

from ginn_jax.errors import InputError
from ginn_jax.files import unwritable
from ginn_jax.limits import Limits
from ginn_jax.network import Variables
from ginn_jax.recipe import Training
from ginn_jax.run_record import (
    RECORD,
    check_names,
    damaged,
    limits_from,
    read_record,
    training_from,
)
from ginn_jax.train import TrainState, state_shapes

KEPT = 2
CHECKPOINTS = "checkpoints"


def open_manager(folder: Path, fresh: bool = False) -> ocp.CheckpointManager:
    """The checkpoints of a run; the newest `KEPT` stay. Close it when done.

    `fresh` removes those of an earlier run.

    Raises:
        InputError: a folder that cannot be written, or notes on a checkpoint that
            cannot be read.
    """
    path = folder / CHECKPOINTS
    options = ocp.CheckpointManagerOptions(
        max_to_keep=KEPT, create=True, cleanup_tmp_directories=True
    )
    try:
        if fresh and path.exists():
            shutil.rmtree(path)
        return _manager(path, options)
    except OSError as error:
        raise InputError(unwritable(path.absolute(), error)) from None


def open_reader(folder: Path) -> ocp.CheckpointManager:
    """The checkpoints of a run that may be writing one just now: nothing is changed."""
    options = ocp.CheckpointManagerOptions(
        read_only=True, create=False, save_interval_steps=0
    )
    return _manager(folder / CHECKPOINTS, options)


def _manager(path: Path, options: ocp.CheckpointManagerOptions) -> Any:
    handler = ocp.StandardCheckpointHandler()
    try:
        return ocp.CheckpointManager(
            path.absolute(), options=options, item_handlers=handler
        )
    except OSError:
        raise
    except Exception as error:  # what Orbax makes of damage in what it notes of each
        raise _unreadable(f"one of {path.absolute()}", error) from None


def _unreadable(what: str, error: Exception) -> InputError:
    reason = str(error).splitlines()[0][:80] if str(error) else type(error).__name__
    return InputError(
        f"checkpoint {what} cannot be read ({reason}): delete it or start anew"
    )


def save_state(manager: ocp.CheckpointManager, state: TrainState) -> None:
    """Start to write the state under its step number, unless it is there.

    Raises:
        InputError: the one before could not be written.
    """
    step = int(state.step)
    if step not in manager.all_steps():
        with _whole_or_none(manager):
            manager.save(step, args=ocp.args.StandardSave(state._asdict()))


def finish(manager: ocp.CheckpointManager) -> None:
    """Wait until all is written; `InputError` where it could not be."""
    with _whole_or_none(manager):
        manager.close()


@contextmanager
def finishing(manager: ocp.CheckpointManager) -> Iterator[None]:
    """`finish` at the end, also where that is an error, which is then what is said."""
    try:
        yield
    except BaseException:
        with suppress(InputError):
            finish(manager)
        raise
    finish(manager)


@contextmanager
def _whole_or_none(manager: ocp.CheckpointManager) -> Iterator[None]:
    """Remove what was written of a checkpoint if the rest cannot be."""
    try:
        yield
    except Exception as error:  # TensorStore says it by ValueError
        folder = Path(str(manager.directory))
        for half in folder.glob("*.orbax-checkpoint-tmp"):
            shutil.rmtree(half, ignore_errors=True)
        why = " ".join(str(error).split())[-80:]
        raise InputError(
            f"{folder}: checkpoint cannot be written ({why}): make room, then --resume"
        ) from None


def restore_state(
    manager: ocp.CheckpointManager, like: TrainState
) -> TrainState | None:
    """The newest state, placed as `like` is; None where there is no checkpoint.

    Raises:
        InputError: a checkpoint that is damaged or belongs to another network.
    """
    step = manager.latest_step()
    if step is None:
        return None
    shapes = jax.tree.map(_shape_of, like._asdict())
    try:
        # TensorStore would say it as well, after tracebacks of its own.
        _check_shapes(manager.item_metadata(step), shapes)
        found = manager.restore(step, args=ocp.args.StandardRestore(shapes))
    except Exception as error:
        folder = Path(str(manager.directory)) / str(step)
        raise _unreadable(str(folder), error) from None
    return TrainState(**found)


def _check_shapes(found: Any, wanted: Any) -> None:
    """Raise `ValueError` unless the checkpoint has arrays of these shapes."""
    there, here = _shapes_by_name(found), _shapes_by_name(wanted)
    for name, shape in sorted((there | here).items()):
        if there.get(name) != here.get(name):
            raise ValueError(f"not of this network: {name} {shape}")


def _shapes_by_name(tree: Any) -> dict[str, tuple[int, ...]]:
    """Orbax turns tuples with names into dicts: what is left is names and shapes."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    name = partial(jax.tree_util.keystr, simple=True, separator=".")
    return {name(path): tuple(leaf.shape) for path, leaf in leaves}


def _shape_of(leaf: Any) -> jax.ShapeDtypeStruct:
    """Shape, type and place of an array or of a description of one."""
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)


def load_weights(folder: str | Path) -> tuple[Training, Limits, Variables]:
    """What a finished run in `folder` trained: its configuration, capacities, weights.

    Raises:
        InputError: no run there, no checkpoint yet, or a damaged file.
    """
    folder = Path(folder)
    path = folder / RECORD
    record = read_record(path, "no run: name the --out of one")
    with damaged(path, "train again"):
        config = training_from(record["training"])
        limits = limits_from(record)
        if "usual" in record:  # others are given more when they come
            limits = limits_from(record, "usual")
    check_names(path, config.network, limits)
    if not (folder / CHECKPOINTS).is_dir():
        raise InputError(f"{folder} holds no checkpoint yet: let its run go on")
    here = SingleDeviceSharding(jax.devices()[0])
    with closing(open_reader(folder)) as manager:
        state = restore_state(manager, state_shapes(config, here))
    if state is None:
        raise InputError(f"{folder} holds no checkpoint yet: let its run go on")
    return config, limits, state.variables

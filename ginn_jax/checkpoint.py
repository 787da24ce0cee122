"""Saving and resuming a training run: orbax for the state, JSON for what made it."""

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp
from jax.sharding import SingleDeviceSharding

from ginn_jax.architecture import Conv, Network
from ginn_jax.checks import LARGEST_INDEX, whole
from ginn_jax.errors import InputError
from ginn_jax.files import unwritable, writing
from ginn_jax.limits import Limits
from ginn_jax.network import Variables
from ginn_jax.room import Room
from ginn_jax.searches import limit_names
from ginn_jax.train import Training, TrainState, state_shapes

KEPT = 2
CHECKPOINTS, RECORD = "checkpoints", "run.json"
OLD = "{} is of another version of ginn_jax: train again"
UNSPENT = {"compile": 0.0, "train": 0.0}


def open_manager(folder: Path, fresh: bool = False) -> ocp.CheckpointManager:
    """The checkpoints of a run; the newest `KEPT` stay. Close it when done.

    `fresh` removes those of an earlier run.
    """
    path = (folder / CHECKPOINTS).absolute()
    options = ocp.CheckpointManagerOptions(
        max_to_keep=KEPT, create=True, cleanup_tmp_directories=True
    )
    try:
        if fresh and path.exists():
            shutil.rmtree(path)
        handler = ocp.StandardCheckpointHandler()
        return ocp.CheckpointManager(path, options=options, item_handlers=handler)
    except OSError as error:
        raise InputError(unwritable(path, error)) from None


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
        reason = str(error).splitlines()[0][:80] if str(error) else type(error).__name__
        raise InputError(
            f"checkpoint {folder} cannot be read ({reason}): delete it or start anew"
        ) from None
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


def save_run(
    folder: Path,
    config: Training,
    room: Room,
    extra: dict[str, Any],
    seconds: Mapping[str, float] = UNSPENT,
) -> None:
    """Write what a resumed run must agree with, its capacities and the time spent."""
    record = {"training": asdict(config), "seconds": dict(seconds), **extra}
    record |= {"limits": dict(room.most.sizes), "usual": dict(room.usual.sizes)}
    text = json.dumps(record, indent=1, sort_keys=True)
    with writing(folder / RECORD) as new:
        new.write_text(text)


def load_run(
    folder: Path, config: Training, extra: dict[str, Any]
) -> tuple[Room, dict[str, float]]:
    """Capacities of the run to be resumed, and the seconds it took by purpose.

    Raises:
        InputError: no run there, an unreadable record, or other settings than now.
    """
    path = folder / RECORD
    record = read_record(path, "no run to resume: leave out --resume")
    if isinstance(record, dict) and "limits" in record and "usual" not in record:
        raise InputError(OLD.format(path))
    with damaged(path, "delete it and start anew"):
        training = dict(record["training"])
        room = Room(limits_from(record, "usual"), limits_from(record))
        spent = record.get("seconds", UNSPENT)
        seconds = {name: float(spent[name]) for name in UNSPENT}
    wanted = json.loads(json.dumps({"training": asdict(config), **extra}))
    for name in sorted(wanted["training"]):
        if training.get(name) != wanted["training"][name]:
            raise InputError(
                f"{path} was made with another {name}: resume with the same"
            )
    for name in sorted(extra):
        if record.get(name) != wanted[name]:
            raise InputError(
                f"{path} was made with another {name}: resume with the same"
            )
    for limits in room.each():
        check_names(path, config.network, limits)
    return room, seconds


def check_names(path: Path, network: Network, limits: Limits) -> None:
    """Raise `InputError` unless these are the capacities that the network needs."""
    if {name for name, _ in limits.sizes} != set(limit_names(network)):
        raise InputError(OLD.format(path))


def load_weights(folder: Path) -> tuple[Training, Limits, Variables]:
    """What a finished run in `folder` trained: its configuration, capacities, weights.

    Raises:
        InputError: no run there, no checkpoint yet, or a damaged file.
    """
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
    like = jax.tree.map(
        lambda s: jax.ShapeDtypeStruct(s.shape, s.dtype, sharding=here),
        state_shapes(config),
    )
    with closing(open_manager(folder)) as manager:
        state = restore_state(manager, like)
    if state is None:
        raise InputError(f"{folder} holds no checkpoint yet: let its run go on")
    return config, limits, state.variables


def read_record(path: Path, missing: str) -> Any:
    """What `save_run` wrote; None where that is not JSON."""
    try:
        with open(path, "rb") as file:
            if file.read(1) != b"{":
                return None
            return json.loads(b"{" + file.read())
    except FileNotFoundError:
        raise InputError(f"{path.parent} holds {missing}") from None
    except OSError as error:
        raise InputError(
            f"{path} cannot be read ({error.strerror}): mend that or choose another"
        ) from None
    except (ValueError, RecursionError):
        return None


@contextmanager
def damaged(path: Path, mend: str) -> Iterator[None]:
    """Say of a record without what should be in it that it is damaged."""
    try:
        yield
    except (ValueError, KeyError, AttributeError, TypeError, OverflowError):
        raise InputError(f"{path} is damaged: {mend}") from None


def limits_from(record: dict[str, Any], name: str = "limits") -> Limits:
    """The capacities that `save_run` wrote."""
    sizes = record[name].items()
    return Limits(tuple((name, whole(name, n, 1, LARGEST_INDEX)) for name, n in sizes))


def training_from(record: dict[str, Any]) -> Training:
    """The configuration that `save_run` wrote."""
    network = dict(record["network"])
    network["levels"] = tuple(network["levels"])
    network["encoder"] = tuple(Conv(**row) for row in network["encoder"])
    network["query"] = Conv(**network["query"])
    return Training(**{**record, "network": Network(**network)})

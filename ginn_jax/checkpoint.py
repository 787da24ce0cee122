"""Saving and resuming a training run: orbax for the state, JSON for what made it."""

import json
import shutil
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp
from jax.sharding import SingleDeviceSharding

from ginn_jax.architecture import Conv, Network
from ginn_jax.errors import InputError
from ginn_jax.geometry import Limits, limit_names
from ginn_jax.network import Variables
from ginn_jax.train import Training, TrainState, state_shapes

KEPT = 2


def open_manager(folder: Path, fresh: bool = False) -> ocp.CheckpointManager:
    """The checkpoints of a run; the newest `KEPT` stay. Close it when done.

    `fresh` removes those of an earlier run.
    """
    path = (folder / "checkpoints").absolute()
    if fresh and path.exists():
        shutil.rmtree(path)
    options = ocp.CheckpointManagerOptions(max_to_keep=KEPT, create=True)
    return ocp.CheckpointManager(path, options=options)


def save_state(manager: ocp.CheckpointManager, state: TrainState) -> None:
    """Write the state under its step number, unless it is there."""
    step = int(state.step)
    if step not in manager.all_steps():
        manager.save(step, args=ocp.args.StandardSave(state._asdict()))


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
        found = manager.restore(step, args=ocp.args.StandardRestore(shapes))
    except Exception as error:
        folder = Path(str(manager.directory)) / str(step)
        reason = str(error).splitlines()[0][:80] if str(error) else type(error).__name__
        raise InputError(
            f"checkpoint {folder} cannot be read ({reason}): delete it or start anew"
        ) from None
    return TrainState(**found)


def _shape_of(leaf: Any) -> jax.ShapeDtypeStruct:
    """Shape, type and place of an array or of a description of one."""
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)


def save_run(
    folder: Path, config: Training, limits: Limits, extra: dict[str, Any]
) -> None:
    """Write what a resumed run must agree with: configuration and capacities."""
    record = {"training": asdict(config), "limits": dict(limits.sizes), **extra}
    text = json.dumps(record, indent=1, sort_keys=True)
    temporary = folder / "run.json.partial"
    temporary.write_text(text)
    temporary.replace(folder / "run.json")


def load_run(folder: Path, config: Training, extra: dict[str, Any]) -> Limits:
    """The capacities of the run to be resumed.

    Raises:
        InputError: no run there, an unreadable record, or other settings than now.
    """
    path = folder / "run.json"
    try:
        record = json.loads(path.read_text())
        training = dict(record["training"])
        limits = Limits(tuple((k, int(v)) for k, v in record["limits"].items()))
    except FileNotFoundError:
        raise InputError(
            f"{folder} holds no run to resume: leave out --resume"
        ) from None
    except (ValueError, KeyError, AttributeError, TypeError):
        raise InputError(f"{path} is damaged: delete it and start anew") from None
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
    check_names(path, config.network, limits)
    return limits


def check_names(path: Path, network: Network, limits: Limits) -> None:
    """Raise `InputError` unless these are the capacities that the network needs."""
    if {name for name, _ in limits.sizes} != set(limit_names(network)):
        raise InputError(f"{path} is of another version of ginn_jax: train again")


def load_weights(folder: Path) -> tuple[Training, Limits, Variables]:
    """What a finished run in `folder` trained: its configuration, capacities, weights.

    Raises:
        InputError: no run there, no checkpoint yet, or a damaged file.
    """
    path = folder / "run.json"
    try:
        record = json.loads(path.read_text())
        config = training_from(record["training"])
        limits = Limits(tuple((k, int(v)) for k, v in record["limits"].items()))
    except FileNotFoundError:
        raise InputError(f"{folder} holds no run: name the --out of one") from None
    except (ValueError, KeyError, AttributeError, TypeError):
        raise InputError(f"{path} is damaged: train again") from None
    check_names(path, config.network, limits)
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


def training_from(record: dict[str, Any]) -> Training:
    """The configuration that `save_run` wrote."""
    network = dict(record["network"])
    network["levels"] = tuple(network["levels"])
    network["encoder"] = tuple(Conv(**row) for row in network["encoder"])
    network["query"] = Conv(**network["query"])
    return Training(**{**record, "network": Network(**network)})

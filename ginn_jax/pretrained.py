"""Trained networks that come with the package: one .npz of weights each, a manifest.

The arrays carry their place in the tree as a name and need nothing but NumPy to read;
`manifest.json` says of each network how it was trained, on what, and how good it is.
"""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ginn_jax.checkpoint import load_weights
from ginn_jax.dataset import load_arrays, save_arrays
from ginn_jax.errors import InputError
from ginn_jax.files import writing
from ginn_jax.limits import Limits
from ginn_jax.network import Variables
from ginn_jax.presets import effect_of
from ginn_jax.recipe import Training
from ginn_jax.run_record import (
    RECORD,
    check_names,
    damaged,
    limits_from,
    read_record,
    training_from,
)
from ginn_jax.train import state_shapes

FOLDER = Path(__file__).parent / "weights"
MANIFEST = "manifest.json"
Record = dict[str, Any]


def load_manifest(folder: str | Path = FOLDER) -> dict[str, Record]:
    """What there is, by name, and how each came to be.

    Raises:
        InputError: a damaged manifest; one that is not there says of none.
    """
    path = Path(folder) / MANIFEST
    if not path.exists():
        return {}
    found = read_record(path, "no manifest")
    if not isinstance(found, dict):
        raise InputError(f"{path} is damaged: install the package again")
    return found


def load_pretrained(
    name: str, folder: str | Path = FOLDER
) -> tuple[Training, Limits, Variables]:
    """Configuration, capacities and weights of "ao", "gi", "sss", of finer networks,
    "ao_fine", "sss_fine", and of ablations.

    Raises:
        InputError: no network of that name, or a damaged file.
    """
    folder = Path(folder)
    manifest = load_manifest(folder)
    if name not in manifest:
        known = ", ".join(sorted(manifest)) or "none, so install the package again"
        raise InputError(f"no trained network {name!r}: there are {known}")
    with damaged(folder / MANIFEST, "install the package again"):
        config = training_from(manifest[name]["training"])
        limits = limits_from(manifest[name])
    check_names(folder / MANIFEST, config.network, limits)
    return config, limits, read_weights(folder / f"{name}.npz", config)


def starting_weights(name: str, config: Training) -> Variables:
    """Weights to train on: of a run, if `name` is its folder, or of the package.

    Raises:
        InputError: none of that name, or of a network with other layers.
    """
    _, _, weights = load_any(name)
    found, wanted = jax.eval_shape(lambda: weights), state_shapes(config).variables
    if jax.tree.map(str, found) != jax.tree.map(str, wanted):
        raise InputError(
            f"{name} holds a network with other layers: train on one of this --preset"
        )
    return weights


def load_network(effect: str, name: str | None) -> tuple[Training, Limits, Variables]:
    """`load_any` of an effect; for None the package's that is named as the effect.

    Raises:
        InputError: as `load_any`, or a network of another effect.
    """
    name = name or effect
    found = load_any(name)
    if effect_of(found[0].network) != effect:
        raise InputError(f"{name} is no network of {effect}: name one that is")
    return found


def load_any(name: str) -> tuple[Training, Limits, Variables]:
    """The network of a run, if `name` is a folder's, else `load_pretrained`."""
    run = run_folder(name)
    return load_pretrained(name) if run is None else load_weights(run)


def run_folder(name: str) -> Path | None:
    """The folder of the run that is meant; None for a network of the package.

    A name of both is the package's: the folder "gi" is "./gi".
    """
    if name in load_manifest():
        return None
    run = Path(name)
    return run if run.is_dir() or len(run.parts) > 1 else None


def read_weights(path: Path, config: Training) -> Variables:
    """The weights of a network from their file.

    Raises:
        InputError: a missing or damaged file, or one of another network.
    """
    found = load_arrays(path, None, "install the package again")
    leaves, tree = jax.tree.flatten_with_path(state_shapes(config).variables)
    wanted = {tree_name(keys): leaf.shape for keys, leaf in leaves}
    if wanted != {name: array.shape for name, array in found.items()}:
        raise InputError(f"{path} holds another network: install the package again")
    values = [np.asarray(found[name], np.float32) for name in wanted]
    if not all(np.isfinite(value).all() for value in values):
        raise InputError(f"{path} holds weights that are not finite: train again")
    return jax.tree.unflatten(tree, [jax.numpy.asarray(value) for value in values])


def tree_name(keys: Any) -> str:
    """Where an array stands in its tree, as a name."""
    return jax.tree_util.keystr(keys, simple=True, separator="/")


def export(
    run: str | Path, name: str, more: Record, folder: str | Path = FOLDER
) -> Path:
    """Write the weights of a finished run into `folder`, with a record of the run.

    Raises:
        InputError: no finished run there, or one whose records are damaged.
    """
    run, folder = Path(run), Path(folder)
    _, limits, variables = load_weights(run)
    record = record_of(run, limits) | more
    folder.mkdir(parents=True, exist_ok=True)
    leaves, _ = jax.tree.flatten_with_path(variables)
    arrays = {tree_name(keys): np.asarray(leaf) for keys, leaf in leaves}
    save_arrays(folder / f"{name}.npz", arrays, {"name": name})
    manifest = load_manifest(folder)
    manifest[name] = record
    with writing(folder / MANIFEST) as path:
        path.write_text(json.dumps(manifest, indent=1, sort_keys=True) + "\n")
    return folder / f"{name}.npz"


def record_of(run: Path, limits: Limits) -> Record:
    """What the manifest says of a run; paths are of whoever trained, so left out."""
    missing = "no {}: let its run finish"
    metrics, made = (
        read_record(run / name, missing.format(name))
        for name in ("metrics.json", RECORD)
    )
    with damaged(run / "metrics.json", "let its run finish again, by --resume"):
        return _record(metrics, made, limits)


def _record(metrics: Record, made: Record, limits: Limits) -> Record:
    names = ("relative_mse_3d", "median_relative_mse_3d", "equal_rays", "clouds")
    pooled = {
        key: value
        for key, value in metrics.items()
        if key.startswith("unseen") and isinstance(value, dict)
    }
    return {
        "start": made.get("start"),
        "training": made["training"],
        "limits": dict(limits.sizes),
        "data": made["data"],
        "objects": len(made["objects"]),
        "errors": {
            key: {name: value[name] for name in names} for key, value in pooled.items()
        },
        "steps": metrics["steps"],
        "seed": made["training"]["seed"],
        "packages": metrics["environment"]["packages"],
    }

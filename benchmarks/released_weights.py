"""Weights of the networks that the authors released in 2019, for `presets.RELEASED`.

Two checkpoints of https://github.com/viscom-ulm/GINN, in its folder `trained_networks`:
gi.ckpt, for indirect light, and sss.ckpt, for light that scatters below the surface.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import unflatten_dict

from benchmarks.tensorflow_checkpoint import read_tensors
from ginn_jax.architecture import Network
from ginn_jax.errors import InputError
from ginn_jax.given import weight_shapes
from ginn_jax.kernels import Kernel
from ginn_jax.network import Variables
from ginn_jax.presets import ILLUMINATION, SCATTERING

NETWORKS = {"gi": ILLUMINATION["released"], "sss": SCATTERING["released"]}
SCOPE = "feature_channel_scope"


class Layer(NamedTuple):
    """What belongs to one of our modules: their names of its convolution, of its norms,
    and of its 1x1 layers under our names."""

    conv: str | None
    norms: tuple[str, ...] = ()
    dense: tuple[tuple[str, str], ...] = ()


def _reduced(conv: str) -> Layer:
    name = f"Reduce_{conv}"
    return Layer(conv, (f"{name}_In", f"{name}_Out"), (("Dense_0", name),))


def _raised(conv: str, before: str) -> Layer:
    return Layer(conv, (before, conv), (("Dense_0", before),))


LAYERS = {
    ("encoder", "conv_1"): Layer("Conv_1"),
    ("encoder", "pool_1"): _reduced("Pool_1"),
    ("encoder", "conv_2"): _reduced("Conv_2"),
    ("encoder", "pool_2"): _reduced("Pool_2"),
    ("encoder", "conv_3"): _reduced("Conv_3"),
    ("encoder", "pool_3"): _reduced("Pool_3"),
    ("encoder", "conv_4"): _reduced("Conv_4"),
    ("encoder", "up_3"): Layer("Up_3", ("Up_3",)),
    ("encoder", "up_2"): _raised("Up_2", "Up_3_Reduce"),
    ("encoder", "up_1"): _raised("Up_1_2", "Up_2_Reduce"),
    ("encoder",): Layer(None, ("Up_1_Reduce", "Up_1"), (("latent", "Up_1_Reduce"),)),
    ("shader", "query"): Layer("Final_Conv"),
    ("shader",): Layer(
        None,
        ("Final_MLP1", "Final_MLP2"),
        (("Dense_0", "Final_MLP1"), ("Dense_1", "Final_MLP2")),
    ),
}


def load_released(effect: str, folder: Path) -> Variables:
    """Their weights for "gi" or "sss" as variables of `NETWORKS`.

    Raises:
        InputError: no such checkpoint, one that is damaged, or one of other layers.
    """
    prefix = folder / f"{effect}.ckpt"
    tensors = {
        name.removeprefix(f"{SCOPE}/"): values
        for name, values in read_tensors(prefix).items()
    }
    try:
        variables = unflatten_dict(dict(_entries(tensors)))
        _check_shapes(NETWORKS[effect], variables)
    except (KeyError, ValueError) as error:
        raise InputError(f"{prefix} is of other layers: {error}") from None
    return variables


def _entries(
    tensors: dict[str, np.ndarray],
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every array by its path in our variables."""
    for (part, *module), layer in LAYERS.items():
        params, moments = (part, "params", *module), (part, "batch_stats", *module)
        if layer.conv is not None:
            yield (*params, "kernel"), kernel_of(tensors, layer.conv)
        for ours, theirs in layer.dense:
            yield (*params, ours, "kernel"), tensors[f"{theirs}_weights"]
            yield (*params, ours, "bias"), tensors[f"{theirs}_biases"]
        for place, name in enumerate(layer.norms):
            norm, theirs = (f"Norm_{place}", "BatchNorm_0"), f"{name}_BN_BN"
            yield (*params, *norm, "scale"), tensors[f"{theirs}/gamma"]
            yield (*params, *norm, "bias"), tensors[f"{theirs}/beta"]
            yield (*moments, *norm, "mean"), tensors[f"{theirs}/moving_mean"]
            yield (*moments, *norm, "var"), tensors[f"{theirs}/moving_variance"]


def kernel_of(tensors: dict[str, np.ndarray], name: str) -> Kernel:
    """A kernel of theirs as one of ours.

    They read their first matrix as a row for each hidden unit, whatever its shape says,
    and the others with outputs first; and their offsets point to the sender, ours to
    the receiver.
    """
    w1, w2, w3 = (tensors[f"{name}_weights{part}"] for part in ("", "2", "3"))
    b1, b2, b3 = (tensors[f"{name}_biases{part}"] for part in ("", "2", "3"))
    w1 = -w1.reshape(*b2.shape, 3)
    w1, w2, w3 = (np.swapaxes(w, 1, 2) for w in (w1, w2, w3))
    return Kernel(*map(jnp.asarray, (w1, b1.reshape(b2.shape), w2, b2, w3, b3)))


def _check_shapes(network: Network, variables: Variables) -> None:
    """Raise `ValueError` naming the first array that is not of that network."""
    shapes, _ = weight_shapes(network)
    found = jax.tree_util.tree_leaves_with_path(variables)
    for (path, array), shape in zip(found, shapes, strict=True):
        if array.shape != shape:
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            raise ValueError(f"{name} is {array.shape}")

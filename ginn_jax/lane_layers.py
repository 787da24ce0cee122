"""Layers in lanes: what `network` and `kernels` make of a row, row by row.

Every weight is a number in the program, which is compiled anew for other weights.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ginn_jax.architecture import Network
from ginn_jax.lanes import Lane, Lanes
from ginn_jax.network import EPSILON, SLOPE


class Constants(NamedTuple):
    """Arrays that a program has inside, told apart by what is in them."""

    tree: Any
    shapes: tuple[tuple[int, ...], ...]
    contents: tuple[bytes, ...]


def as_constants(arrays: Any) -> Constants:
    """A pytree of float32 arrays as something that can be looked up."""
    leaves, tree = jax.tree.flatten(arrays)
    leaves = [np.asarray(a, np.float32) for a in leaves]
    shapes = tuple(a.shape for a in leaves)
    return Constants(tree, shapes, tuple(a.tobytes() for a in leaves))


def from_constants(constants: Constants) -> Any:
    """The arrays."""
    return jax.tree.unflatten(
        constants.tree,
        [
            np.frombuffer(content, np.float32).reshape(shape)
            for shape, content in zip(*constants[1:], strict=True)
        ],
    )


def head(
    dr: Any,
    network: Network,
    params: Any,
    free: Lanes,
    beams: Lanes | None,
    own: Lanes,
    light: Lanes,
) -> Lane:
    """The two 1x1 layers, and what light adds to them by linear maps."""
    seen = own if network.linear else own + light
    free = norm(dr, network, params.get("Norm_0"), free)
    free = dense(dr, params["Dense_0"], free + seen)
    free = norm(dr, network, params.get("Norm_1"), free)
    value = dr.llvm.Float(0)
    if not network.linear:
        value = dense(dr, params["Dense_1"], free)[0]
    if beams is None:
        return value
    return value + sum(gate(dr, params["out_light"], free, beams + light))


def perceptron(dr: Any, kernel: Any, inputs: Lanes, outputs: int) -> Lanes:
    """Kernel values of an edge, block by block: `kernels.evaluate_kernel`."""
    values: Lanes = []
    for w1, b1, w2, b2, w3, b3 in zip(*kernel, strict=True):
        hidden = inputs
        for weights, bias in ((w1, b1), (w2, b2)):
            hidden = [dr.maximum(x, 0) for x in _affine(dr, weights, bias, hidden)]
        values += _affine(dr, w3, b3, hidden)
    return values[:outputs]


def norm(dr: Any, network: Network, params: Any, x: Lanes) -> Lanes:
    """`network.Norm` of one row, then leaky ReLU."""
    if network.norm == "layer":
        layer = params["LayerNorm_0"]
        mean = sum(x) / len(x)
        x = [a - mean for a in x]
        inverse = dr.rsqrt(dot(x, x) / len(x) + EPSILON)
        ends = (np.asarray(layer[name]).tolist() for name in ("scale", "bias"))
        x = [dr.fma(a * inverse, s, b) for a, s, b in zip(x, *ends, strict=True)]
    return [dr.maximum(a, a * SLOPE) for a in x]


def dense(dr: Any, params: Any, x: Lanes) -> Lanes:
    """A 1x1 layer of one row."""
    weights = np.asarray(params["kernel"])
    bias = np.asarray(params.get("bias", np.zeros(weights.shape[1])))
    return _affine(dr, weights, bias, x)


def gate(dr: Any, params: Any, free: Lanes, light: Lanes) -> Lanes:
    """`network.Gate` of one row."""
    ends = dense(dr, params["gate"], free), dense(dr, params["light"], light)
    return [a * b for a, b in zip(*ends, strict=True)]


def _affine(
    dr: Any, weights: Float[np.ndarray, "K L"], bias: Float[np.ndarray, "L"], x: Lanes
) -> Lanes:
    """x @ weights + bias, with every weight a number in the program."""
    found = []
    for column, start in zip(weights.T.tolist(), bias.tolist(), strict=True):
        total = dr.llvm.Float(start)
        for weight, a in zip(column, x, strict=True):
            total = dr.fma(a, weight, total)
        found.append(total)
    return found


def dot(a: Lanes, b: Lanes) -> Lane:
    """The sum of the products."""
    return sum(x * y for x, y in zip(a, b, strict=True))

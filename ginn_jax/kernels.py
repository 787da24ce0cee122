"""Kernels of convolutions: perceptrons from what an edge shows to the kernel's values.

The same function in three layouts, because the layout decides the time on a CPU: values
first, edges first, and edges first for gradients.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from ginn_jax.errors import InputError

# A GPU would round the factors of a product to ten bits by default.
EXACT = jax.lax.Precision.HIGHEST
_product = partial(jnp.matmul, precision=EXACT)
_einsum = partial(jnp.einsum, precision=EXACT)


class Kernel(NamedTuple):
    """G independent perceptrons D -> H -> H -> K that make G * K kernel values."""

    w1: Float[Array, "G D H"]
    b1: Float[Array, "G H"]
    w2: Float[Array, "G H H"]
    b2: Float[Array, "G H"]
    w3: Float[Array, "G H K"]
    b3: Float[Array, "G K"]


BIASES = ("b1", "b2", "b3")


def init_kernel(
    inputs: int, outputs: int, hidden: int, group: int, *, key: Key[Array, ""]
) -> Kernel:
    """Kernel with blocks of `group` outputs each; He-initialised, zero biases."""
    blocks = -(-outputs // group)
    shapes = [(inputs, hidden), (hidden, hidden), (hidden, group)]
    keys = jax.random.split(key, len(shapes))
    weights = [
        jax.random.normal(k, (blocks, *shape)) * jnp.sqrt(2.0 / shape[0])
        for k, shape in zip(keys, shapes, strict=True)
    ]
    biases = [jnp.zeros((blocks, shape[1])) for shape in shapes]
    return Kernel(weights[0], biases[0], weights[1], biases[1], weights[2], biases[2])


def check_kernel(kernel: Kernel, inputs: int, outputs: int) -> None:
    """Raise `InputError` unless it makes so many values of so many inputs."""
    blocks, width, _ = kernel.w1.shape
    group = kernel.w3.shape[2]
    if width != inputs:
        raise InputError(f"the kernel takes {width} inputs, edges have {inputs}")
    if -(-outputs // group) != blocks:
        raise InputError(
            f"the kernel has {blocks} blocks of {group} values for {outputs} of the "
            "convolution: give one that was made for them"
        )


def evaluate_kernel(
    kernel: Kernel, inputs: Float[Array, "D E"], outputs: int
) -> Float[Array, "K E"]:
    """Kernel values of every edge: a perceptron with two ReLU layers per block."""

    def block(
        w1: Array, b1: Array, w2: Array, b2: Array, w3: Array, b3: Array
    ) -> Float[Array, "K E"]:
        # XLA's products are fast on weights that lie turned, not on weights it turns.
        w1, w2, w3 = (jax.lax.optimization_barrier(w.T) for w in (w1, w2, w3))
        hidden = jax.nn.relu(_product(w1, inputs) + b1[:, None])
        hidden = jax.nn.relu(_product(w2, hidden) + b2[:, None])
        return _product(w3, hidden) + b3[:, None]

    values = [block(*(a[i] for a in kernel)) for i in range(kernel.w1.shape[0])]
    return jnp.concatenate(values)[:outputs]


def edges_first(
    kernel: Kernel, inputs: Float[Array, "D E"], outputs: int
) -> Float[Array, "E K"]:
    """The transpose of `evaluate_kernel`, by itself: in a product it costs more."""
    return jax.lax.optimization_barrier(evaluate_kernel(kernel, inputs, outputs)).T


def edges_first_to_differentiate(
    kernel: Kernel, inputs: Float[Array, "D E"], outputs: int
) -> Float[Array, "E K"]:
    """The same in the form whose gradient XLA computes faster, by a fifth."""

    def block(
        w1: Array, b1: Array, w2: Array, b2: Array, w3: Array, b3: Array
    ) -> Float[Array, "E K"]:
        hidden = jax.nn.relu(_einsum("ih,ie->he", w1, inputs) + b1[:, None])
        hidden = jax.nn.relu(_einsum("ih,ie->he", w2, hidden) + b2[:, None])
        return _einsum("hk,he->ek", w3, hidden) + b3

    values = [block(*(a[i] for a in kernel)) for i in range(kernel.w1.shape[0])]
    return jnp.concatenate(values, axis=-1)[:, :outputs]

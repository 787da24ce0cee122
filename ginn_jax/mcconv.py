"""Receptive fields and Monte Carlo convolution (paper, appendix).

The convolution of features f with a learned kernel g at a receiver x is

    (f * g)(x) = 1/|N(x)| sum_j f(y_j) g((x - y_j) / r) / p(y_j | x)

over the senders y_j closer than r. The density p is itself an average over N(x), so
|N(x)| cancels and each sender carries a weight that no parameter enters:

    kde      w_j = 1 / sum_{k in N(x)} G((y_k - y_j) / (h r)), the paper's, for every
             pair of neighbours of every receiver: O(|N|^2)
    surface  w_j = A_j / (pi r^2), where A_j is the area that sender j stands for, once
             for every sender: O(|N|), and unmoved by a change of sampling density

`receptive_field` is the only place with geometry, `mc_conv` the only one with
parameters.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from ginn_jax.voxels import Edges, expand_ranges

OFFSET_INPUTS, ORIENTED_INPUTS = 3, 7


class Field(NamedTuple):
    """Edges with what the kernel sees and the weight of each; padding weighs zero."""

    sender: Int[Array, "E"]
    receiver: Int[Array, "E"]
    inputs: Float[Array, "E D"]
    weight: Float[Array, "E"]


class Kernel(NamedTuple):
    """G independent perceptrons D -> H -> H -> K that make G * K kernel values."""

    w1: Float[Array, "G D H"]
    b1: Float[Array, "G H"]
    w2: Float[Array, "G H H"]
    b2: Float[Array, "G H"]
    w3: Float[Array, "G H K"]
    b3: Float[Array, "G K"]


class Oriented(NamedTuple):
    """Points with unit normals, some of them padding."""

    position: Float[Any, "N 3"]
    normal: Float[Any, "N 3"]
    mask: Bool[Any, "N"]


def edge_offsets(
    senders: Float[Array, "N 3"], receivers: Float[Array, "M 3"], edges: Edges
) -> tuple[Float[Array, "E 3"], Bool[Array, "E"]]:
    """x - y of every edge, zero where padded, and which edges are real."""
    real = edges.receiver < receivers.shape[0]
    receiver = jnp.where(real, edges.receiver, 0)
    offset = receivers[receiver] - senders[edges.sender]
    return jnp.where(real[:, None], offset, 0.0), real


def kernel_inputs(
    senders: Oriented,
    receivers: Oriented,
    edges: Edges,
    radius: Float[Array, ""],
    oriented: bool,
) -> Float[Array, "E D"]:
    """The offset o = (x - y) / r; if `oriented`, also n_x.o, n_y.o, n_x.n_y, |o|^2.

    The paper's kernels see the offset only. The four products tell a kernel which side
    of either surface the other point lies on, whatever the azimuth.
    """
    offset, real = edge_offsets(senders.position, receivers.position, edges)
    offset = offset / radius
    if not oriented:
        return offset
    normal_x = receivers.normal[jnp.where(real, edges.receiver, 0)]
    normal_y = senders.normal[edges.sender]
    pairs = (
        (normal_x, offset),
        (normal_y, offset),
        (normal_x, normal_y),
        (offset, offset),
    )
    products = [jnp.sum(a * b, axis=-1, keepdims=True) for a, b in pairs]
    return jnp.where(real[:, None], jnp.concatenate([offset, *products], axis=-1), 0.0)


def kde_weight(
    senders: Float[Array, "N 3"],
    receivers: Float[Array, "M 3"],
    edges: Edges,
    radius: Float[Array, ""],
    bandwidth: float,
    pairs: int,
) -> tuple[Float[Array, "E"], Int[Array, ""]]:
    """The paper's weight of each edge, and the number of pairs it looked at.

    Gaussian kernel density of width h r in units where r = 1, evaluated at the sender
    over all senders of the same receiver, itself included. `pairs` is a capacity.
    """
    count = receivers.shape[0]
    first = jnp.searchsorted(edges.receiver, jnp.arange(count + 1)).astype(jnp.int32)
    real = edges.receiver < count
    receiver = jnp.where(real, edges.receiver, 0)
    length = jnp.where(real, first[receiver + 1] - first[receiver], 0)
    slots, demand = expand_ranges(first[receiver], length, pairs)
    mine, other = edges.sender[slots.owner], edges.sender[slots.row]
    offset = (senders[other] - senders[mine]) / (radius * bandwidth)
    constant = (0.5 / jnp.pi) ** 1.5 / bandwidth**3
    value = constant * jnp.exp(-0.5 * jnp.sum(offset**2, axis=-1))
    density = jax.ops.segment_sum(
        jnp.where(slots.valid, value, 0.0),
        slots.owner,
        edges.sender.shape[0],
        indices_are_sorted=True,
    )
    return jnp.where(real, 1 / jnp.where(real, density, 1.0), 0.0), demand


def point_area(
    position: Float[Array, "N 3"],
    mask: Bool[Array, "N"],
    edges: Edges,
    radius: Float[Array, ""],
) -> Float[Array, "N"]:
    """Area each point stands for, from the edges of the cloud with itself.

    The inverse of a density by the quartic kernel (1 - d^2 / r^2)^2, whose integral
    over a flat surface is pi r^2 / 3.
    """
    offset, real = edge_offsets(position, position, edges)
    value = (1 - jnp.sum(offset**2, axis=-1) / radius**2) ** 2
    total = jax.ops.segment_sum(
        jnp.where(real, value, 0.0),
        edges.receiver,
        position.shape[0],
        indices_are_sorted=True,
    )
    # The point itself adds 1; a smaller total belongs to a padded row.
    area = jnp.pi * radius**2 / 3 / jnp.maximum(total, 1.0)
    return jnp.where(mask, area, 0.0)


def surface_weight(
    area: Float[Array, "N"], edges: Edges, receivers: int, radius: Float[Array, ""]
) -> Float[Array, "E"]:
    """Area of each edge's sender relative to the disk of the receptive field."""
    real = edges.receiver < receivers
    return jnp.where(real, area[edges.sender] / (jnp.pi * radius**2), 0.0)


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


def evaluate_kernel(
    kernel: Kernel, inputs: Float[Array, "E D"], outputs: int
) -> Float[Array, "E K"]:
    """Kernel values of every edge: a perceptron with two ReLU layers per block."""

    def block(
        w1: Array, b1: Array, w2: Array, b2: Array, w3: Array, b3: Array
    ) -> Float[Array, "E K"]:
        hidden = jax.nn.relu(inputs @ w1 + b1)
        hidden = jax.nn.relu(hidden @ w2 + b2)
        return hidden @ w3 + b3

    values = [block(*(a[i] for a in kernel)) for i in range(kernel.w1.shape[0])]
    return jnp.concatenate(values, axis=-1)[:, :outputs]


def mc_conv(
    kernel: Kernel, features: Float[Array, "N C"], field: Field, receivers: int
) -> Float[Array, "M C"]:
    """Depth-wise convolution: channel c of the output sees channel c of the input."""
    values = evaluate_kernel(kernel, field.inputs, features.shape[1])
    return _gather_sum(values * features[field.sender], field, receivers)


def mc_conv_mixing(
    kernel: Kernel,
    features: Float[Array, "N C"],
    field: Field,
    receivers: int,
    outputs: int,
) -> Float[Array, "M K"]:
    """Full convolution: every output channel has a kernel for every input channel."""
    channels = features.shape[1]
    values = evaluate_kernel(kernel, field.inputs, outputs * channels)
    values = values.reshape(-1, outputs, channels)
    mixed = jnp.sum(values * features[field.sender][:, None], axis=-1)
    return _gather_sum(mixed, field, receivers)


def _gather_sum(
    values: Float[Array, "E K"], field: Field, receivers: int
) -> Float[Array, "M K"]:
    """Weighted sum over the edges of each receiver."""
    weighted = values * field.weight[:, None]
    return jax.ops.segment_sum(weighted, field.receiver, receivers)

"""Receptive fields and Monte Carlo convolution (paper, appendix).

The convolution of features f with a learned kernel g at a receiver x is

    (f * g)(x) = 1/|N(x)| sum_j f(y_j) g((x - y_j) / r) / p(y_j | x)

over the senders y_j closer than r. The density p is itself an average over N(x), so
|N(x)| cancels and each sender carries a weight that no parameter enters:

    kde      w_j = 1 / sum_{k in N(x)} G((y_k - y_j) / (h r)), the paper's, for every
             pair of neighbours of every receiver: O(|N|^2)
    surface  w_j = A_j / (pi r^2), where A_j is the area that sender j stands for, once
             for every sender: O(|N|), and unmoved by a change of sampling density

Edges are taken in tiles that fit a core's cache, as many as hold real edges: padding
costs memory, not time. The gradient takes the same tiles again and keeps nothing.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from ginn_jax.packets import Edges
from ginn_jax.voxels import expand_ranges

OFFSET_INPUTS, ORIENTED_INPUTS = 3, 7
TILE = 8192


class Field(NamedTuple):
    """Edges with what the kernel sees and the weight of each.

    The first `count` edges are real; the others weigh zero.
    """

    sender: Int[Array, "E"]
    receiver: Int[Array, "E"]
    inputs: Float[Array, "D E"]
    weight: Float[Array, "E"]
    count: Int[Array, ""]


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
) -> tuple[Float[Array, "3 E"], Bool[Array, "E"]]:
    """x - y of every edge, zero where padded, and which edges are real."""
    real = edges.receiver < receivers.shape[0]
    receiver = jnp.where(real, edges.receiver, 0)
    offset = receivers.T[:, receiver] - senders.T[:, edges.sender]
    return jnp.where(real, offset, 0.0), real


def kernel_inputs(
    senders: Oriented,
    receivers: Oriented,
    edges: Edges,
    radius: Float[Array, ""],
    oriented: bool,
) -> Float[Array, "D E"]:
    """The offset o = (x - y) / r; if `oriented`, also n_x.o, n_y.o, n_x.n_y, |o|^2.

    The paper's kernels see the offset only. The four products tell a kernel which side
    of either surface the other point lies on, whatever the azimuth.
    """
    real = edges.receiver < receivers.position.shape[0]
    ends = (receivers, jnp.where(real, edges.receiver, 0)), (senders, edges.sender)
    x, y = (
        take_columns(
            jnp.concatenate([p.position, p.normal], axis=1).T, index, edges.demand.edges
        )
        for p, index in ends
    )
    offset, normal_x, normal_y = (x[:3] - y[:3]) / radius, x[3:], y[3:]
    if not oriented:
        return jnp.where(real, offset, 0.0)
    pairs = (
        (normal_x, offset),
        (normal_y, offset),
        (normal_x, normal_y),
        (offset, offset),
    )
    products = [jnp.sum(a * b, axis=0, keepdims=True) for a, b in pairs]
    return jnp.where(real, jnp.concatenate([offset, *products]), 0.0)


@jax.custom_vjp
def take_columns(
    table: Float[Array, "C N"], index: Int[Array, "E"], count: Int[Array, ""]
) -> Float[Array, "C E"]:
    """`table[:, index]` for the first `count` indices, in tiles; further ones may be 0.

    A loop of its own, so that XLA does not gather anew for each use of the result.
    """
    size = _tile_size(index.shape[0])

    def take(number: Int[Array, ""], taken: Float[Array, "C E"]) -> Array:
        start = jnp.minimum(number * size, index.shape[0] - size)
        some = jax.lax.dynamic_slice_in_dim(index, start, size)
        return jax.lax.dynamic_update_slice_in_dim(taken, table[:, some], start, axis=1)

    tiles = _tile_count(index.shape[0], count)
    nothing = jnp.zeros((table.shape[0], index.shape[0]), table.dtype)
    return jax.lax.fori_loop(0, tiles, take, nothing)


def _take_forward(
    table: Float[Array, "C N"], index: Int[Array, "E"], count: Int[Array, ""]
) -> tuple[Float[Array, "C E"], Any]:
    return take_columns(table, index, count), (table, index, count)


def _take_backward(inputs: Any, cotangent: Float[Array, "C E"]) -> Any:
    table, index, count = inputs
    real = jnp.arange(index.shape[0]) < count
    given = jnp.where(real, cotangent, 0.0)
    return jnp.zeros_like(table).at[:, index].add(given), None, None


take_columns.defvjp(_take_forward, _take_backward)


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
    value = (1 - jnp.sum(offset**2, axis=0) / radius**2) ** 2
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
    kernel: Kernel, inputs: Float[Array, "D E"], outputs: int
) -> Float[Array, "E K"]:
    """Kernel values of every edge: a perceptron with two ReLU layers per block."""

    def block(
        w1: Array, b1: Array, w2: Array, b2: Array, w3: Array, b3: Array
    ) -> Float[Array, "E K"]:
        hidden = jax.nn.relu(jnp.einsum("ih,ie->he", w1, inputs) + b1[:, None])
        hidden = jax.nn.relu(jnp.einsum("ih,ie->he", w2, hidden) + b2[:, None])
        return jnp.einsum("hk,he->ek", w3, hidden) + b3

    values = [block(*(a[i] for a in kernel)) for i in range(kernel.w1.shape[0])]
    return jnp.concatenate(values, axis=-1)[:, :outputs]


def mc_conv(
    kernel: Kernel, features: Float[Array, "N C"], field: Field, receivers: int
) -> Float[Array, "M C"]:
    """Depth-wise convolution: channel c of the output sees channel c of the input."""
    return _convolve(_depth_wise, receivers, features.shape[1], kernel, features, field)


def mc_conv_mixing(
    kernel: Kernel,
    features: Float[Array, "N C"],
    field: Field,
    receivers: int,
    outputs: int,
) -> Float[Array, "M K"]:
    """Full convolution: every output channel has a kernel for every input channel."""
    return _convolve(_mixing, receivers, outputs, kernel, features, field)


def _depth_wise(
    kernel: Kernel,
    outputs: int,
    features: Float[Array, "T C"],
    inputs: Float[Array, "D T"],
    weight: Float[Array, "T"],
) -> Float[Array, "T C"]:
    """What every edge of a tile adds to its receiver."""
    return evaluate_kernel(kernel, inputs, outputs) * features * weight[:, None]


def _mixing(
    kernel: Kernel,
    outputs: int,
    features: Float[Array, "T C"],
    inputs: Float[Array, "D T"],
    weight: Float[Array, "T"],
) -> Float[Array, "T K"]:
    """What every edge of a tile adds to its receiver, every channel from all."""
    values = evaluate_kernel(kernel, inputs, outputs * features.shape[1])
    values = values.reshape(-1, outputs, features.shape[1])
    return jnp.sum(values * features[:, None], axis=-1) * weight[:, None]


class _Tile(NamedTuple):
    """Consecutive edges; at the end of a list, those of the tile before have no end."""

    start: Int[Array, ""]
    sender: Int[Array, "T"]
    receiver: Int[Array, "T"]
    inputs: Float[Array, "D T"]
    weight: Float[Array, "T"]


def _tile_size(edges: int) -> int:
    """Edges of a tile: everything at once where there is no cache to fit."""
    return min(TILE, edges) if jax.default_backend() == "cpu" else edges


def _tile_count(edges: int, count: Int[Array, ""]) -> Int[Array, ""]:
    """Tiles with real edges."""
    size = _tile_size(edges)
    return (jnp.minimum(count, edges) + size - 1) // size


def _take_tile(field: Field, number: Int[Array, ""]) -> _Tile:
    size = _tile_size(field.sender.shape[0])
    start = jnp.minimum(number * size, field.sender.shape[0] - size)
    fresh = start + jnp.arange(size, dtype=jnp.int32) >= number * size
    sender, receiver, inputs, weight = (
        jax.lax.dynamic_slice_in_dim(a, start, size, axis=-1) for a in field[:4]
    )
    nowhere = jnp.int32(2**31 - 1)
    return _Tile(start, sender, jnp.where(fresh, receiver, nowhere), inputs, weight)


def _over_tiles(field: Field, body: Any, start: Any) -> Any:
    """`body(tile, carry)` for every tile with real edges."""
    tiles = _tile_count(field.sender.shape[0], field.count)
    return jax.lax.fori_loop(
        0, tiles, lambda i, carry: body(_take_tile(field, i), carry), start
    )


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def _convolve(
    combine: Any,
    receivers: int,
    outputs: int,
    kernel: Kernel,
    features: Float[Array, "N C"],
    field: Field,
) -> Float[Array, "M K"]:
    """Sum of what `combine` makes of the edges of each receiver."""

    def add(tile: _Tile, total: Float[Array, "M K"]) -> Float[Array, "M K"]:
        given = features[tile.sender]
        values = combine(kernel, outputs, given, tile.inputs, tile.weight)
        return total.at[tile.receiver].add(values, mode="drop")

    return _over_tiles(field, add, jnp.zeros((receivers, outputs), features.dtype))


def _convolve_forward(
    combine: Any, receivers: int, outputs: int, *inputs: Any
) -> tuple[Float[Array, "M K"], Any]:
    return _convolve(combine, receivers, outputs, *inputs), inputs


def _convolve_backward(
    combine: Any,
    receivers: int,
    outputs: int,
    inputs: tuple[Kernel, Float[Array, "N C"], Field],
    cotangent: Float[Array, "M K"],
) -> tuple[Kernel, Float[Array, "N C"], Field]:
    """Cotangents of kernel, features, kernel inputs and weights, tile by tile."""
    kernel, features, field = inputs

    def add(tile: _Tile, total: Any) -> Any:
        d_kernel, d_features, d_inputs, d_weight = total
        received = cotangent[jnp.minimum(tile.receiver, receivers - 1)]
        received = jnp.where((tile.receiver < receivers)[:, None], received, 0.0)
        _, pull = jax.vjp(
            lambda k, f, x, w: combine(k, outputs, f, x, w),
            *(kernel, features[tile.sender], tile.inputs, tile.weight),
        )
        k, f, x, w = pull(received)
        return (
            jax.tree.map(jnp.add, d_kernel, k),
            d_features.at[tile.sender].add(f),
            _add_slice(d_inputs, x, tile.start),
            _add_slice(d_weight, w, tile.start),
        )

    zeros = jax.tree.map(jnp.zeros_like, (kernel, features, field.inputs, field.weight))
    k, f, x, w = _over_tiles(field, add, zeros)
    return k, f, Field(None, None, x, w, None)  # type: ignore[arg-type]


def _add_slice(
    total: Float[Array, "... E"], part: Float[Array, "... T"], start: Int[Array, ""]
) -> Float[Array, "... E"]:
    """`total` with `part` added to the columns from `start` on."""
    old = jax.lax.dynamic_slice_in_dim(total, start, part.shape[-1], axis=-1)
    return jax.lax.dynamic_update_slice_in_dim(total, old + part, start, axis=-1)


_convolve.defvjp(_convolve_forward, _convolve_backward)

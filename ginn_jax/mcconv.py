"""Monte Carlo convolution (paper, appendix).

The convolution of features f with a learned kernel g at a receiver x is

    (f * g)(x) = 1/|N(x)| sum_j f(y_j) g((x - y_j) / r) / p(y_j | x)

over the senders y_j closer than r. The density p is itself an average over N(x), so
|N(x)| cancels and each sender carries a weight w_j (`receptive_field`):

    (f * g)(x) = sum_j w_j f(y_j) g((x - y_j) / r)

Edges are taken tile by tile; the gradient takes the same tiles again and keeps nothing.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ginn_jax.kernels import (
    Kernel,
    check_kernel,
    edges_first,
    edges_first_to_differentiate,
    evaluate_kernel,
)
from ginn_jax.ranges import over_tiles
from ginn_jax.receptive_field import Field, tile_size


def mc_conv(
    kernel: Kernel, features: Float[Array, "N C"], field: Field, receivers: int
) -> Float[Array, "M C"]:
    """Depth-wise convolution: channel c of the output sees channel c of the input.

    Raises `InputError` for a kernel made for other inputs or another width.
    """
    width = features.shape[1]
    check_kernel(kernel, field.inputs.shape[0], width)
    return _convolve(_depth_wise, receivers, width, kernel, features, field)


def mc_conv_mixing(
    kernel: Kernel,
    features: Float[Array, "N C"],
    field: Field,
    receivers: int,
    outputs: int,
) -> Float[Array, "M K"]:
    """Full convolution: every output channel has a kernel for every input channel.

    Raises `InputError` for a kernel made for other inputs or another width.
    """
    check_kernel(kernel, field.inputs.shape[0], outputs * features.shape[1])
    return _convolve(_mixing, receivers, outputs, kernel, features, field)


def stored_kernel(kernel: Kernel, field: Field) -> Float[Array, "E K"]:
    """Weighted kernel values of every edge, for `apply_stored`."""
    outputs = kernel.w1.shape[0] * kernel.w3.shape[2]
    values = evaluate_kernel(kernel, field.inputs, outputs)
    return (values * field.weight).T


def apply_stored(
    stored: Float[Array, "E K"],
    features: Float[Array, "N C"],
    field: Field,
    receivers: int,
) -> Float[Array, "M C"]:
    """`mc_conv` with kernel values at hand, in the order that they are taken in.

    Has no gradient.
    """
    bare = field._replace(inputs=field.inputs[:0])

    def add(tile: _Tile, total: Float[Array, "M C"]) -> Float[Array, "M C"]:
        size = tile.sender.shape[0]
        values = jax.lax.dynamic_slice_in_dim(stored, tile.start, size)
        values = values[:, : features.shape[1]] * features[tile.sender]
        return total.at[tile.receiver].add(values, mode="drop")

    shape = receivers, features.shape[1]
    return _over_tiles(bare, add, jnp.zeros(shape, features.dtype))


def weighted_sum(
    weights: Float[Array, "#C E"],
    features: Float[Array, "N C"],
    field: Field,
    receivers: int,
) -> Float[Array, "M C"]:
    """Sum over the edges of every receiver, each feature by weights of its own or all
    by the same."""
    given = field._replace(inputs=weights)
    return _convolve(_weighted, receivers, features.shape[1], None, features, given)


def _weighted(
    evaluate: Any,
    kernel: None,
    outputs: int,
    features: Float[Array, "T C"],
    inputs: Float[Array, "#C T"],
    weight: Float[Array, "T"],
) -> Float[Array, "T C"]:
    # Turned once for all colours; in the product every one of them would turn it.
    return features * jax.lax.optimization_barrier(inputs.T)


def _depth_wise(
    evaluate: Any,
    kernel: Kernel,
    outputs: int,
    features: Float[Array, "T C"],
    inputs: Float[Array, "D T"],
    weight: Float[Array, "T"],
) -> Float[Array, "T C"]:
    """What every edge of a tile adds to its receiver."""
    return evaluate(kernel, inputs, outputs) * features * weight[:, None]


def _mixing(
    evaluate: Any,
    kernel: Kernel,
    outputs: int,
    features: Float[Array, "T C"],
    inputs: Float[Array, "D T"],
    weight: Float[Array, "T"],
) -> Float[Array, "T K"]:
    """What every edge of a tile adds to its receiver, every channel from all."""
    values = evaluate(kernel, inputs, outputs * features.shape[1])
    values = values.reshape(-1, outputs, features.shape[1])
    return jnp.sum(values * features[:, None], axis=-1) * weight[:, None]


class _Tile(NamedTuple):
    """Consecutive edges; at the end of a list, those of the tile before have no end."""

    start: Int[Array, ""]
    sender: Int[Array, "T"]
    receiver: Int[Array, "T"]
    inputs: Float[Array, "D T"]
    weight: Float[Array, "T"]


def _take_tile(field: Field, number: Int[Array, ""]) -> _Tile:
    size = tile_size(field.sender.shape[0])
    start = jnp.minimum(number * size, field.sender.shape[0] - size)
    fresh = start + jnp.arange(size, dtype=jnp.int32) >= number * size
    sender, receiver, inputs, weight = (
        jax.lax.dynamic_slice_in_dim(a, start, size, axis=-1) for a in field[:4]
    )
    nowhere = jnp.int32(2**31 - 1)
    return _Tile(start, sender, jnp.where(fresh, receiver, nowhere), inputs, weight)


def _over_tiles(field: Field, body: Any, start: Any) -> Any:
    """`body(tile, carry)` for every tile with real edges."""
    edges = field.sender.shape[0]

    def take(number: Int[Array, ""], state: Any) -> Any:
        return body(_take_tile(field, number), state)

    return over_tiles(take, field.count, edges, tile_size(edges), start)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def _convolve(
    combine: Any,
    receivers: int,
    outputs: int,
    kernel: Kernel | None,
    features: Float[Array, "N C"],
    field: Field,
) -> Float[Array, "M K"]:
    """Sum of what `combine` makes of the edges of each receiver."""

    def add(tile: _Tile, total: Float[Array, "M K"]) -> Float[Array, "M K"]:
        given = features[tile.sender]
        edges = given, tile.inputs, tile.weight
        values = combine(edges_first, kernel, outputs, *edges)
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
    inputs: tuple[Kernel | None, Float[Array, "N C"], Field],
    cotangent: Float[Array, "M K"],
) -> tuple[Kernel | None, Float[Array, "N C"], Field]:
    """Cotangents of kernel, features, kernel inputs and weights, tile by tile."""
    kernel, features, field = inputs

    def add(tile: _Tile, total: Any) -> Any:
        d_kernel, d_features, d_inputs, d_weight = total
        received = cotangent[jnp.minimum(tile.receiver, receivers - 1)]
        received = jnp.where((tile.receiver < receivers)[:, None], received, 0.0)
        _, pull = jax.vjp(
            lambda k, *edges: combine(edges_first_to_differentiate, k, outputs, *edges),
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

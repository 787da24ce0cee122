"""The paper's density of senders, over every pair of neighbours of every receiver.

The pairs are never listed: an edge's neighbours are the edges of the same receiver,
which stand side by side, and a tile of edges meets them in turn. On a GPU, where each
turn is waited for, take areas (`receptive_field`), which need no pairs.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ginn_jax.packets import Edges
from ginn_jax.ranges import over_tiles
from ginn_jax.receptive_field import tile_size

Columns = Sequence[Float[Array, "T"]]


class Spans(NamedTuple):
    """The edges of the same receiver, for each of the first `count` edges."""

    begin: Int[Array, "E"]
    length: Int[Array, "E"]
    count: Int[Array, ""]


def kde_weight(
    senders: Float[Array, "N 3"],
    edges: Edges,
    receivers: int,
    radius: Float[Array, ""],
    bandwidth: float,
) -> Float[Array, "E"]:
    """The paper's weight of each edge (appendix), for receptive fields of that radius.

    Gaussian kernel density of width h r in units where r = 1, evaluated at the sender
    over all senders of the same receiver, itself included.
    """
    first = jnp.searchsorted(edges.receiver, jnp.arange(receivers + 1))
    first = first.astype(jnp.int32)
    real = edges.receiver < receivers
    receiver = jnp.where(real, edges.receiver, 0)
    begin = first[receiver]
    length = jnp.where(real, first[receiver + 1] - begin, 0)
    place = senders[edges.sender].T
    spans = Spans(begin, length, edges.demand.edges)
    constant = (0.5 / jnp.pi) ** 1.5 / bandwidth**3
    density = constant * _gaussian_sums(place, 1 / (radius * bandwidth), spans)
    return jnp.where(real, 1 / jnp.where(real, density, 1.0), 0.0)


@jax.custom_vjp
def _gaussian_sums(
    place: Float[Array, "3 E"], scale: Float[Array, ""], spans: Spans
) -> Float[Array, "E"]:
    """Sum over a span of exp(-(s d)^2 / 2), d being distances and s the scale."""

    def add(mine: Columns, other: Columns) -> Columns:
        return [jnp.exp(-0.5 * scale**2 * _squared(mine, other))]

    return _over_pairs(add, place, spans, 1)[0]


def _sums_forward(
    place: Float[Array, "3 E"], scale: Float[Array, ""], spans: Spans
) -> tuple[Float[Array, "E"], tuple[Any, ...]]:
    return _gaussian_sums(place, scale, spans), (place, scale, spans)


def _sums_backward(
    given: tuple[Any, ...], cotangent: Float[Array, "E"]
) -> tuple[Float[Array, "3 E"], Float[Array, ""], None]:
    """Cotangents of places and scale.

    Each edge is its neighbours' neighbour, so both ends' cotangents meet at each pair
    and nothing has to be scattered.
    """
    place, scale, spans = given

    def add(mine: Columns, other: Columns) -> Columns:
        squared = _squared(mine[:3], other[:3])
        value = jnp.exp(-0.5 * scale**2 * squared)
        both = -(scale**2) * (mine[3] + other[3]) * value
        moved = [both * (a - b) for a, b in zip(mine[:3], other[:3], strict=True)]
        return [*moved, -scale * squared * mine[3] * value]

    columns = jnp.concatenate([place, cotangent[None]])
    *moved, scaled = _over_pairs(add, columns, spans, 4)
    return jnp.stack(moved), jnp.sum(scaled), None


_gaussian_sums.defvjp(_sums_forward, _sums_backward)


def _squared(mine: Columns, other: Columns) -> Float[Array, "T"]:
    x, y, z = (a - b for a, b in zip(mine, other, strict=True))
    return x * x + y * y + z * z


def _over_pairs(
    add: Callable[[Columns, Columns], Columns],
    columns: Float[Array, "C E"],
    spans: Spans,
    sums: int,
) -> Float[Array, "K E"]:
    """Sums over the span of each edge of what `add(edge, other)` says of the columns.

    A tile takes as many turns as its longest span.
    """
    edges = columns.shape[1]
    size = tile_size(edges)

    def fill(number: Int[Array, ""], found: Float[Array, "K E"]) -> Array:
        start = jnp.minimum(number * size, edges - size)
        begin, length, *mine = (
            jax.lax.dynamic_slice_in_dim(a, start, size)
            for a in (spans.begin, spans.length, *columns)
        )

        def turn(number: Int[Array, ""], total: Columns) -> Columns:
            near = number < length
            row = jnp.where(near, begin + number, 0)
            values = add(mine, [column[row] for column in columns])
            pairs = zip(total, values, strict=True)
            return [t + jnp.where(near, value, 0.0) for t, value in pairs]

        nothing = [jnp.zeros(size, columns.dtype)] * sums
        some = jax.lax.fori_loop(0, jnp.max(length), turn, nothing)
        return jax.lax.dynamic_update_slice_in_dim(found, jnp.stack(some), start, 1)

    nothing = jnp.zeros((sums, edges), columns.dtype)
    return over_tiles(fill, spans.count, edges, size, nothing)

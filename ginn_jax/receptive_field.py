"""Receptive fields: what every edge shows a kernel, and what its sender weighs.

A sender's weight is what remains of the density of the Monte Carlo estimate (paper,
appendix; `mcconv` has the sum). No parameter enters it:

    kde      w_j = 1 / sum_{k in N(x)} G((y_k - y_j) / (h r)), the paper's, for every
             pair of neighbours of every receiver: O(|N|^2), see `density`
    surface  w_j = A_j / (pi r^2), where A_j is the area that sender j stands for, once
             for every sender: O(|N|), and unmoved by a change of sampling density

On CPU edges are taken in tiles that fit a core's cache, as many as hold real edges:
padding costs memory, not time.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ginn_jax.hierarchy import squared_lengths
from ginn_jax.packets import Edges
from ginn_jax.process import on_cpu
from ginn_jax.ranges import over_tiles
from ginn_jax.voxels import morton_order

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


class Oriented(NamedTuple):
    """Points with unit normals, some of them padding."""

    position: Float[Any, "N 3"]
    normal: Float[Any, "N 3"]
    mask: Bool[Any, "N"]


def in_coherent_order(points: Oriented) -> tuple[Oriented, Int[Array, "N"]]:
    """The points as searches like them, neighbours together, and their old rows."""
    order = morton_order(points.position, points.mask)
    return jax.tree.map(lambda a: a[order], points), order


def tile_size(edges: int) -> int:
    """Edges of a tile: everything at once where there is no cache to fit.

    Tiles share the edges out evenly. Their size is an odd multiple of 16: of a power of
    two, all rows of a tile would compete for the same few lines of the cache.
    """
    if not on_cpu():
        return edges
    tiles = -(-edges // TILE)
    return min(-(-edges // (16 * max(tiles, 1))) * 16 | 16, edges)


def input_count(oriented: bool) -> int:
    """How many numbers `kernel_inputs` has of an edge."""
    return 7 if oriented else 3


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
    rows = jnp.where(real, edges.receiver, 0), edges.sender
    ends = map(_both, (receivers, senders))
    return _inputs_in_tiles(oriented, *ends, radius, *rows, edges.demand.edges)


def _both(points: Oriented) -> Float[Array, "N 6"]:
    """Positions and normals, zero where masked: what is there has no gradient."""
    both = jnp.concatenate([points.position, points.normal], axis=1)
    return jnp.where(points.mask[:, None], both, 0.0)


def pair_inputs(oriented: bool, x: Any, y: Any, radius: Any) -> list[Any]:
    """`kernel_inputs` of receivers x and senders y: six rows each, of edges or lanes,
    position above normal.

    Row by row, sums written out: XLA takes three times as long over whole arrays.
    """
    offset = [(a - b) / radius for a, b in zip(x[:3], y[:3], strict=True)]
    if not oriented:
        return offset
    pairs = (x[3:], offset), (y[3:], offset), (x[3:], y[3:]), (offset, offset)
    return offset + [a[0] * b[0] + a[1] * b[1] + a[2] * b[2] for a, b in pairs]


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _inputs_in_tiles(
    oriented: bool,
    receivers: Float[Array, "M 6"],
    senders: Float[Array, "N 6"],
    radius: Float[Array, ""],
    receiver: Int[Array, "E"],
    sender: Int[Array, "E"],
    count: Int[Array, ""],
) -> Float[Array, "D E"]:
    """Kernel inputs of the first `count` edges, 0 for the others, tile by tile.

    A loop of its own, so that XLA does not gather anew for each use of the result.
    """
    edges = receiver.shape[0]
    size = tile_size(edges)

    def fill(number: Int[Array, ""], inputs: Float[Array, "D E"]) -> Array:
        start = jnp.minimum(number * size, edges - size)
        x, y = (
            jax.lax.optimization_barrier(
                table[jax.lax.dynamic_slice_in_dim(rows, start, size)]
            ).T
            for table, rows in ((receivers, receiver), (senders, sender))
        )
        real = start + jnp.arange(size, dtype=jnp.int32) < count
        rows = [jnp.where(real, a, 0.0) for a in pair_inputs(oriented, x, y, radius)]
        some = jnp.stack(rows)
        return jax.lax.dynamic_update_slice_in_dim(inputs, some, start, axis=1)

    nothing = jnp.zeros((input_count(oriented), edges), senders.dtype)
    return over_tiles(fill, count, edges, size, nothing)


def _inputs_forward(
    oriented: bool, *arrays: Any
) -> tuple[Float[Array, "D E"], tuple[Any, ...]]:
    return _inputs_in_tiles(oriented, *arrays), arrays


def _inputs_backward(
    oriented: bool, arrays: tuple[Any, ...], cotangent: Float[Array, "D E"]
) -> tuple[Array | None, ...]:
    """Cotangents of both ends and the radius, all edges at once."""
    *ends, receiver, sender, count = arrays
    real = jnp.arange(receiver.shape[0], dtype=jnp.int32) < count

    def plainly(x: Array, y: Array, radius: Array) -> Float[Array, "D E"]:
        return jnp.stack(pair_inputs(oriented, x[receiver].T, y[sender].T, radius))

    _, pull = jax.vjp(plainly, *ends)
    return *pull(jnp.where(real, cotangent, 0.0)), None, None, None


_inputs_in_tiles.defvjp(_inputs_forward, _inputs_backward)


def point_area(
    position: Float[Array, "N 3"],
    mask: Bool[Array, "N"],
    edges: Edges,
    radius: Float[Array, ""],
    counted: Bool[Array, "E"] | None = None,
) -> Float[Array, "N"]:
    """Area each point stands for, from the edges of the cloud with itself.

    The inverse of a density by the quartic kernel (1 - d^2 / r^2)^2, whose integral
    over a flat surface is pi r^2 / 3. The density is of the edges that are `counted`
    and no longer than the radius.
    """
    position = jnp.where(mask[:, None], position, 0.0)
    value = jnp.maximum(1 - squared_lengths(position, edges) / radius**2, 0.0) ** 2
    real = edges.receiver < position.shape[0]
    real = real if counted is None else real & counted
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


def window(inputs: Float[Array, "D E"], taper: float) -> Float[Array, "E"]:
    """What edges count for in a field that tapers, by their offset o = (x - y) / r.

    1 up to |o|^2 = 1 - taper, 0 from 1 + taper on, linear in between: points that pass
    the border come and go by and by. In a plane it adds up to what a sharp border does.
    """
    x, y, z = inputs[:3]
    return jnp.clip((1 + taper - (x * x + y * y + z * z)) / (2 * taper), 0.0, 1.0)

"""Poisson disk sampling in parallel, and the levels it builds."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from ginn_jax.neighbors import bucket, find_neighbors
from ginn_jax.packets import Demand, EdgeLimit, Edges, radius_edges
from ginn_jax.ranges import compact
from ginn_jax.voxels import VoxelGrid

WAITING, DROPPED, KEPT = 1, 0, 2
# How near, in radii, points may come to each other that were all kept before.
HOLD = 0.6


class Level(NamedTuple):
    """Points at least `radius` apart; `index` are their rows one level finer."""

    position: Float[Array, "N 3"]
    normal: Float[Array, "N 3"]
    index: Int[Array, "N"]
    mask: Bool[Array, "N"]


def elect(
    sender: Int[Array, "E"],
    receiver: Int[Array, "E"],
    mask: Bool[Array, "N"],
    conflict: Bool[Array, "E"] | None = None,
) -> Bool[Array, "N"]:
    """Points that survive, given edges from each point's conflicting betters to it.

    `conflict` says which edges count; without it all do.

    A point is kept once all its betters are dropped and dropped once one is kept, so
    the outcome is that of sequential dart throwing in priority order, found in a number
    of rounds that is the length of the longest chain of waiting points. `sender` of
    padded edges is any row, `receiver` is N.
    """
    count = mask.shape[0]

    def settle(state: Int[Array, "N"]) -> Int[Array, "N"]:
        better = state[sender]
        if conflict is not None:
            better = jnp.where(conflict, better, DROPPED)
        best = jax.ops.segment_max(better, receiver, count, indices_are_sorted=True)
        settled = jnp.where(
            best == KEPT, DROPPED, jnp.where(best < WAITING, KEPT, WAITING)
        )
        return jnp.where(state == WAITING, settled, state)

    def waiting(state: Int[Array, "N"]) -> Bool[Array, ""]:
        return jnp.any(state == WAITING)

    start = jnp.where(mask, jnp.int32(WAITING), jnp.int32(DROPPED))
    return jax.lax.while_loop(waiting, settle, start) == KEPT


def sample_disk(
    grid: VoxelGrid,
    position: Float[Array, "N 3"],
    mask: Bool[Array, "N"],
    radius: Float[Array, ""],
    limit: EdgeLimit,
    lot: UInt32[Array, "N"],
    normal: Float[Array, "N 3"] | None = None,
    kept_before: Bool[Array, "N"] | None = None,
) -> tuple[Bool[Array, "N"], Demand]:
    """Maximal subset with pairwise distance >= radius, greedy in the order of lots.

    The parallel Poisson disk sampling of the paper's section "3D Step". `grid` holds
    the same points. Given normals, points that face away from each other may be nearer.
    If the demand exceeds the limit the subset is not valid.

    Of a cloud that moves, points `kept_before` come before all others and drop each
    other only where they are nearer than `HOLD` radii, so the subset changes little.
    """
    lot = thrown_first(lot, kept_before)
    edges = radius_edges(
        grid, position, mask, radius, limit, lambda s, r: beats(lot, s, r)
    )
    conflict = conflicts(position, radius, edges, normal, kept_before)
    return elect(edges.sender, edges.receiver, mask, conflict), edges.demand


def choose_among(
    edges: Edges,
    position: Float[Array, "N 3"],
    mask: Bool[Array, "N"],
    radius: Float[Array, ""],
    lot: UInt32[Array, "N"],
    normal: Float[Array, "N 3"] | None = None,
    kept_before: Bool[Array, "N"] | None = None,
) -> Bool[Array, "N"]:
    """`sample_disk` with all pairs of the cloud at hand that are as near, or nearly."""
    lot = thrown_first(lot, kept_before)
    conflict = squared_lengths(position, edges) < radius**2
    conflict &= beats(lot, *pair_rows(edges, mask.shape[0]))
    more = conflicts(position, radius, edges, normal, kept_before)
    conflict = conflict if more is None else conflict & more
    # Of the two edges of a pair one at most is a conflict: half the room will do.
    rows, real, _ = compact(conflict, (conflict.size + 1) // 2)
    receiver = jnp.where(real, edges.receiver[rows], mask.shape[0])
    return elect(edges.sender[rows], receiver, mask)


def thrown_first(
    lot: UInt32[Any, "N"], kept_before: Bool[Any, "N"] | None
) -> UInt32[Any, "N"]:
    """Lots with which points that were kept before come before all others."""
    if kept_before is None:
        return lot
    return lot >> 1 | (~kept_before).astype(np.uint32) << 31


def conflicts(
    position: Float[Array, "N 3"],
    radius: Float[Array, ""],
    edges: Edges,
    normal: Float[Array, "N 3"] | None,
    kept_before: Bool[Array, "N"] | None,
) -> Bool[Array, "E"] | None:
    """Which pairs within the radius may not both be kept; None: all of them."""
    conflict = None if normal is None else same_side(normal, edges)
    if kept_before is None:
        return conflict
    free = ~held(position, radius, kept_before, edges)
    return free if conflict is None else free & conflict


def held(
    position: Float[Array, "N 3"],
    radius: Float[Array, ""],
    kept_before: Bool[Array, "N"],
    edges: Edges,
) -> Bool[Array, "E"]:
    """Whether both ends of edges within a cloud were kept before and may still be."""
    sender, receiver = pair_rows(edges, kept_before.shape[0])
    apart = squared_lengths(position, edges) >= (HOLD * radius) ** 2
    return kept_before[sender] & kept_before[receiver] & apart


def pair_rows(edges: Edges, count: int) -> tuple[Int[Array, "E"], Int[Array, "E"]]:
    """Sender and receiver of edges within a cloud; padded ones get its last row."""
    return edges.sender, jnp.minimum(edges.receiver, count - 1)


def squared_lengths(position: Float[Array, "N 3"], edges: Edges) -> Float[Array, "E"]:
    """Of edges within a cloud."""
    sender, receiver = pair_rows(edges, position.shape[0])
    x, y, z = (axis[sender] - axis[receiver] for axis in position.T)
    return x * x + y * y + z * z


def same_side(normal: Float[Array, "N 3"], edges: Edges) -> Bool[Array, "E"]:
    """Whether the ends of edges within a cloud do not face away from each other."""
    sender, receiver = pair_rows(edges, normal.shape[0])
    x, y, z = (axis[sender] * axis[receiver] for axis in normal.T)
    return x + y + z >= 0


def draw_lots(count: int, *, key: Key[Array, ""]) -> UInt32[Array, "N"]:
    """The random order of dart throwing: smaller lots first, ties by index."""
    return jax.random.bits(key, (count,), jnp.uint32)


def beats(
    lot: UInt32[Any, "N"],
    first: Int[Any, "..."],
    second: Int[Any, "..."],
) -> Bool[Any, "..."]:
    """Whether point `first` is thrown before point `second`."""
    tie = (lot[first] == lot[second]) & (first < second)
    return (lot[first] < lot[second]) | tie


def build_level(
    kept: Bool[Array, "N"],
    position: Float[Array, "N 3"],
    normal: Float[Array, "N 3"],
    capacity: int,
) -> tuple[Level, Int[Array, ""]]:
    """The points kept, and how many; rows beyond them are zero and masked out."""
    index, real, points = compact(kept, capacity)
    level = Level(
        jnp.where(real[:, None], position[index], 0.0),
        jnp.where(real[:, None], normal[index], 0.0),
        index,
        real,
    )
    return level, points


def poisson_disk(
    points: Float[np.ndarray, "N 3"], radius: float, *, key: Key[Array, ""]
) -> Int[np.ndarray, "K"]:
    """Host-level Poisson disk sampling: ascending indices of the points kept.

    Distances are exact in float64 and no capacity is needed.

    Raises:
        InputError: points not [N, 3] or not finite, or a radius that is not positive.
    """
    receiver, sender = find_neighbors(points, points, radius)
    count = len(points)
    rows = bucket(count)
    # The first `count` lots are the same for any number; so few shapes are compiled.
    better = beats(np.asarray(draw_lots(rows, key=key)), sender, receiver)
    edges = bucket(int(better.sum()))
    padding = (0, edges - int(better.sum()))
    kept = _elect(
        np.pad(sender[better], padding),
        np.pad(receiver[better], padding, constant_values=rows),
        np.arange(rows) < count,
    )
    return np.flatnonzero(kept).astype(np.int32)


_elect = jax.jit(elect)

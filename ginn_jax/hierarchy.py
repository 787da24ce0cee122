"""Poisson disk sampling in parallel, and the levels it builds."""

from dataclasses import dataclass
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


@dataclass(frozen=True)
class LevelLimit:
    """Capacities of one Poisson disk step: its search and the points it keeps."""

    search: EdgeLimit
    points: int


class LevelDemand(NamedTuple):
    """What one Poisson disk step needed."""

    search: Demand
    points: Int[Array, ""]


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
    if kept_before is not None:
        lot = lot >> 1 | jnp.where(kept_before, jnp.uint32(0), jnp.uint32(1 << 31))
    edges = radius_edges(
        grid, position, mask, radius, limit, lambda s, r: beats(lot, s, r)
    )
    conflict = None if normal is None else same_side(normal, edges)
    if kept_before is not None:
        free = ~held(position, radius, kept_before, edges)
        conflict = free if conflict is None else free & conflict
    return elect(edges.sender, edges.receiver, mask, conflict), edges.demand


def held(
    position: Float[Array, "N 3"],
    radius: Float[Array, ""],
    kept_before: Bool[Array, "N"],
    edges: Edges,
) -> Bool[Array, "E"]:
    """Whether both ends of edges within a cloud were kept before and may still be."""
    ends = jnp.minimum(edges.receiver, kept_before.shape[0] - 1)
    offset = (axis[edges.sender] - axis[ends] for axis in position.T)
    apart = sum(a**2 for a in offset) >= (HOLD * radius) ** 2
    return kept_before[edges.sender] & kept_before[ends] & apart


def same_side(normal: Float[Array, "N 3"], edges: Edges) -> Bool[Array, "E"]:
    """Whether the ends of edges within a cloud do not face away from each other."""
    ends = jnp.minimum(edges.receiver, normal.shape[0] - 1)
    x, y, z = (axis[edges.sender] * axis[ends] for axis in normal.T)
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
    grid: VoxelGrid,
    position: Float[Array, "N 3"],
    normal: Float[Array, "N 3"],
    mask: Bool[Array, "N"],
    radius: Float[Array, ""],
    limit: LevelLimit,
    lot: UInt32[Array, "N"],
    sided: bool = False,
    kept_before: Bool[Array, "N"] | None = None,
) -> tuple[Level, LevelDemand]:
    """One Poisson disk step; rows beyond the kept ones are zero and masked out.

    With `sided`, points that face away from each other may be nearer than `radius`.
    """
    more = lot, normal if sided else None, kept_before
    kept, search = sample_disk(grid, position, mask, radius, limit.search, *more)
    index, real, points = compact(kept, limit.points)
    level = Level(
        jnp.where(real[:, None], position[index], 0.0),
        jnp.where(real[:, None], normal[index], 0.0),
        index,
        real,
    )
    return level, LevelDemand(search, points)


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

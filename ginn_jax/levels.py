"""The levels of a cloud: its Poisson disks, each of the points that the last one kept.

Points go by name, the rows that they had before the cloud was sorted. Lots go by name
too, so that points which move keep their turn; and from one frame of an animation to
the next the points that were kept are kept again where they can be. What levels do not
change does not flicker.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from ginn_jax.architecture import Network
from ginn_jax.hierarchy import Level, build_level, choose_among, draw_lots, sample_disk
from ginn_jax.limits import Demands, Limits
from ginn_jax.packets import Edges
from ginn_jax.receptive_field import Oriented
from ginn_jax.searches import search, search_demands, search_limit, shared_search
from ginn_jax.voxels import VoxelGrid, build_grid


class Levels(NamedTuple):
    """The hierarchy, finest first: its points, and which they are.

    `rows` are those of each level's points one level finer, the cloud's for the finest;
    `kept` are the names of the points of each.
    """

    points: tuple[Oriented, ...]
    rows: tuple[Int[Array, "_"], ...]
    kept: Bool[Array, "L N"]


class Found(NamedTuple):
    """Grids by level (-1: the cloud) and edges by convolution, as far as searched."""

    grids: dict[int, VoxelGrid]
    edges: dict[str, Edges]


def build_levels(
    network: Network,
    limits: Limits,
    cloud: Oriented,
    names: Int[Array, "N"] | None = None,
    kept_before: Bool[Array, "L N"] | None = None,
    *,
    key: Key[Array, ""],
) -> tuple[Levels, Found, Demands]:
    """The Poisson disk hierarchy of a cloud, and the searches that found it.

    `names` are the rows that the points had before they were sorted, `kept_before` the
    names of those that levels kept when the points lay elsewhere (see `sample_disk`).
    """
    count = cloud.mask.shape[0]
    names = jnp.arange(count, dtype=jnp.int32) if names is None else names
    found, demands = Found({}, {}), {}
    levels: list[Level] = []
    kept: list[Bool[Array, "N"]] = []
    points = cloud
    for i in range(len(network.levels)):
        lots = draw_lots(count, key=jax.random.fold_in(key, i))[names]
        before = None if kept_before is None else kept_before[i][names]
        chosen, more = _choose(network, limits, found, i, points, lots, before)
        room = f"level_{i}.points"
        ends = points.position, points.normal
        level, needed = build_level(chosen, *ends, limits.of(room))
        names = names[level.index]
        demands |= more | {room: needed}
        levels.append(level)
        kept.append(_named(names, level.mask, count))
        points = Oriented(level.position, level.normal, level.mask)
    ends = tuple(Oriented(lv.position, lv.normal, lv.mask) for lv in levels)
    rows = tuple(level.index for level in levels)
    return Levels(ends, rows, jnp.stack(kept)), found, demands


def _choose(
    network: Network,
    limits: Limits,
    found: Found,
    level: int,
    points: Oriented,
    lots: UInt32[Array, "N"],
    before: Bool[Array, "N"] | None,
) -> tuple[Bool[Array, "N"], Demands]:
    """Which points of the level before are kept in this one.

    Where a convolution within the level before reaches as far its edges will do.
    """
    grid = grid_of(network, found.grids, level - 1, points)
    position, normal, mask = points
    radius = jnp.float32(network.levels[level])
    more = lots, normal if network.sided else None, before
    conv = shared_search(network, level)
    if conv is None:
        name = f"level_{level}"
        limit = search_limit(limits, name)
        kept, demand = sample_disk(grid, position, mask, radius, limit, *more)
        return kept, search_demands(name, demand)
    edges, demands = search(conv, limits, grid, points, taper=network.taper)
    found.edges[conv.name] = edges
    return choose_among(edges, position, mask, radius, *more), demands


def _named(
    names: Int[Array, "K"], mask: Bool[Array, "K"], count: int
) -> Bool[Array, "N"]:
    """Which of so many names are real ones of these."""
    named = jnp.where(mask, names, count)
    return jnp.zeros(count, bool).at[named].set(True, mode="drop")


def grid_of(
    network: Network, grids: dict[int, VoxelGrid], level: int, points: Oriented
) -> VoxelGrid:
    """The grid of a level (-1: the cloud), built when first asked for."""
    if level not in grids:
        radii = [
            c.radius for c in (*network.encoder, network.query) if c.source == level
        ]
        cell = min(radii, default=2 * network.levels[0])
        grids[level] = build_grid(points.position, points.mask, jnp.float32(cell))
    return grids[level]


def with_normals(
    levels: Sequence[Oriented],
    normal: Float[Array, "N 3"],
    rows: Sequence[Int[Array, "_"]],
) -> tuple[Oriented, ...]:
    """The levels with these normals of the finest one; `rows` as in `Levels`."""
    turned = [levels[0]._replace(normal=normal)]
    for level, index in zip(levels[1:], rows[1:], strict=True):
        found = jnp.where(level.mask[:, None], turned[-1].normal[index], 0.0)
        turned.append(level._replace(normal=found))
    return tuple(turned)

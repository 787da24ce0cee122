"""One Poisson disk step with its capacities and what it needed, as levels take it."""

from typing import Any, NamedTuple

from ginn_jax import hierarchy
from ginn_jax.packets import Demand, EdgeLimit


class Room(NamedTuple):
    """Capacities of a search and of the points kept; hashable, for jit."""

    search: EdgeLimit
    points: int


class Need(NamedTuple):
    """What a step needed."""

    search: Demand
    points: Any


def build_level(grid, position, normal, mask, radius, room, lots, sided=False):
    """The level and what it needed."""
    sides = normal if sided else None
    given = grid, position, mask, radius, room.search, lots, sides
    kept, search = hierarchy.sample_disk(*given)
    level, points = hierarchy.build_level(kept, position, normal, room.points)
    return level, Need(search, points)

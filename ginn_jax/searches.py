"""Which searches a network makes, and the names of their capacities."""

import jax.numpy as jnp

from ginn_jax.architecture import QUERY, Conv, Network, reach
from ginn_jax.candidates import PACKET
from ginn_jax.errors import warn
from ginn_jax.limits import Demands, Limits
from ginn_jax.packets import Demand, EdgeLimit, Edges, radius_edges
from ginn_jax.receptive_field import Oriented
from ginn_jax.voxels import VoxelGrid


def search(
    conv: Conv,
    limits: Limits,
    grid: VoxelGrid,
    receivers: Oriented,
    packet: int = PACKET,
    taper: float = 0.0,
) -> tuple[Edges, Demands]:
    """Edges of one convolution and their demands; `grid` holds the senders.

    Fields that taper reach further, see `window`.
    """
    radius = jnp.float32(reach(conv.radius, taper))
    ends = grid, receivers.position, receivers.mask, radius
    edges = radius_edges(*ends, search_limit(limits, conv.name), packet=packet)
    return edges, search_demands(conv.name, edges.demand)


def search_names(name: str) -> list[str]:
    """The names of the capacities of one search, in the order of `Demand`."""
    return [f"{name}.{part}" for part in Demand._fields]


def search_limit(limits: Limits, name: str) -> EdgeLimit:
    """The capacities of the search of that name."""
    return EdgeLimit(*map(limits.of, search_names(name)))


def search_demands(name: str, demand: Demand) -> Demands:
    """What that search needed, under the names of its capacities."""
    return dict(zip(search_names(name), demand, strict=True))


def limit_names(network: Network) -> tuple[str, ...]:
    """The name of every capacity of a network, as its searches build on each other."""
    names: list[str] = []
    shared = [shared_search(network, i) for i in range(len(network.levels))]
    for i, conv in enumerate(shared):
        names += search_names(f"level_{i}" if conv is None else conv.name)
        names.append(f"level_{i}.points")
    own = [c for c in network.encoder if not (c in shared or transposed(network, c))]
    more = [area_search(network)] if needs_areas(network) else []
    for conv in (*facet_searches(network), *own, *more, network.query):
        names += search_names(conv.name)
    return tuple(names)


def check_limits(network: Network, limits: Limits) -> None:
    """Raise `InputError` unless these are limits of that network."""
    for name in limit_names(network):
        limits.of(name)


def shared_search(network: Network, level: int) -> Conv | None:
    """The convolution whose edges tell the Poisson disks of a level as well, if any:
    that within the level before, where it reaches as far."""
    for conv in network.encoder:
        within = conv.source == conv.target == level - 1
        if within and reach(conv.radius, network.taper) >= network.levels[level]:
            return conv
    return None


def needs_areas(network: Network) -> bool:
    """Whether no convolution's edges tell the area that finest points stand for."""
    within = any(c.source == c.target == 0 for c in network.encoder)
    return network.density == "surface" and not within


def area_search(network: Network) -> Conv:
    """The search that tells it then, as wide as a convolution's would be."""
    return Conv("area", 0, 0, 2.5 * network.levels[0], 0.25, 1)


def facet_searches(network: Network) -> tuple[Conv, ...]:
    """The searches for the samples around finest points and around queries, if any.

    The latter is f_2D's, by the beginning of its name.
    """
    if not network.smooth:
        return ()
    ends = (0, "facets"), (QUERY, f"{network.query.name}.facets")
    return tuple(Conv(name, 0, end, network.smooth, 0.25, 1) for end, name in ends)


def uniform_limits(network: Network, size: int) -> Limits:
    """The same capacity for everything (a word is worth many): to start measuring."""
    return Limits(
        tuple(
            (name, max(size // 64, 64) if name.endswith(".words") else size)
            for name in limit_names(network)
        )
    )


def transposed(network: Network, conv: Conv) -> str | None:
    """The later convolution over the same pairs in the other direction, if any.

    The paper's density needs edges sorted by receiver, so there each is searched.
    """
    if network.density == "kde":
        return None
    for other in network.encoder[network.encoder.index(conv) + 1 :]:
        ends = (other.target, other.source, other.radius)
        if (
            ends == (conv.source, conv.target, conv.radius)
            and other.source != other.target
        ):
            return other.name
    return None


def warn_of_gaps(conv: Conv, pairs: int, queries: int) -> None:
    """Warn where queries have hardly a point of the cloud but, maybe, themselves."""
    if pairs < 1.5 * queries:
        warn(
            f"within {conv.radius:g} of a query lie {pairs / queries:.2g} points of "
            "the cloud on average: fit the object into the unit box "
            "(mesh.fit_unit_box, samples.fit_unit_box_points), or give more samples"
        )

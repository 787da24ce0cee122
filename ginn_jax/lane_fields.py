"""Sums over the points around, in lanes: convolutions, areas, smoothed facets."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ginn_jax.architecture import Network, reach
from ginn_jax.cells import in_line
from ginn_jax.errors import InputError
from ginn_jax.facets import OWN, Around
from ginn_jax.lane_layers import dot, perceptron
from ginn_jax.lane_loops import for_each_around, for_each_near
from ginn_jax.lanes import (
    Lane,
    Lanes,
    Sorted,
    Table,
    program,
    read_record,
    side_by_side,
    sort_points,
    table_in,
    table_of,
)
from ginn_jax.process import LOG, on_cpu
from ginn_jax.receptive_field import Oriented, pair_inputs
from ginn_jax.renderer import use_drjit

# Multiplications that Dr.Jit still compiles in seconds.
LONGEST = 1 << 14


@functools.cache
def lanes_usable() -> bool:
    """Whether JAX runs on a CPU here and Dr.Jit finds a libLLVM."""
    if not on_cpu():
        return False
    try:
        use_drjit()
    except InputError as error:
        LOG.warning(
            "networks run in JAX alone, for two to three times as long: %s", error
        )
        return False
    return True


def simple_enough(network: Network, products: int) -> bool:
    """Whether parts of that network with programs so long run in lanes here: neither
    the paper's density for each pair nor batch norms do."""
    simple = network.density == "surface" and network.norm != "batch"
    return simple and products <= LONGEST and lanes_usable()


def edge_products(network: Network, width: int, colours: int) -> int:
    """About how many multiplications an edge takes: each weight stands in a program."""
    group = network.group or width
    kernels = -(-width // group)
    return kernels * network.hidden * (7 + network.hidden + group) + colours * width


def safe_inverses(scale: Float[np.ndarray, "C"]) -> Float[np.ndarray, "C"]:
    """`dataset.safe_inverse` of every unit."""
    normal = scale >= np.finfo(np.float32).tiny
    return np.where(normal, 1 / np.where(normal, scale, 1), 0).astype(np.float32)


class Query(NamedTuple):
    """What is known of the point in each lane; material and light of every channel."""

    place: Lanes
    normal: Lanes
    material: Sequence[Lanes] = ()
    light: Sequence[Lanes] = ()


def flat(dr: Any, numbers: Float[np.ndarray, "..."]) -> Any:
    """A copy for Dr.Jit, in the precision that they have."""
    return flat_view(dr, in_line(np.ravel(_as_known(numbers))))


def flat_view(dr: Any, numbers: Float[np.ndarray, "..."]) -> Any:
    """The same where they are: of whatever kind that memory is, so a program may have
    to be traced again."""
    numbers = _as_known(numbers)
    kind = dr.llvm.Float if numbers.dtype == np.float32 else dr.llvm.Float64
    return kind(np.ravel(numbers))


def _as_known(numbers: Float[np.ndarray, "..."]) -> np.ndarray:
    """In single or double precision."""
    single = numbers.dtype == np.float32
    return np.ascontiguousarray(numbers, np.float32 if single else np.float64)


def read_row(dr: Any, numbers: Any, width: int, row: Lane) -> Lanes:
    """A row in each lane, of a flat array of rows so wide."""
    return [dr.gather(type(numbers), numbers, row * width + i) for i in range(width)]


def entries(dr: Any, numbers: Any, count: int) -> Lanes:
    """Numbers that all lanes share."""
    index = map(dr.llvm.UInt32, range(count))
    return [dr.gather(type(numbers), numbers, i) for i in index]


def around_table(dr: Any, network: Network, around: Around, lit: bool) -> Table:
    """The samples around with their normals and, where asked for, light."""
    points, _, light = around
    position, normal, mask = map(np.asarray, points)
    columns = [position, normal, *(np.asarray(light) if lit else [])]
    return table_of(dr, sort_points(position, mask, network.smooth), columns)


def smoothed(dr: Any, network: Network, table: Table, query: Query) -> Query:
    """Normal and light as means over the samples around, see `facets`."""
    own = query.normal + [x for lanes in query.light for x in lanes]
    ends = query.place + query.normal

    def visit(row: Lane, totals: Lanes) -> Lanes:
        record = own_record(dr, table, row)
        inputs = pair_inputs(True, ends, record[:6], network.smooth)
        near, alike = (dr.maximum(a, 0) for a in (1 - inputs[6], inputs[5]))
        weight = near * alike**2
        given = [*record[3 : 3 + len(own)], 1.0]
        return [total + weight * x for total, x in zip(totals, given, strict=True)]

    count = len(own) + 1
    (*totals, weight), _ = for_each_near(
        dr, table, network.smooth, query.place, visit, count
    )
    mean = [(a + OWN * b) / (weight + OWN) for a, b in zip(totals, own, strict=True)]
    length = dr.rsqrt(dot(mean[:3], mean[:3]))
    width = network.lights
    light = [mean[i : i + width] for i in range(3, len(mean), width or 1)]
    return query._replace(normal=[x * length for x in mean[:3]], light=light)


def areas(
    dr: Any, found: Sorted, points: Oriented, lanes: Lanes, radius: float, sided: bool
) -> Lane:
    """The area that each of the points stands for: `receptive_field.point_area`."""
    # Read only where sides count.
    facing = side_by_side([points.normal], found.rows, 4) if sided else found.place
    table = table_in(dr, found.cells, found.place, facing)
    return program(_area, radius, sided)(list(table), lanes)


def _area(dr: Any, radius: float, sided: bool, table: Lanes, lanes: Lanes) -> Lane:
    t, searched = dr.llvm, Table(*table)

    def visit(row: Lane, total: Lanes) -> Lanes:
        there = dr.gather(t.Array4f, searched.place, row)
        apart = [a - there[i] for i, a in enumerate(lanes[:3])]
        value = dr.maximum(1 - dot(apart, apart) / radius**2, 0) ** 2
        if sided:
            facing = dr.gather(t.Array4f, searched.record, row)
            value = dr.select(dot(lanes[3:], list(facing)[:3]) >= 0, value, 0)
        return [total[0] + value]

    start = [dr.zeros(t.Float, dr.width(lanes[0]))]
    (total,) = for_each_around(dr, searched, lanes[:3], visit, start)
    return np.pi * radius**2 / 3 / dr.maximum(total, 1)


def own_record(dr: Any, table: Table, row: Lane) -> Lanes:
    """What the table says of one of its points."""
    return read_record(dr, table.record, points_in(dr, table), row)


def points_in(dr: Any, table: Table) -> int:
    """How many points there are."""
    return dr.width(table.place) // 4


class Sum(NamedTuple):
    """What a convolution sums: so many features, in so many channels at once, of all
    that there are."""

    oriented: bool
    radius: float
    taper: float
    width: int
    channels: int
    all_channels: int


def weighed(
    dr: Any,
    found: Sorted,
    points: Oriented,
    area: Float[np.ndarray, "N"],
    radius: float,
) -> Table:
    """Sorted points with what they weigh in a field of that radius."""
    weight = area[:, None] / np.float32(np.pi * radius**2)
    return table_of(dr, found, [*points[:2], weight])


def field_sum(
    dr: Any,
    sum_: Sum,
    kernel: Sequence[Float[np.ndarray, "..."]],
    table: Table,
    features: Any,
    starts: Lane,
    ends: Lanes,
) -> tuple[Lanes, Lane]:
    """Features of some channels, summed around each query by `mcconv`'s rule, and how
    many points of the table are there.

    `features` are records in the table's order, channel after channel, those of the
    channels asked for from record `starts` on; `ends`: position and normal of queries.
    """
    taper, records = sum_.taper, points_in(dr, table) * sum_.all_channels
    starts = entries(dr, starts, sum_.channels)

    def visit(row: Lane, totals: Lanes) -> Lanes:
        own, given = own_record(dr, table, row), []
        inputs = pair_inputs(sum_.oriented, ends, own[:6], sum_.radius)
        weight = own[6]
        if taper:
            squared = dot(inputs[:3], inputs[:3])
            weight *= dr.clip((1 + taper - squared) / (2 * taper), 0, 1)
        values = [v * weight for v in perceptron(dr, kernel, inputs, sum_.width)]
        for start in starts:
            given += read_record(dr, features, records, row + start)[: sum_.width]
        return [
            dr.fma(values[i % sum_.width], x, total)
            for i, (total, x) in enumerate(zip(totals, given, strict=True))
        ]

    far, count = reach(sum_.radius, taper), sum_.width * sum_.channels
    return for_each_near(dr, table, far, ends[:3], visit, count)

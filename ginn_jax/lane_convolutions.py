"""The convolutions of f_3D in lanes, one after the other, with the layers between.

What one leaves is in Dr.Jit's memory for the next. Nothing waits for a result, but for
large layers between: while one sums, NumPy readies the points of the next.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from ginn_jax.architecture import Conv, Network
from ginn_jax.cells import in_line
from ginn_jax.lane_fields import (
    Sum,
    entries,
    field_sum,
    points_in,
    weighed,
)
from ginn_jax.lane_layers import Constants, as_constants, from_constants
from ginn_jax.lane_rows import (
    Width,
    as_code,
    feature_widths,
    in_program,
    layers_by_jax,
    params_before,
    write_layers,
)
from ginn_jax.lanes import (
    Lane,
    Lanes,
    Sorted,
    Table,
    blank,
    in_packets,
    program,
    records,
    side_by_side,
    write_record,
)
from ginn_jax.neighbors import bucket
from ginn_jax.network import Code
from ginn_jax.receptive_field import Oriented

# Sums of a program, but for one channel that has more: it would compile for long. Wide
# layers have few points.
MOST_SUMS = 96

Numbers = Float[np.ndarray, "_ _ _"] | None


class SortedLevel(NamedTuple):
    """Points of a level, ready to be summed.

    points  position and normal
    lanes   the same of each in a lane
    area    that they stand for; none where no convolution weighs them
    tables  points sorted, by the name of the convolution
    """

    points: Oriented
    lanes: Lanes
    area: Any
    tables: dict[str, Sorted]


# Records of features, channel after channel, in Dr.Jit's memory, and how wide they are;
# side by side as skips leave them.
Part = tuple[Width, Any]
Parts = list[Part]


def convolve(
    dr: Any,
    network: Network,
    weights: Any,
    levels: list[SortedLevel],
    material: Numbers,
    light: Numbers,
) -> Code:
    """The codes of the finest points, of every channel; `weights`: those of f_3D."""
    weights, channels = jax.device_get(weights), 1 if light is None else len(light)
    parts = [_enter(dr, network, levels[0].points.normal, material, light)]
    done: dict[str, Parts] = {}
    *widths, last = feature_widths(network)
    for conv, width in zip(network.encoder, widths, strict=True):
        ends = levels[conv.source], levels[conv.target]
        given = dr, network, conv, width, weights, *ends, parts, channels
        before = done[conv.skip] if conv.skip else []
        parts = done[conv.name] = [*before, _convolution(*given)]
    count = len(levels[0].points.mask)
    own = records(dr, [light]) if light is not None and network.local else None
    rows = np.arange(channels * count).reshape(channels, count)
    codes = _layers(dr, network, None, last, weights, parts, own, rows).numpy()
    return as_code(last, codes.reshape(channels, count, -1))


def _convolution(
    dr: Any,
    network: Network,
    conv: Conv,
    width: Width,
    weights: Any,
    senders: SortedLevel,
    receivers: SortedLevel,
    parts: Parts,
    channels: int,
) -> Part:
    """What it makes of all `parts` so far."""
    found = senders.tables[conv.name]
    rows = found.rows + len(found.rows) * np.arange(channels)[:, None]
    features = _layers(dr, network, conv, width, weights, parts, None, rows)
    table = weighed(dr, found, senders.points, senders.area, conv.radius)
    together = channels if channels * sum(width) <= MOST_SUMS else 1
    shape = conv.radius, network.taper, sum(width), together, channels
    sum_ = Sum(network.oriented, *shape)
    kernel = as_constants(weights[conv.name]["kernel"])
    return width, _sums(dr, sum_, kernel, table, features, receivers.lanes)


def _enter(
    dr: Any,
    network: Network,
    normal: Float[np.ndarray, "N 3"],
    material: Numbers,
    light: Numbers,
) -> Part:
    """What the points show f_3D of themselves: `network.enter`."""
    free, beams = [normal], []
    if light is not None:
        free = [np.broadcast_to(normal, (len(light), *normal.shape))]
        free += [
            a for a in (material, None if network.linear else light) if a is not None
        ]
        beams = [light] if network.linear or network.beams else []
    width = Width(*(sum(a.shape[-1] for a in part) for part in (free, beams)))
    return width, records(dr, free + beams)


def _layers(
    dr: Any,
    network: Network,
    conv: Conv | None,
    width: Width,
    weights: Any,
    parts: Parts,
    light: Any,
    rows: Int[np.ndarray, "C M"],
) -> Any:
    """What a convolution is given of these rows of all channels, or the code; `light`:
    the points' own."""
    params, order = params_before(weights, conv), rows.reshape(-1)
    if not in_program(params):
        found = _rows_by_jax(network, conv, params, parts, light, rows.shape)
        return dr.llvm.Float(side_by_side([found], order).reshape(-1))
    to = np.empty(rows.size, np.uint32)
    to[order] = np.arange(rows.size, dtype=np.uint32)
    to = dr.llvm.UInt32(in_line(to))
    widths, given = (list(a) for a in zip(*parts, strict=True))
    known = network, conv, as_constants(params), tuple(widths)
    left = blank(dr, rows.size * in_packets(sum(width)))
    return program(write_layers, *known)(given, light, to, left)


def _rows_by_jax(
    network: Network,
    conv: Conv | None,
    params: Any,
    parts: Parts,
    light: Any,
    shape: tuple[int, ...],
) -> Float[np.ndarray, "M K"]:
    """The same, in the order of the points."""
    more = bucket(shape[1]) - shape[1]

    def padded(numbers: Any) -> Any:
        rows = numbers.numpy().reshape(*shape, -1)
        return np.pad(rows, [(0, 0), (0, more), (0, 0)])

    codes = tuple(as_code(width, padded(part)) for width, part in parts)
    own = None if light is None else padded(light)[..., : network.lights]
    found = layers_by_jax(network, conv, params, codes, own)
    both = [np.asarray(a)[:, : shape[1]] for a in found if a is not None]
    return np.concatenate(both, axis=2).reshape(shape[0] * shape[1], -1)


def _sums(
    dr: Any,
    sum_: Sum,
    kernel: Constants,
    table: Table,
    features: Any,
    receivers: Lanes,
) -> Any:
    """What a convolution leaves of every channel, of some at a time."""
    t, rows, points = dr.llvm, dr.width(receivers[0]), points_in(dr, table)
    left = blank(dr, sum_.all_channels * rows * in_packets(sum_.width))
    run = program(_convolved, sum_, kernel)
    for some in np.arange(sum_.all_channels, dtype=np.uint32).reshape(
        -1, sum_.channels
    ):
        starts = (t.UInt32(in_line(some * np.uint32(n))) for n in (points, rows))
        left = run(list(table), features, *starts, receivers, left)
    return left


def _convolved(
    dr: Any,
    sum_: Sum,
    kernel: Constants,
    table: Lanes,
    features: Any,
    given: Lane,
    to: Lane,
    ends: Lanes,
    left: Any,
) -> Any:
    """The program: sums, written where there is nothing yet; `given`, `to`: where the
    channels begin."""
    weights, lane = from_constants(kernel), dr.arange(dr.llvm.UInt32, dr.width(ends[0]))
    totals, _ = field_sum(dr, sum_, weights, Table(*table), features, given, ends)
    for i, start in enumerate(entries(dr, to, sum_.channels)):
        row = totals[i * sum_.width : (i + 1) * sum_.width]
        write_record(dr, left, row, lane + start)
    return left

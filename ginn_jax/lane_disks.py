"""Poisson disks in lanes: which samples `levels` keeps, with a sample in every lane.

What becomes of a sample depends on those thrown before it alone. So the first quarter
is decided by itself, among fewer, and of the rest most are dropped by those it kept.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt32

from ginn_jax.architecture import Network
from ginn_jax.cells import (
    Cells,
    in_line,
    rows_of,
    sort_into_cells,
    thinned,
)
from ginn_jax.hierarchy import DROPPED, HOLD, KEPT, WAITING, thrown_first
from ginn_jax.lane_loops import for_each_around
from ginn_jax.lanes import (
    Lane,
    Lanes,
    Table,
    program,
    side_by_side,
    table_in,
)

# Lots of the first quarter; of samples fewer than that all are thrown at once.
QUARTER, FEW = 1 << 30, 1 << 12
# Lots of samples that were kept before come before all others: `thrown_first`.
HALF = 1 << 31


class Disk(NamedTuple):
    """How near samples may come: nearer than `radius` where they face away (`sided`),
    or where both were kept before (`moved`: then lots tell)."""

    radius: float
    sided: bool
    moved: bool


class Darts(NamedTuple):
    """Samples to be thrown, sorted by cell: where each is and its lot, which way it
    faces and its name. Smaller lots come first, ties by name. And the same numbers in
    Dr.Jit's memory."""

    place: Float[np.ndarray, "N 4"]
    facing: Float[np.ndarray, "N 4"]
    lanes: Lanes


def levels_in_lanes(
    dr: Any,
    network: Network,
    position: Float[np.ndarray, "N 3"],
    normal: Float[np.ndarray, "N 3"],
    lots: Sequence[UInt32[Any, "R"]],
    kept_before: Bool[np.ndarray, "L R"] | None,
) -> list[Int[np.ndarray, "_"]]:
    """The samples that each level keeps, finest first, neighbours together."""
    levels, rows = [], np.arange(len(position))
    moved = kept_before is not None
    for i, radius in enumerate(network.levels):
        before = None if kept_before is None else kept_before[i, rows]
        lot = thrown_first(np.asarray(lots[i])[rows], before)
        ends = position.take(rows, 0), normal.take(rows, 0), lot, rows
        disk = Disk(radius, network.sided, moved)
        rows = rows[sample_disk_in_lanes(dr, disk, *ends)]
        levels.append(rows)
    return levels


def sample_disk_in_lanes(
    dr: Any,
    disk: Disk,
    position: Float[np.ndarray, "N 3"],
    normal: Float[np.ndarray, "N 3"],
    lot: UInt32[np.ndarray, "N"],
    name: Int[np.ndarray, "N"],
) -> Int[np.ndarray, "K"]:
    """The rows that `hierarchy.sample_disk` keeps, in the order of their cells."""
    cells = sort_into_cells(position, disk.radius)
    darts = _darts(dr, cells, position, normal, lot, name)
    lot = lot.take(cells.order)
    if len(lot) < FEW:
        return cells.order[_elect(dr, disk, cells, darts, np.arange(len(lot)))]
    early = lot < (HALF if disk.moved else QUARTER)
    if not early.any():  # none was kept before
        early = lot < HALF + QUARTER // 2
    first = _elect(dr, disk, cells, darts, np.flatnonzero(early))
    late = np.flatnonzero(~early)
    if len(first) and len(late):
        kept = np.full(len(first), KEPT, np.uint32)
        target = _target(dr, cells, darts, first)
        late = late[_judge(dr, disk, darts, target, kept, late, KEPT) == KEPT]
    rows = np.concatenate([first, _elect(dr, disk, cells, darts, late)])
    return cells.order[np.sort(rows)]


def _darts(
    dr: Any,
    cells: Cells,
    position: Float[np.ndarray, "N 3"],
    normal: Float[np.ndarray, "N 3"],
    lot: UInt32[np.ndarray, "N"],
    name: Int[np.ndarray, "N"],
) -> Darts:
    """The samples in the order of their cells."""
    place, facing = (
        side_by_side([row, last.view(np.float32)[:, None]], cells.order, 4)
        for row, last in ((position, lot), (normal, name.astype(np.uint32)))
    )
    lanes = [dr.llvm.Float(np.ravel(a)) for a in (place, facing)]
    return Darts(place, facing, lanes)


def _elect(
    dr: Any, disk: Disk, cells: Cells, darts: Darts, rows: Int[np.ndarray, "M"]
) -> Int[np.ndarray, "K"]:
    """Those of some rows that survive among themselves, round after round.

    A sample is kept once all its betters are dropped, and dropped once one is kept.
    """
    if not len(rows):
        return rows
    target = _target(dr, cells, darts, rows)
    state = np.full(len(rows), WAITING, np.uint32)
    waiting, enough = np.arange(len(rows)), WAITING
    while len(waiting):
        asked = rows[waiting]
        state[waiting] = _judge(dr, disk, darts, target, state, asked, enough)
        waiting, enough = waiting[state[waiting] == WAITING], KEPT
    return rows[state == KEPT]


def _target(dr: Any, cells: Cells, darts: Darts, rows: Int[np.ndarray, "M"]) -> Table:
    """Some of the samples, to be searched."""
    some = (rows_of(a, rows) for a in (darts.place, darts.facing))
    return table_in(dr, thinned(cells, rows), *some)


def _judge(
    dr: Any,
    disk: Disk,
    darts: Darts,
    target: Table,
    state: UInt32[np.ndarray, "M"],
    asked: Int[np.ndarray, "Q"],
    enough: int,
) -> UInt32[np.ndarray, "Q"]:
    """The new state of some samples, by the states of their betters in the target.

    A lane has seen enough once it meets one of that state.
    """
    some = state, asked.astype(np.uint32), np.array([enough], np.uint32)
    given = darts.lanes, *(dr.llvm.UInt32(in_line(a)) for a in some)
    return program(_best, disk)(list(target), *given).numpy()


def _best(
    dr: Any,
    disk: Disk,
    table: Lanes,
    darts: Lanes,
    state: Lane,
    asked: Lane,
    enough: Lane,
) -> Lane:
    """What `_judge` says, by the highest state among betters in conflict."""
    t, searched = dr.llvm, Table(*table)
    (*place, lot), (*normal, name) = (dr.gather(t.Array4f, a, asked) for a in darts)
    lot, name = (dr.reinterpret_array(t.UInt32, a) for a in (lot, name))

    def test(row: Lane, best: Lanes) -> Lanes:
        found = dr.gather(t.Array4f, searched.place, row)
        other = dr.reinterpret_array(t.UInt32, found[3])
        squared = sum((x - found[i]) ** 2 for i, x in enumerate(place))
        conflict = (other <= lot) & _conflict(disk, squared, other, lot)
        facing = dr.gather(t.Array4f, searched.record, row, conflict)
        tied = dr.reinterpret_array(t.UInt32, facing[3]) < name
        conflict &= (other < lot) | tied
        if disk.sided:
            conflict &= sum(normal[i] * facing[i] for i in range(3)) >= 0
        seen = dr.gather(t.UInt32, state, row, conflict)
        return [dr.maximum(best[0], seen)]

    start = [dr.zeros(t.UInt32, dr.width(asked))]
    (best,) = for_each_around(
        dr, searched, place, test, start, lambda best: best[0] < enough
    )
    undecided = dr.select(best < WAITING, t.UInt32(KEPT), t.UInt32(WAITING))
    return dr.select(best == KEPT, t.UInt32(DROPPED), undecided)


def _conflict(disk: Disk, squared: Lane, one: Lane, other: Lane) -> Lane:
    """Whether samples with these lots so far apart are too near to each other."""
    radius = np.float32(disk.radius)
    near = squared < float(radius**2)
    if not disk.moved:
        return near
    apart = squared >= float((np.float32(HOLD) * radius) ** 2)
    return near & ~((one < HALF) & (other < HALF) & apart)

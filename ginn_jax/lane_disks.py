"""Poisson disks in lanes: which samples `levels` keeps, with a sample in every lane.

What becomes of a sample depends on those thrown before it alone. So the first quarter
is decided by itself, among fewer, and of the rest most are dropped by those it kept.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt32

from ginn_jax.architecture import Network
from ginn_jax.cells import Cells, aligned, in_line, sort_into_cells, thinned
from ginn_jax.hierarchy import DROPPED, HOLD, KEPT, WAITING, thrown_first
from ginn_jax.lane_fields import flat
from ginn_jax.lanes import (
    COLUMNS,
    Lane,
    Lanes,
    Table,
    program,
    runs_of,
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
    """Samples to be thrown, smaller lots first, ties by name; and the same numbers in
    Dr.Jit's memory."""

    position: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]
    lot: UInt32[np.ndarray, "N"]
    name: UInt32[np.ndarray, "N"]
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
    t, name = dr.llvm, name.astype(np.uint32)
    lanes = [flat(dr, position), flat(dr, normal)]
    lanes += [t.UInt32(in_line(a)) for a in (lot, name)]
    darts = Darts(position, normal, lot, name, lanes)
    cells = sort_into_cells(position, disk.radius)
    if len(lot) < FEW:
        everyone = np.arange(len(lot))
        return cells.order[_elect(dr, disk, cells, darts, everyone)]
    early = lot.take(cells.order) < (HALF if disk.moved else QUARTER)
    if not early.any():  # none was kept before
        early = lot.take(cells.order) < HALF + QUARTER // 2
    first = _elect(dr, disk, cells, darts, np.flatnonzero(early))
    late = np.flatnonzero(~early)
    if len(first) and len(late):
        kept = np.full(len(first), KEPT, np.uint32)
        target = _target(dr, disk, cells, darts, first)
        asked = cells.order[late]
        late = late[_judge(dr, disk, darts, target, kept, asked, KEPT) == KEPT]
    rows = np.concatenate([first, _elect(dr, disk, cells, darts, late)])
    return cells.order[np.sort(rows)]


def _elect(
    dr: Any, disk: Disk, cells: Cells, darts: Darts, rows: Int[np.ndarray, "M"]
) -> Int[np.ndarray, "K"]:
    """Those of some rows that survive among themselves, round after round.

    A sample is kept once all its betters are dropped, and dropped once one is kept.
    """
    if not len(rows):
        return rows
    target, order = _target(dr, disk, cells, darts, rows), cells.order[rows]
    state = np.full(len(rows), WAITING, np.uint32)
    waiting, enough = np.arange(len(rows)), WAITING
    while len(waiting):
        asked = order[waiting]
        state[waiting] = _judge(dr, disk, darts, target, state, asked, enough)
        waiting, enough = waiting[state[waiting] == WAITING], KEPT
    return rows[state == KEPT]


def _target(
    dr: Any, disk: Disk, cells: Cells, darts: Darts, rows: Int[np.ndarray, "M"]
) -> tuple[Table, Any]:
    """Some of the samples to be searched, lots as the fourth number of their place;
    and their names."""
    cells = thinned(cells, rows)
    some = cells.order
    place = aligned(len(rows), 4)
    place[:, :3] = darts.position.take(some, 0)
    place.view(np.uint32)[:, 3] = darts.lot.take(some)
    # Read only where sides count.
    record = side_by_side([darts.normal], some, 4) if disk.sided else place
    table = table_in(dr, cells, place, record)
    return table, dr.llvm.UInt32(in_line(darts.name.take(some)))


def _judge(
    dr: Any,
    disk: Disk,
    darts: Darts,
    target: tuple[Table, Any],
    state: UInt32[np.ndarray, "M"],
    asked: Int[np.ndarray, "Q"],
    enough: int,
) -> UInt32[np.ndarray, "Q"]:
    """The new state of some samples, by the states of their betters in the target.

    A lane has seen enough once it meets one of that state.
    """
    t, (table, names) = dr.llvm, target
    some = state, asked.astype(np.uint32), np.array([enough], np.uint32)
    given = darts.lanes, *(t.UInt32(in_line(a)) for a in some)
    return program(_best, disk)(list(table), names, *given).numpy()


def _best(
    dr: Any,
    disk: Disk,
    table: Lanes,
    names: Lane,
    darts: Lanes,
    state: Lane,
    asked: Lane,
    enough: Lane,
) -> Lane:
    """What `_judge` says, by the highest state among betters in conflict."""
    t, searched = dr.llvm, Table(*table)
    place, normal = (
        [dr.gather(t.Float, a, asked * 3 + i) for i in range(3)] for a in darts[:2]
    )
    lot, name = (dr.gather(t.UInt32, a, asked) for a in darts[2:])
    run_of = runs_of(dr, searched, place)

    def test(row: Lane, stop: Lane, best: Lane) -> tuple:
        found = dr.gather(t.Array4f, searched.place, row)
        other = dr.reinterpret_array(t.UInt32, found[3])
        squared = sum((x - found[i]) ** 2 for i, x in enumerate(place))
        tie = other == lot
        better = (other < lot) | (tie & (dr.gather(t.UInt32, names, row, tie) < name))
        conflict = better & _conflict(disk, squared, other, lot)
        if disk.sided:
            facing = dr.gather(t.Array4f, searched.record, row, conflict)
            conflict &= sum(normal[i] * facing[i] for i in range(3)) >= 0
        seen = dr.gather(t.UInt32, state, row, conflict)
        return row + 1, stop, dr.maximum(best, seen)

    def through(column: Lane, best: Lane) -> tuple:
        # Its own column first: what is near decides.
        row, stop = run_of((column + COLUMNS // 2) % COLUMNS, t.Bool(True))
        *_, best = dr.while_loop(
            (row, stop, best),
            lambda row, stop, best: (row < stop) & (best < enough),
            test,
        )
        return column + 1, best

    zero = dr.zeros(t.UInt32, dr.width(asked))
    _, best = dr.while_loop(
        (zero, zero),
        lambda column, best: (column < COLUMNS) & (best < enough),
        through,
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

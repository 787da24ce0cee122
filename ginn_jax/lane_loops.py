"""Loops over the points near a query, with a query in every lane of a CPU's vectors.

XLA makes lists of candidates and edges, writes them and reads them again. Here each
lane goes through the points in the cells around its query, and works off those that are
near or, where that takes no longer than a test, all: no list, hence no capacity.
"""

from collections.abc import Callable, Sequence
from typing import Any

from ginn_jax.lanes import Lane, Lanes, Table

# Points near a query that are noted before they are worked off.
NOTED = 32
# A query's own column of cells and the eight around it.
COLUMNS = 9


def for_each_near(
    dr: Any,
    table: Table,
    radius: float,
    place: Lanes,
    visit: Callable[[Lane, Lanes], Lanes],
    count: int,
) -> tuple[Lanes, Lane]:
    """So many totals, each 0 at first, that `visit(row, totals)` renews for every point
    nearer than `radius`, and how many those are; `row`: of the table.

    A lane notes up to `NOTED` points, then works them off, so that most lanes have
    something to do at any time, and goes on to look for others.
    """
    t = dr.llvm
    run_of = runs_of(dr, table, place)

    def note(column: Lane, row: Lane, stop: Lane, noted: Lane, notes: Any) -> tuple:
        def test(row: Lane, noted: Lane, notes: Any) -> tuple:
            found = dr.gather(t.Array4f, table.place, row)
            near = sum((x - found[i]) ** 2 for i, x in enumerate(place)) < radius**2
            # Others are overwritten: to store what is near only, each lane would jump.
            notes.write(row, noted)
            return row + 1, dr.select(near, noted + 1, noted), notes

        row, noted, notes = dr.while_loop(
            (row, noted, notes),
            lambda row, noted, notes: (row < stop) & (noted < NOTED),
            test,
        )
        done = row >= stop
        column = dr.select(done, column + 1, column)
        begin, end = run_of(column, done)
        row, stop = dr.select(done, begin, row), dr.select(done, end, stop)
        return column, row, stop, noted, notes

    def work_off(number: Lane, notes: Any, *totals: Lane) -> tuple:
        return number + 1, notes, *visit(notes.read(number), list(totals))

    def round_(
        column: Lane, row: Lane, stop: Lane, found: Lane, notes: Any, *totals: Lane
    ) -> tuple:
        column, row, stop, noted, notes = dr.while_loop(
            (column, row, stop, zero, notes),
            lambda column, row, stop, noted, notes: (
                (column < COLUMNS) & (noted < NOTED)
            ),
            note,
        )
        _, *rest = dr.while_loop(
            (zero, notes, *totals), lambda number, *_: number < noted, work_off
        )
        return column, row, stop, found + noted, *rest

    # All in full width: loops crash where some lanes share a number that others change.
    width = dr.width(place[0])
    zero, totals = dr.zeros(t.UInt32, width), [dr.zeros(t.Float, width)] * count
    notes = dr.alloc_local(t.UInt32, NOTED)
    state = zero, *run_of(zero, t.Bool(True)), zero, notes, *totals
    state = dr.while_loop(state, lambda column, *_: column < COLUMNS, round_)
    return list(state[5:]), state[3]


def for_each_around(
    dr: Any,
    table: Table,
    place: Lanes,
    visit: Callable[[Lane, Lanes], Lanes],
    state: Lanes,
    going: Callable[[Lanes], Any] | None = None,
) -> Lanes:
    """State that `visit(row, state)` renews for every point in the cells around, be it
    near or not, as long as it is `going`: for visits that take no longer than a test.
    """
    t, run_of = dr.llvm, runs_of(dr, table, place)

    def within(count: Lane, most: Lane | int, state: Sequence[Lane]) -> Lane:
        return count < most if going is None else (count < most) & going(list(state))

    def through(column: Lane, *state: Lane) -> tuple:
        # Its own column first: what is near decides.
        row, stop = run_of((column + COLUMNS // 2) % COLUMNS, t.Bool(True))
        _, _, *found = dr.while_loop(
            (row, stop, *state),
            lambda row, stop, *state: within(row, stop, state),
            lambda row, stop, *state: (row + 1, stop, *visit(row, list(state))),
        )
        return column + 1, *found

    column = dr.zeros(t.UInt32, dr.width(place[0]))
    _, *state = dr.while_loop(
        (column, *state),
        lambda column, *state: within(column, COLUMNS, state),
        through,
    )
    return state


def runs_of(dr: Any, table: Table, place: Lanes) -> Callable[[Lane, Lane], tuple]:
    """The rows of the cells around each query, by the number of their column."""
    t = dr.llvm
    frame = [dr.gather(t.Float, table.frame, t.UInt32(i)) for i in range(7)]
    low, rate = frame[:3], frame[3]
    width, depth, height = map(t.Int32, frame[4:])
    x, y, z = (
        t.Int32(dr.clip(dr.floor((a - b) * rate), -1, cells))
        for a, b, cells in zip(place, low, frame[4:], strict=True)
    )
    first, last = (dr.clip(z + step, 0, height - 1) for step in (-1, 1))

    def run_of(column: Lane, active: Lane) -> tuple[Lane, Lane]:
        across, along = x + t.Int32(column) // 3 - 1, y + t.Int32(column) % 3 - 1
        inside = (across >= 0) & (across < width) & (along >= 0) & (along < depth)
        inside &= active & (column < COLUMNS)
        base = (across * depth + along) * height
        return tuple(
            dr.gather(t.UInt32, table.start, t.UInt32(base + cell), inside)
            for cell in (first, last + 1)
        )

    return run_of

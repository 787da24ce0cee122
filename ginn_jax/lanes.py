"""Points in cells as programs of Dr.Jit search them, and such programs, traced once.

A lane is a query's place in a CPU's vectors. Dr.Jit, which compiles the ray tracer,
compiles what all of them do at once.
"""

import functools
import threading
import time
import tracemalloc
import weakref
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from ginn_jax.cells import Cells, aligned, sort_into_cells
from ginn_jax.renderer import use_drjit

# Numbers of a record that are read or written at once. Columns so narrow that NumPy
# sorts them faster one by one.
PACKET, NARROW = 8, 8

# Programs that are kept, with weights of their own: those of a dozen networks.
PROGRAMS, NEVER = 512, 1 << 30
# Seconds that are waited for a thread which may have died.
PATIENCE = 10.0
# And so many pass until a thread that was counting memory has counted it.
PAUSE = 0.1

# Held while lanes run: all threads share what Dr.Jit traced once, and two that are in
# it hang or end the process.
IN_TURN = threading.RLock()

# A number, or a few, in each lane.
Lane = Any
Lanes = list[Any]
Given = ParamSpec("Given")
Found = TypeVar("Found")


def in_turn(function: Callable[Given, Found]) -> Callable[Given, Found]:
    """The function, run by one thread at a time: the others wait."""

    @functools.wraps(function)
    def run(*args: Given.args, **kwargs: Given.kwargs) -> Found:
        with IN_TURN:
            return function(*args, **kwargs)

    return run


@functools.lru_cache(maxsize=PROGRAMS)
def program(function: Callable[..., Any], *static: Hashable) -> Callable[..., Any]:
    """`function(dr, *static, *arrays)`, traced once for all alike arrays of Dr.Jit.

    Tracing it anew would take as long as running it.
    """
    dr = use_drjit()

    def run(*arrays: Any) -> Any:
        return function(dr, *static, *arrays)

    return dr.freeze(run, warn_after=NEVER)


def most_held_mib(call: Callable[[], Any]) -> float:
    """The most memory that NumPy holds at a time for that call, and Dr.Jit."""
    dr = use_drjit()
    backend = dr.JitBackend.LLVM
    call()  # so that nothing is compiled
    dr.sync_thread()
    dr.flush_malloc_cache()  # which counts as held
    dr.detail.malloc_clear_statistics()
    held = dr.detail.malloc_watermark(backend)  # by others, as the ray tracer
    tracemalloc.start()
    try:
        call()
        _, most = tracemalloc.get_traced_memory()
    finally:
        # Or that may crash: CPython's issue 128679, mended in 3.12 and later. A thread
        # that is counting waits for this one, which therefore pauses.
        wait_for_thread(dr)
        time.sleep(PAUSE)
        tracemalloc.stop()
    return (most + dr.detail.malloc_watermark(backend) - held) / 2**20


def wait_for_thread(dr: Any) -> None:
    """Wait until the thread in which Dr.Jit lets go of NumPy's memory has nothing left.

    It does so in turn: what is given to it last is let go of last.
    """
    gone, last = threading.Event(), np.zeros(1, np.float32)
    weakref.finalize(last, gone.set)
    held = dr.llvm.Float(last)
    dr.eval(held + 1)
    del held, last
    dr.sync_thread()
    gone.wait(PATIENCE)


class Table(NamedTuple):
    """Points in cells, in Dr.Jit's memory: where each is, and a record of it, of whole
    packets or, where `for_each_around` goes through them, of four numbers.

    `frame` has the low corner of the cells, their rate and how many they are each way.
    """

    place: Any
    record: Any
    start: Any
    frame: Any


class Sorted(NamedTuple):
    """Points sorted into cells: where each is, and which of all it is."""

    cells: Cells
    place: Float[np.ndarray, "M 4"]
    rows: Int[np.ndarray, "M"]


def sort_points(
    position: Float[np.ndarray, "N 3"], mask: Bool[np.ndarray, "N"], radius: float
) -> Sorted:
    """The points in `mask`, to be searched within that radius."""
    rows = np.flatnonzero(mask)
    cells = sort_into_cells(position.take(rows, 0), radius)
    rows = rows[cells.order]
    return Sorted(cells, side_by_side([position], rows, 4), rows)


def table_of(
    dr: Any, found: Sorted, columns: Sequence[Float[np.ndarray, "N _"]]
) -> Table:
    """Those points; a record is a row of these columns side by side."""
    return table_in(dr, *found[:2], side_by_side(columns, found.rows))


def table_in(
    dr: Any,
    cells: Cells,
    place: Float[np.ndarray, "N 4"],
    record: Float[np.ndarray, "N _"],
) -> Table:
    """The points of these cells in their order, from `aligned` memory."""
    t = dr.llvm
    frame = aligned(1, 8)
    frame[0] = *cells.low, cells.rate, *cells.shape, 0
    start = t.UInt32(cells.start.view(np.uint32))
    place, record, frame = (t.Float(np.ravel(a)) for a in (place, record, frame))
    return Table(place, record, start, frame)


def side_by_side(
    columns: Sequence[Float[np.ndarray, "*C N _"]],
    rows: Int[np.ndarray, "M"],
    packet: int = PACKET,
) -> Float[np.ndarray, "*C M _"]:
    """Some rows, padded to whole packets, in `aligned` memory."""
    used, place = sum(column.shape[-1] for column in columns), 0
    shape = (*columns[0].shape[:-2], len(rows))
    table = aligned(int(np.prod(shape)), in_packets(used, packet))
    table = table.reshape(*shape, -1)
    table[..., used:] = 0
    for column in columns:
        width = column.shape[-1]
        if width < NARROW:
            for i in range(width):
                table[..., place + i] = column[..., i].take(rows, -1)
        else:
            table[..., place : place + width] = column.take(rows, -2)
        place += width
    return table


def blank(dr: Any, count: int) -> Any:
    """Memory for so many numbers, with anything in it. Not Dr.Jit's own: its size would
    be part of a program."""
    return dr.llvm.Float(aligned(1, count)[0])


def records(dr: Any, columns: Sequence[Float[np.ndarray, "*C N _"]]) -> Any:
    """Rows of these columns side by side, for Dr.Jit."""
    rows = np.arange(columns[0].shape[-2])
    return dr.llvm.Float(side_by_side(columns, rows).reshape(-1))


def in_packets(count: int, packet: int = PACKET) -> int:
    """So many numbers, and those that fill the last packet."""
    return -(-count // packet) * packet


def read_record(dr: Any, table: Any, count: int, row: Lane) -> Lanes:
    """The numbers in one of so many records."""
    packets, lanes = dr.width(table) // count // PACKET, dr.width(row)
    found: Lanes = []
    for packet in range(packets):
        place = row * packets + packet
        part = dr.gather(dr.llvm.ArrayXf, table, place, shape=(PACKET, lanes))
        found += [part[i] for i in range(PACKET)]
    return found


def write_record(dr: Any, left: Any, numbers: Lanes, row: Lane) -> None:
    """Numbers of each lane as a record of `left`, where there is nothing yet. In
    packets, for a number by itself takes a jump for each lane."""
    zero = dr.zeros(dr.llvm.Float, dr.width(row))
    numbers = numbers + [zero] * (-len(numbers) % PACKET)
    packets = len(numbers) // PACKET
    for packet in range(packets):
        part = dr.llvm.ArrayXf(numbers[packet * PACKET : (packet + 1) * PACKET])
        place = row * packets + packet
        # All at once: one after the other they would be as many programs.
        dr.scatter(left, part, place, mode=dr.ReduceMode.Permute)

"""Loops over the points near a query or around it, cells, and what they read."""

import tracemalloc
import weakref

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from strategies import FACES, FAR, RADII, UNIT, clouds, coordinates

from ginn_jax import cells, lane_loops, lanes
from ginn_jax.renderer import use_drjit

FACTORS = st.sampled_from([1.0, 1e-6, 1e6])


@st.composite
def scenes(draw):
    """A cloud with at least one point that counts, queries and a radius."""
    points = draw(clouds().filter(len))
    mask = np.ones(len(points), bool)
    mask[draw(st.lists(st.integers(0, len(points) - 1)))] = False
    mask[draw(st.integers(0, len(points) - 1))] = True
    queries = draw(coordinates(UNIT | FACES | FAR, 1, 20) | st.just(points))
    factor = np.float32(draw(FACTORS))
    return points * factor, mask, queries * factor, draw(RADII) * float(factor)


def loop(points, mask, queries, radius):
    """How many points each query finds, sums of two numbers that they have, and how
    many are near of those around."""
    dr = use_drjit()
    t = dr.llvm
    number = np.arange(1, len(points) + 1, dtype=np.float32)[:, None]
    columns = [points, number, number * 37 % 101]
    found = lanes.sort_points(points, mask, radius)
    rows, table = found.rows, lanes.table_of(dr, found, columns)
    np.testing.assert_array_equal(np.sort(rows), np.flatnonzero(mask))
    lane = dr.arange(t.UInt32, len(queries))
    flat = t.Float(np.ascontiguousarray(queries).reshape(-1))
    place = [dr.gather(t.Float, flat, 3 * lane + i) for i in range(3)]

    def visit(row, totals):
        record = lanes.read_record(dr, table.record, len(rows), row)
        return [a + b for a, b in zip(totals, record[3:5], strict=True)]

    def count(row, total):
        there = dr.gather(t.Array4f, table.place, row)
        squared = sum((x - there[i]) ** 2 for i, x in enumerate(place))
        return [total[0] + dr.select(squared < radius**2, 1, 0)]

    totals, found = lane_loops.for_each_near(dr, table, radius, place, visit, 2)
    zero = dr.zeros(t.Float, len(queries))
    around = lane_loops.for_each_around(dr, table, place, count, [zero])
    dr.eval(totals, found, around)
    return [a.numpy() for a in (found, *totals, *around)]


def check(points, mask, queries, radius):
    away = queries[:, None].astype(np.float64) - points[mask]
    distance = np.sqrt(np.sum(away**2, axis=-1)) / radius
    near, maybe = distance < 1 - 1e-5, distance < 1 + 1e-5
    number = np.flatnonzero(mask) + 1.0
    found = loop(points, mask, queries, radius)
    summed = number**0, number, number * 37 % 101, number**0
    for values, each in zip(found, summed, strict=True):
        # What is at exactly the radius may count or not, but in all.
        assert (values >= near @ each - 0.5).all()
        assert (values <= maybe @ each + 0.5).all()
        certain = (near == maybe).all(axis=1)
        np.testing.assert_array_equal(values[certain], (near @ each)[certain])


@given(scenes())
def test_each_point_near_is_visited_once(scene):
    check(*scene)


@pytest.mark.usefixtures("far_in_few")
@given(scenes())
def test_each_point_near_is_visited_once_if_some_are_far_from_most(scene):
    check(*scene)


def test_a_lane_that_has_seen_enough_goes_no_further():
    """Of a crowd in three columns each lane counts as many as it wants."""
    dr = use_drjit()
    t, points = dr.llvm, np.zeros((60, 3), np.float32)
    points[:, 0] = np.repeat([0.0, 1.5, -1.5], 20)
    found = lanes.sort_points(points, np.ones(60, bool), 1.4)
    table = lanes.table_of(dr, found, [points])
    wanted = t.UInt32([0, 1, 7, 20, 21, 45, 60, 99])
    (count,) = lane_loops.for_each_around(
        dr,
        table,
        [dr.zeros(t.Float, 8)] * 3,
        lambda row, count: [count[0] + 1],
        [dr.zeros(t.UInt32, 8)],
        lambda count: count[0] < wanted,
    )
    np.testing.assert_array_equal(count.numpy(), [0, 1, 7, 20, 21, 45, 60, 60])


@pytest.mark.parametrize("width", [1, 8, 11, 17])
def test_records_are_read_as_they_were_written(width):
    """Each lane's to a row of its own; what fills the last packet is 0."""
    dr, rng = use_drjit(), np.random.default_rng(width)
    t, rows = dr.llvm, rng.permutation(37).astype(np.uint32)
    numbers = rng.standard_normal((37, width)).astype(np.float32)
    left = lanes.blank(dr, 37 * lanes.in_packets(width))
    left += np.nan
    given = [t.Float(np.ascontiguousarray(column)) for column in numbers.T]
    lanes.write_record(dr, left, given, t.UInt32(rows))
    found = lanes.read_record(dr, left, 37, t.UInt32(rows))
    np.testing.assert_array_equal(
        np.stack([a.numpy() for a in found[:width]]).T, numbers
    )
    assert all((a.numpy() == 0).all() for a in found[width:])
    again = lanes.read_record(dr, lanes.records(dr, [numbers]), 37, t.UInt32(rows))
    np.testing.assert_array_equal(
        np.stack([a.numpy() for a in again[:width]]).T, numbers[rows]
    )


@given(st.data())
def test_rows_keep_their_bits(data):
    """Lots and names are among floats: any of their patterns, not a number or not."""
    # Signalling and other numbers that are none, -0, subnormal.
    odd = st.sampled_from([0x7F800001, 0xFFFFFFFF, 1 << 31, 1])
    words = odd | st.integers(0, 2**32 - 1)
    shape = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 10))
    bits = data.draw(hnp.arrays(np.uint32, shape, elements=words))
    rows = np.array(data.draw(st.lists(st.integers(0, len(bits) - 1), min_size=1)))
    for packet in (4, 8):
        found = lanes.side_by_side([bits.view(np.float32)], rows, packet)
        assert found.ctypes.data % 64 == 0
        assert found.shape[1] == lanes.in_packets(shape[1], packet)
        found = found.view(np.uint32)
        np.testing.assert_array_equal(found[:, : shape[1]], bits[rows])
        assert (found[:, shape[1] :] == 0).all()
    found = cells.rows_of(bits.view(np.float32), rows)
    assert found.ctypes.data % 64 == 0
    np.testing.assert_array_equal(found.view(np.uint32), bits[rows])


@pytest.mark.parametrize("noted", [1, 2, 5])
def test_no_note_is_lost_where_there_is_room_for_few(noted, monkeypatch):
    monkeypatch.setattr(lane_loops, "NOTED", noted)
    rng = np.random.default_rng(0)
    points, queries = (rng.uniform(size=(n, 3)).astype(np.float32) for n in (400, 50))
    crowd = np.concatenate([points, np.repeat(points[:1], 100, axis=0)])
    check(crowd, np.ones(500, bool), queries, 0.3)


def test_rounding_moves_no_point_out_of_reach():
    """A thousand cells along a line, points and queries on both sides of each face."""
    radius = 1e-3
    faces = np.arange(990) * (1 + cells.MARGIN) * radius
    points = np.zeros((2 * len(faces), 3), np.float32)
    points[:, 2] = np.concatenate([np.nextafter(np.float32(faces), 0), faces])
    for axes in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
        near = points[:, axes]
        along = np.zeros(3)
        along[axes.index(2)] = 0.9999 * radius
        queries = np.concatenate([near + along, near - along]).astype(np.float32)
        check(near, np.ones(len(near), bool), queries, radius)
    found = cells.sort_into_cells(points, radius)
    assert 1 / np.float64(found.rate) >= (1 + cells.MARGIN / 2) * radius


@given(clouds().filter(len), RADII, st.sampled_from([1, 30, 1 << 19]))
def test_cells_hold_all_points_and_are_wide_enough(points, radius, most):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cells, "MOST", most)
        found = cells.sort_into_cells(points, radius)
    # Eight for each point, but no fewer than `MOST`.
    assert len(found.start) == np.prod(found.shape) + 1
    assert np.prod(found.shape) <= max(most, 8 * len(points))
    assert 1 / found.rate >= radius
    np.testing.assert_array_equal(np.sort(found.order), np.arange(len(points)))
    assert found.start[0] == 0
    assert (np.diff(found.number) >= 0).all()
    assert found.start[-1] == len(points)
    place = np.floor((points - found.low) * found.rate).astype(int)
    number = np.ravel_multi_index(tuple(place.T), found.shape)
    for cell in np.unique(number):
        rows = found.order[found.start[cell] : found.start[cell + 1]]
        np.testing.assert_array_equal(rows, np.flatnonzero(number == cell))


@given(clouds().filter(len), st.data())
def test_thinned_cells_are_those_of_fewer_points(points, data):
    found = cells.sort_into_cells(points, 0.25)
    kept = data.draw(hnp.arrays(bool, len(points)))
    thin = cells.thinned(found, np.flatnonzero(kept))
    np.testing.assert_array_equal(thin.order, found.order[kept])
    counts = np.bincount(found.number[kept], minlength=len(found.start) - 1)
    np.testing.assert_array_equal(np.diff(thin.start), counts)
    assert thin.start[0] == 0


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.uint32])
def test_copies_begin_on_a_cache_line(kind):
    for count in (1, 7, 100):
        numbers = np.arange(count + 1).astype(kind)[1:]
        copy = cells.in_line(numbers)
        assert copy.ctypes.data % 64 == 0
        assert copy.dtype == kind
        np.testing.assert_array_equal(copy, numbers)


def test_rows_stand_side_by_side_in_every_channel():
    a, b = np.arange(24.0).reshape(2, 4, 3), np.arange(8.0).reshape(2, 4, 1)
    found = lanes.side_by_side([a, b], np.array([3, 1]))
    assert found.shape == (2, 2, 8)
    np.testing.assert_array_equal(found[..., :3], a[:, [3, 1]])
    np.testing.assert_array_equal(found[..., 3:4], b[:, [3, 1]])
    assert (found[..., 4:] == 0).all()


def test_memory_is_let_go_of_before_counting_it_ends(monkeypatch):
    """Tracing that stops while Dr.Jit's thread frees what was NumPy's may crash."""
    dr, alive, stop = use_drjit(), [], tracemalloc.stop
    wrapped = []

    def busy():
        column = np.ones(1 << 20, np.float32)
        wrapped.append(weakref.ref(column))
        lane = dr.llvm.Float(column)
        for _ in range(300):
            lane = dr.sin(lane)
        dr.eval(lane)

    def stopped():
        alive.extend(ref() is not None for ref in wrapped)
        stop()

    monkeypatch.setattr(tracemalloc, "stop", stopped)
    assert lanes.most_held_mib(busy) > 4
    assert alive == [False, False]
    assert not tracemalloc.is_tracing()
